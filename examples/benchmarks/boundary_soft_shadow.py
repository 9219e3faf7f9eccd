"""The shadow edge of a moving mesh: this renderer, unguided and guided, against Mitsuba 3's ``direct_projective``.

    python examples/benchmarks/boundary_soft_shadow.py [--quick] [--output results.jsonl]

A sphere of 32,512 triangles between a floor and a small area light moves; the camera sees the floor with its shadow and
not the sphere. So the derivative image has no other term than the secondary boundary's, in both renderers. Errors are
those of the derivative image, relative to its root mean square, against a long image of the same renderer, ours guided
with seeds of its own. The long images are compared with each other, and with an unguided one of ours. The time to a
given error follows from error^2 ~ 1 / time. A guided first call includes the building of its structure; later ones, at
the same or a nearby scene, use it again. Mitsuba builds its own in every call.
"""

import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
from common import Report, arguments, import_mitsuba, psdr

from scenes import write_ply

#: Rings and columns of the sphere: 2 * 128 * 127 triangles.
RINGS = 128
DIRECTION = (1.0, 0.2, 0.3)
SPHERE = "sphere.vertex_positions"
#: Relative error at which times are compared.
AIM = 0.1
XML = """<scene version="3.0.0">
    <default name="resolution" value="128"/>
    <sensor type="perspective"><float name="fov" value="40"/><transform name="to_world">
        <lookat origin="-1.5, -2.5, 1.6" target="-0.5, 0.1, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="$resolution"/><integer name="height" value="$resolution"/>
        <rfilter type="box"/></film></sensor>
    <shape type="rectangle" id="floor"><transform name="to_world"><scale value="4"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7"/></bsdf></shape>
    <shape type="ply" id="sphere"><string name="filename" value="sphere.ply"/>
        <boolean name="face_normals" value="true"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
    <shape type="rectangle" id="light"><transform name="to_world"><scale value="0.2"/><rotate x="1" angle="180"/>
        <translate x="1.2" y="-0.6" z="3.5"/></transform>
        <emitter type="area"><rgb name="radiance" value="30"/></emitter></shape>
</scene>
"""


def write_scene(folder: Path) -> Path:
    """Write the scene file and its mesh."""
    theta = np.linspace(0.0, np.pi, RINGS + 1)[1:-1, None]
    phi = np.linspace(0.0, 2.0 * np.pi, RINGS, endpoint=False)[None]
    rings = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0.0 * phi], -1)
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    i, j = np.mgrid[0 : RINGS - 2, 0:RINGS].reshape(2, -1)
    a, b = i * RINGS + j, i * RINGS + (j + 1) % RINGS
    k = np.arange(RINGS)
    after, last, top = (k + 1) % RINGS, (RINGS - 2) * RINGS, len(vertices) - 2
    quads = [np.stack([a, a + RINGS, b], 1), np.stack([b, a + RINGS, b + RINGS], 1)]
    caps = [
        np.stack([np.full(RINGS, top), k, after], 1),
        np.stack([np.full(RINGS, top + 1), last + after, last + k], 1),
    ]
    write_ply(folder / "sphere.ply", 0.4 * vertices + [0.2, 0.0, 1.5], np.concatenate([*quads, *caps]))
    file = folder / "soft_shadow.xml"
    file.write_text(XML)
    return file


class Ours:
    """Derivative images of this renderer."""

    def __init__(self, file: Path, resolution: int, guiding):
        self.scene = psdr.load_file(file, resolution=resolution)
        self._params = psdr.traverse(self.scene)
        self._guiding = guiding
        self._tangent = np.broadcast_to(np.float32(DIRECTION), self._params[SPHERE].numpy().shape).copy()

    def image(self, spp: int, seed: int) -> np.ndarray:
        """Return the derivative image; the interior term, which is zero here, takes one sample a pixel."""
        method = psdr.boundary.PathSpace(spp_primary=1, spp_secondary=spp, guiding=self._guiding)
        integrator = psdr.PathIntegrator(max_depth=2, boundary=method)
        return psdr.render_forward(
            self.scene, self._params, {SPHERE: self._tangent}, integrator=integrator, spp=1, seed=seed
        ).numpy()

    def forget(self) -> None:
        """Forget the structure."""
        psdr.guiding.reset(self.scene)

    @property
    def memory(self) -> float:
        """Megabytes of the structure."""
        return sum(s.memory for s in psdr.guiding.structures(self.scene)) / 1e6


