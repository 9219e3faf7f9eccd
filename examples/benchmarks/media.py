"""Participating media against Mitsuba 3, and against the own passes: smoke, fog, and what moves in fog.

    python examples/benchmarks/media.py [--quick] [--threads 1] [--output results.jsonl]

Smoke of 64^3 voxels, half of them empty, under a sky and a sun, and fog in the Cornell box: both renderers load the
same files and take turns. "image + gradient" is that of the image's mean by all voxels of the density and by the
albedo; of Mitsuba it is ``prbvolpath``, rendered and differentiated. A moving occluder in fog is compared with the same
scene without fog. Last the variance of single voxels' derivatives, summed over those voxels where ``prbvolpath`` is
right (density above 0 and below its maximum), times the seconds of a gradient.
"""

import struct
import tempfile
from pathlib import Path

import numpy as np
import warp as wp
from common import Report, arguments, import_mitsuba, in_turns, median, psdr, ratio

from scenes import CORNELL

SPP, DEPTH, VOXELS = 16, 8, 64
#: Paths that no roulette ends.
WHOLE = 100
#: Independent images of which means are compared, and gradients of which variances are.
SEEDS = 8
REPLAY = psdr.interior.Replay()
DENSITY, ALBEDO = "cube.interior_medium.sigma_t.data", "cube.interior_medium.albedo.value.value"
POSE = "square.to_world"
SMOKE = """<scene version="3.0.0">
<default name="resolution" value="128"/>
<sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0, 0.4, 3.4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="$resolution"/><integer name="height" value="$resolution"/>
        <rfilter type="box"/></film></sensor>
<shape type="cube" id="cube"><bsdf type="null"/><medium type="heterogeneous" name="interior">
    <float name="scale" value="8"/>
    <volume type="gridvolume" name="sigma_t"><string name="filename" value="smoke.vol"/>
        <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume>
    <volume type="constvolume" name="albedo"><rgb name="value" value="0.9, 0.9, 0.9"/></volume>
</medium></shape>
<emitter type="constant"><rgb name="radiance" value="0.5, 0.6, 0.8"/></emitter>
<emitter type="directional"><vector name="direction" x="-1" y="-1" z="-0.5"/>
    <rgb name="irradiance" value="2, 1.8, 1.5"/></emitter>
</scene>"""
#: Fog in the lower part of the room: next to a lamp Mitsuba's next-event estimation in fog is too dark.
FOG = """<shape type="cube" id="fog"><transform name="to_world"><scale x="0.97" y="0.6" z="0.97"/>
    <translate y="-0.35"/></transform>
    <bsdf type="null"/><medium type="homogeneous" name="interior">
    <volume type="constvolume" name="sigma_t"><float name="value" value="0.5"/></volume>
    <volume type="constvolume" name="albedo"><float name="value" value="0.9"/></volume>
    <phase type="hg"><float name="g" value="0.5"/></phase></medium></shape>"""