class Theirs:
    """Derivative images of Mitsuba."""

    def __init__(self, mi, dr, file: Path, resolution: int, guiding: str):
        self._mi, self._dr, self._guiding = mi, dr, guiding
        self._scene = mi.load_file(str(file), resolution=resolution)
        self._base = mi.Float(mi.traverse(self._scene)[SPHERE])

    def image(self, spp: int, seed: int) -> np.ndarray:
        """Return the derivative image: indirect boundary samples only."""
        mi, dr = self._mi, self._dr
        options = {"sppc": 0, "sppp": 0, "sppi": spp, "guiding": self._guiding}
        integrator = mi.load_dict({"type": "direct_projective", **options})
        params = mi.traverse(self._scene)
        theta = mi.Float(0.0)
        dr.enable_grad(theta)
        moved = dr.unravel(mi.Point3f, self._base) + mi.Vector3f(*DIRECTION) * theta
        params[SPHERE] = dr.ravel(moved)
        params.update()
        dr.forward(theta, dr.ADFlag.ClearEdges)
        image = integrator.render_forward(self._scene, params=theta, seed=seed, spp=spp)
        dr.eval(image)
        dr.sync_thread()
        return np.array(image)

    def forget(self) -> None:
        """There is nothing to forget."""

    memory = 0.0


def measure(renderer, spp: int, repeat: int, reference: np.ndarray, first: bool) -> dict:
    """Return the median time and the relative squared error of images with independent seeds."""
    renderer.image(1, 0)  # compile
    renderer.forget()
    times, errors = [], []
    for seed in range(1, repeat + 2):
        if first:
            renderer.forget()
        start = time.perf_counter()
        image = renderer.image(spp, seed)
        times.append(time.perf_counter() - start)
        errors.append(float(((image - reference) ** 2).mean() / (reference**2).mean()))
    # The first call builds what later ones use.
    seconds, squared = statistics.median(times[1:]), statistics.mean(errors[1:])
    row = {"spp": spp, "seconds": seconds, "relative error": squared**0.5, "error^2 x time": squared * seconds}
    return row | {f"seconds to {AIM}": squared * seconds / AIM**2, "MB": renderer.memory}


def main() -> None:
    """Run and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--without-mitsuba", action="store_true", help="our own variants alone")
    options = parser.parse_args()
    repeat = options.repeat or (5 if options.quick else 7)
    resolution, long = (64, 512) if options.quick else (128, 4096)
    psdr.set_workers(options.threads)
    mi, dr = (None, None) if options.without_mitsuba else import_mitsuba(options.threads)
    report = Report("soft shadow of a moving mesh", options.output)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        file = write_scene(Path(name))
        reference = _long(Ours(file, resolution, psdr.guiding.KdTree()), long)
        plain = _long(Ours(file, resolution, None), long)
        slopes = {"ours, unguided": float((plain * reference).sum() / (reference * reference).sum())}
        variants = {
            "unguided": (None, 64, False),
            "KdTree": (psdr.guiding.KdTree(), 16, False),
            "KdTree, first call": (psdr.guiding.KdTree(), 16, True),
            "Octree": (psdr.guiding.Octree(), 16, False),
            "Octree, first call": (psdr.guiding.Octree(), 16, True),
        }
        for label, (guiding, spp, first) in variants.items():
            row = measure(Ours(file, resolution, guiding), spp, repeat, reference, first)
            rows.append({"method": label} | row)
        if mi is not None:
            theirs = _long(Theirs(mi, dr, file, resolution, "none"), long)
            slopes["Mitsuba"] = float((theirs * reference).sum() / (reference * reference).sum())
            for guiding, spp in (("none", 64), ("octree", 16)):
                row = measure(Theirs(mi, dr, file, resolution, guiding), spp, repeat, theirs, True)
                rows.append({"method": f"Mitsuba, {guiding}"} | row)
    report.table("long images: slope on ours, guided", [slopes])
    times = {row["method"]: row["error^2 x time"] for row in rows}
    base = times["Mitsuba, none"] if mi is not None else times["unguided"]
    for row in rows:
        row["gain"] = base / row["error^2 x time"]
    settings = f"{resolution}^2 pixels, medians of {repeat}, {options.threads} threads"
    report.table(f"derivative images, {settings}; gain over {'Mitsuba, none' if mi else 'unguided'}", rows)


def _long(renderer, spp: int) -> np.ndarray:
    """Mean of sixteen images with seeds of their own."""
    return np.mean([renderer.image(max(spp // 16, 1), 1000 + i).astype(np.float64) for i in range(16)], axis=0)


if __name__ == "__main__":
    main()