def smoke(n: int) -> np.ndarray:
    """Return a density (n, n, n) with many zeros, its largest value 1."""
    rng = np.random.default_rng(1)
    at = np.linspace(-1.0, 1.0, n)
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    density = np.zeros((n, n, n))
    for _ in range(24):
        cx, cy, cz = rng.uniform(-0.6, 0.6, 3)
        size, weight = rng.uniform(0.12, 0.35), rng.uniform(0.2, 1.0)
        density += weight * np.exp(-((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) / (2.0 * size * size))
    density = np.clip(density - 0.25, 0.0, None)
    return (density / density.max()).astype(np.float32)


def write(folder: Path) -> dict[str, tuple[Path, int]]:
    """Write the scene files; name -> (file, depth)."""
    n = VOXELS
    head = b"VOL\x03" + struct.pack("<5i6f", 1, n, n, n, 1, 0, 0, 0, 1, 1, 1)
    (folder / "smoke.vol").write_bytes(head + smoke(n).tobytes())
    (folder / "smoke.xml").write_text(SMOKE)
    box = CORNELL.read_text(encoding="utf-8")
    (folder / "fog.xml").write_text(box.replace("</scene>", FOG + "\n</scene>"))
    return {"smoke": (folder / "smoke.xml", DEPTH), "fog in the Cornell box": (folder / "fog.xml", DEPTH)}


class Both:
    """Both renderers with one scene."""

    def __init__(self, mi, dr, file: Path, depth: int, resolution: int, spp: int = SPP):
        self._mi, self._dr = mi, dr
        self._spp = spp
        self.ours = psdr.load_file(file, resolution=resolution)
        self._theirs = mi.load_file(str(file), resolution=resolution)
        options = {"max_depth": depth, "rr_depth": WHOLE}
        self._options = {"integrator": psdr.PathIntegrator(**options, interior=REPLAY), "spp": spp}
        self._volpath, self._prb = (mi.load_dict({"type": t, **options}) for t in ("volpath", "prbvolpath"))
        self.params = psdr.traverse(self.ours)
        self._listed = mi.traverse(self._theirs)
        mean = 1.0 / (3.0 * resolution * resolution)
        self._adjoint = wp.full((resolution, resolution), wp.vec3(mean, mean, mean), dtype=wp.vec3, device="cpu")

    def image(self, seed: int) -> np.ndarray:
        """Render."""
        return psdr.render(self.ours, seed=seed, **self._options).numpy()

    def their_image(self, seed: int, integrator=None) -> np.ndarray:
        """Render with Mitsuba."""
        image = self._mi.render(self._theirs, integrator=integrator or self._volpath, spp=self._spp, seed=seed)
        self._dr.eval(image)
        self._dr.sync_thread()
        return np.array(image)

    def request(self, *names: str) -> None:
        """Ask both for derivatives."""
        self.params.requires_grad_only(*names)
        for name in names:
            self._dr.enable_grad(self._listed[name])
        self._listed.update()

    def gradient(self, seed: int) -> np.ndarray:
        """Return the derivatives by the first of what is requested."""
        self.params.zero_grad()
        psdr.render_backward(self.ours, self.params, self._adjoint, seed=seed, **self._options)
        return self.params[self.params.requested[0]].grad.numpy()

    def image_and_gradient(self, seed: int) -> None:
        """Render and differentiate."""
        self.image(seed)
        self.gradient(seed)

    def their_gradient(self, seed: int) -> np.ndarray:
        """Render and differentiate with Mitsuba; the derivatives by the first of what is requested."""
        dr, listed = self._dr, self._listed
        names = self.params.requested
        for name in names:
            dr.set_grad(listed[name], 0.0)
        listed.update()
        image = self._mi.render(self._theirs, listed, integrator=self._prb, spp=self._spp, seed=seed)
        dr.backward(dr.mean(image, axis=None))
        found = [dr.grad(listed[name]) for name in names]
        dr.eval(*found)
        dr.sync_thread()
        return np.array(found[0])

    def forward(self, seed: int) -> None:
        """Render the derivative along a direction of all that is requested."""
        tangents = {name: np.ones(self.params[name].shape, np.float32) for name in self.params.requested}
        psdr.render_forward(self.ours, self.params, tangents, seed=seed, **self._options)

    def update(self, seed: int) -> None:
        """Follow an edit of the density."""
        self.params[DENSITY] = (1.0 - 1e-6 * seed) * self.density
        self.params.update(DENSITY)

    @property
    def density(self) -> np.ndarray:
        """The voxels."""
        return self.params[DENSITY].numpy()


class Occluder:
    """A square that moves below a lamp and above a floor, with fog around or without."""

    def __init__(self, fog: bool, size: int):
        t = psdr.Transform
        medium = {"type": "homogeneous", "sigma_t": 0.6, "albedo": 0.8, "phase": {"type": "hg", "g": 0.3}}
        scene = {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 38.0,
                "to_world": t.look_at([4.0, 1.0, 0.6], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
            },
            "square": {
                "type": "rectangle",
                "to_world": t.translate([0.1, 0.05, 0.3]) @ t.rotate([0, 1, 0], 25.0) @ t.scale(0.45),
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}},
            },
            "floor": {"type": "rectangle", "to_world": t.translate([0, 0, -1.3]) @ t.scale(1.6)},
            "lamp": {
                "type": "rectangle",
                "to_world": t.translate([0, 0, 2.2]) @ t.rotate([1, 0, 0], 180.0) @ t.scale(0.5),
                "emitter": {"type": "area", "radiance": 8.0},
            },
        }
        if fog:
            pose = t.rotate([0, 0, 1], 15.0)
            scene["fog"] = {"type": "cube", "to_world": pose, "bsdf": {"type": "null"}, "interior": medium}
        self._params = psdr.traverse(psdr.load_dict(scene))
        self._params.requires_grad(POSE)
        self._adjoint = wp.full((size, size), wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device="cpu")

    def gradient(self, seed: int) -> None:
        """Differentiate, interior and boundary."""
        self._params.zero_grad()
        integrator = psdr.PathIntegrator(max_depth=4, interior=REPLAY)
        options = {"integrator": integrator, "spp": SPP, "seed": seed}
        psdr.render_backward(self._params.scene, self._params, self._adjoint, **options)


def mean_of(images: np.ndarray) -> tuple[float, float]:
    """Return the mean over independent images (n, H, W, 3), and its standard error."""
    means = images.astype(np.float64).mean(axis=(1, 2, 3))
    return float(means.mean()), float(means.std(ddof=1) / np.sqrt(len(means)))


def voxel_noise(both: Both, seeds: int) -> list[float]:
    """Return the summed variances of derivatives by single voxels, ours and theirs."""
    inner = (both.density > 0.0) & (both.density < both.density.max())
    found = []
    for function in (both.gradient, both.their_gradient):
        samples = np.stack([function(1 + seed).reshape(inner.shape)[inner] for seed in range(seeds)])
        found.append(float(samples.astype(np.float64).var(axis=0, ddof=1).sum()))
    return found


def main() -> None:
    """Run the cases and print the tables."""
    options = arguments(__doc__).parse_args()
    repeat = options.repeat or (3 if options.quick else 7)
    size, small = (64, 32) if options.quick else (128, 32)
    mi, dr = import_mitsuba(options.threads)
    psdr.set_workers(options.threads)
    report = Report("media", options.output)
    agreement, rows = [], []
    with tempfile.TemporaryDirectory() as name:
        files = write(Path(name))
        for case, (file, depth) in files.items():
            both = Both(mi, dr, file, depth, small)
            images = [np.stack([f(seed) for seed in range(SEEDS)]) for f in (both.image, both.their_image)]
            means, errors = zip(*(mean_of(x) for x in images), strict=True)
            row = {"scene": case, "mean": means[0], "Mitsuba's mean": means[1], "error": float(np.hypot(*errors))}
            agreement.append(row)
        report.table(f"images of {small}^2 pixels, {SEEDS} seeds of {SPP} samples each", agreement)
        both = Both(mi, dr, *files["smoke"], size)
        both.request(DENSITY, ALBEDO)
        fog = Both(mi, dr, *files["fog in the Cornell box"], size)
        passes = {
            "image": both.image,
            "volpath": both.their_image,
            "image + gradient": both.image_and_gradient,
            "prbvolpath": both.their_gradient,
            "forward": both.forward,
            "update": both.update,
            "fog": fog.image,
            "fog by volpath": fog.their_image,
            "occluder": Occluder(False, 64).gradient,
            "occluder in fog": Occluder(True, 64).gradient,
        }
        times = in_turns(passes, repeat)

        def row(what: str, which: str, over: str, wanted: str) -> None:
            numbers = {"seconds": median(times, which), "of": over, "of, seconds": median(times, over)}
            if wanted.startswith(">="):
                ratios = [ratio(times, over, which, clock) for clock in ("wall", "cpu")]
            else:
                ratios = [ratio(times, which, over, clock) for clock in ("wall", "cpu")]
            rows.append({"what": what, **numbers, "ratio": ratios[0], "by processor time": ratios[1], "wanted": wanted})

        row("smoke, image: speed", "image", "volpath", ">= 2")
        row("smoke, image + gradient: speed", "image + gradient", "prbvolpath", ">= 2.5")
        row("smoke, image + gradient: time", "image + gradient", "image", "<= 3.5")
        row("smoke, forward mode: time", "forward", "image", "<= 6")
        row("smoke, update of the grid: time", "update", "image", "<= 0.1")
        row("fog in the Cornell box, image: speed", "fog", "fog by volpath", ">= 1")
        row("moving occluder in fog, gradient: time", "occluder in fog", "occluder", "<= 2.5")
        settings = f"{size}^2 pixels, {SPP} samples, medians of {repeat}, {options.threads} threads"
        report.table(f"media, {settings}", rows)
        both = Both(mi, dr, *files["smoke"], small)
        both.request(DENSITY)
        times = in_turns({"ours": both.gradient, "prbvolpath": both.their_gradient}, repeat)
        noise = voxel_noise(both, SEEDS)
        row = {"variance": noise[1] / noise[0]}
        for clock, label in (("wall", "time"), ("cpu", "processor time")):
            row[label] = ratio(times, "prbvolpath", "ours", clock)
            row[f"variance x {label}"] = row["variance"] * row[label]
        report.table("prbvolpath over ours, derivatives by voxels of smoke", [row | {"wanted": ">= 3"}])


if __name__ == "__main__":
    main()
