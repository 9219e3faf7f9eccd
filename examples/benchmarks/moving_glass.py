"""Moving glass: a gradient by five motions in a room with a ball of glass, or a mirror, against central differences.

    python examples/benchmarks/moving_glass.py [--quick] [--output results.jsonl]

Camera, ball, box, light and back wall move along one direction each, a pixel or so. One gradient pass answers all five;
differences take two images for each, with equal seeds. Compared is noise^2 x processor time: of the derivative of the
image's mean, and of derivative images. A second table has each term's part of time and variance.
"""

import time

import numpy as np
import trimesh
from common import Report, arguments, psdr

from warp_psdr.accuracy import quantity

T = psdr.Transform
SIZE, DEPTH = 24, 8
#: Half of a difference, in units of a direction's length: a twentieth of a pixel.
HALF = 0.05
#: A pixel at the middle of the room.
PIXEL = 0.1
#: Translations.
MOTIONS = {
    "camera": (0.3, 0.5, 0.8),
    "ball": (0.5, 0.7, -0.5),
    "box": (-0.6, 0.6, 0.5),
    "light": (0.7, -0.5, 0.5),
    "back": (0.2, 0.2, 0.95),
}
BALLS = {
    "glass": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0},
    "mirror": {"type": "conductor", "material": "none"},
}
#: Samples of a batch: of a pass, and of the images of a difference.
SPP, DIFFERENCE_SPP = 16, 32
BATCHES = 32


def diffuse(*color: float) -> dict:
    """A matt surface."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(color)}}


def room(bsdf: dict) -> dict:
    """A room with a ball of 1,280 triangles with interpolated normals; its back wall stands behind the others' ends."""

    def wall(to_world, *color: float) -> dict:
        return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "twosided", "bsdf": diffuse(*color)}}

    ball = trimesh.creation.icosphere(subdivisions=3)
    gray, x, y = (0.8, 0.7, 0.65), [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    return {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 39.3,
            "to_world": T.look_at([0.0, 0.0, 4.0], [0.0, 0.0, 0.0], y),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "tent"}},
        },
        "floor": wall(T.translate([0.0, -1.0, 0.0]) @ T.rotate(x, -90.0), *gray),
        "ceiling": wall(T.translate([0.0, 1.0, 0.0]) @ T.rotate(x, 90.0), *gray),
        "left": wall(T.translate([-1.0, 0.0, 0.0]) @ T.rotate(y, 90.0), 0.6, 0.05, 0.05),
        "right": wall(T.translate([1.0, 0.0, 0.0]) @ T.rotate(y, -90.0), 0.1, 0.4, 0.08),
        "back": wall(T.translate([0.0, 0.0, -1.05]), *gray),
        "light": {
            "type": "rectangle",
            "to_world": T.translate([0.0, 0.97, 0.0]) @ T.rotate(x, 90.0) @ T.scale(0.3),
            "bsdf": diffuse(0.0, 0.0, 0.0),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [18.4, 14.0, 6.75]}},
        },
        "ball": {
            "type": "mesh",
            "vertices": (0.35 * ball.vertices + [-0.35, -0.6, 0.25]).astype(np.float32),
            "faces": ball.faces.astype(np.int32),
            "bsdf": bsdf,
        },
        "box": {
            "type": "cube",
            "to_world": T.translate([0.35, -0.55, -0.3]) @ T.rotate(y, 20.0) @ T.scale([0.25, 0.4, 0.25]),
            "bsdf": diffuse(0.8, 0.7, 0.6),
        },
    }


class Study:
    """One room."""

    def __init__(self, bsdf: dict, batches: int):
        self._batches = batches
        self._scene = psdr.load_dict(room(bsdf))
        self._params = psdr.traverse(self._scene)
        self._integrator = psdr.PathIntegrator(max_depth=DEPTH)
        names = [f"{what}.to_world" for what in MOTIONS]
        self._params.requires_grad(*names)
        self._tangents = {name: self._tangent(name, move) for name, move in zip(names, MOTIONS.values(), strict=True)}

    def _tangent(self, name: str, move: tuple) -> np.ndarray:
        rate = np.zeros((4, 4))
        rate[:3, 3] = PIXEL * np.asarray(move)
        return (rate @ self._params[name].numpy()).astype(np.float32)

    def _timed(self, run) -> tuple[float, np.ndarray]:
        """Return the median processor time of a batch and the batches; the first call compiles."""
        times, found = [], []
        for seed in range(self._batches + 1):
            start = time.process_time()
            batch = run(seed)
            if seed:
                times.append(time.process_time() - start)
                found.append(batch)
        return float(np.median(times)), np.array(found)

    def _image(self, spp: int, seed: int) -> np.ndarray:
        image = psdr.render(self._scene, integrator=self._integrator, spp=spp, seed=seed)
        return image.numpy().astype(np.float64)

    def _difference(self, name: str, seed: int) -> np.ndarray:
        """Return an image's difference over a step."""
        base, images = self._params[name].numpy().copy(), []
        for sign in (1.0, -1.0):
            self._params[name] = (base + sign * HALF * self._tangents[name]).astype(np.float32)
            self._params.update()
            images.append(self._image(DIFFERENCE_SPP, seed))
        self._params[name] = base
        self._params.update()
        return (images[0] - images[1]) / (2.0 * HALF)

    def image_seconds(self, spp: int) -> float:
        """Return the time of an image."""
        return self._timed(lambda seed: self._image(spp, seed))[0]

    def pass_seconds(self) -> float:
        """Return the time of a gradient pass by all five motions."""
        adjoint = np.ones((SIZE, SIZE, 3), np.float32)

        def run(seed: int) -> None:
            options = {"integrator": self._integrator, "spp": SPP, "seed": seed}
            psdr.render_backward(self._scene, self._params, adjoint, **options)

        return self._timed(run)[0]

    def differences(self) -> dict[str, np.ndarray]:
        """Return difference images by each motion, (batches, H, W, 3)."""
        return {name: self._timed(lambda seed, name=name: self._difference(name, seed))[1] for name in self._tangents}

    def terms_of_mean(self) -> dict[str, tuple[float, np.ndarray]]:
        """Return term -> (seconds, derivatives of the image's mean by each motion, (batches, motions))."""
        adjoint = np.full((SIZE, SIZE, 3), 1.0 / (3.0 * SIZE**2), np.float32)
        q = quantity.gradient(self._scene, self._params, adjoint, integrator=self._integrator, sensor=0)
        found = {}
        for part in q.parts:
            seconds, rows = self._timed(lambda seed, part=part: part.run(SPP, seed))
            slopes = [rows[:, q.blocks[name]] @ tangent.reshape(-1) for name, tangent in self._tangents.items()]
            found[part.name] = seconds, np.stack(slopes, axis=1)
        return found

    def terms_of_images(self, name: str) -> dict[str, tuple[float, np.ndarray]]:
        """Return term -> (seconds, derivative images by a motion)."""
        tangents = {name: self._tangents[name]}
        q = quantity.derivative(self._scene, self._params, tangents, integrator=self._integrator, sensor=0)
        return {part.name: self._timed(lambda seed, part=part: part.run(SPP, seed)) for part in q.parts}


def variance(found: dict[str, tuple[float, np.ndarray]]) -> dict[str, float]:
    """Return term -> variance of a batch, the mean over what it holds."""
    return {term: float(batches.var(axis=0, ddof=1).mean()) for term, (_, batches) in found.items()}


def measured(ball: str, study: Study) -> tuple[list[dict], list[dict]]:
    """Return the rows of both tables."""
    image, passed = study.image_seconds(SPP), study.pass_seconds()
    difference = 2.0 * study.image_seconds(DIFFERENCE_SPP)
    of_mean, differences = study.terms_of_mean(), study.differences()
    seconds = {term: t for term, (t, _) in of_mean.items()}
    rows, shares = [], {term: ([], []) for term in of_mean}
    for i, (what, (name, theirs)) in enumerate(zip(MOTIONS, differences.items(), strict=True)):
        of_images = study.terms_of_images(name)
        slopes = {term: (t, found[:, i]) for term, (t, found) in of_mean.items()}
        mean, images = variance(slopes), variance(of_images)
        ours = sum(found for _, found in slopes.values())
        forward = sum(t for t, _ in of_images.values())
        means, pixels = theirs.mean(axis=(1, 2, 3)), theirs.var(axis=0, ddof=1).mean()
        rows.append({
            "ball": ball, "motion": what, "pass over image": passed / image, "forward over image": forward / image,
            "derivative of the mean": ours.mean(), "its error": (sum(mean.values()) / len(ours)) ** 0.5,
            "by differences": means.mean(), "their error": (means.var(ddof=1) / len(means)) ** 0.5,
            "gain, mean": means.var(ddof=1) * difference * len(MOTIONS) / (sum(mean.values()) * passed),
            "gain, derivative image": pixels * difference / (sum(images.values()) * forward),
        })  # fmt: skip
        for term, (of_means, of_pixels) in shares.items():
            of_means.append(mean[term] / sum(mean.values()))
            of_pixels.append(images.get(term, 0.0) / sum(images.values()))
    terms = [{
        "ball": ball, "term": term, "share of the time": seconds[term] / sum(seconds.values()),
        "share of the mean's variance": float(np.mean(of_means)),
        "share of the images' variance": float(np.mean(of_pixels)),
    } for term, (of_means, of_pixels) in shares.items()]  # fmt: skip
    return rows, terms


def main() -> None:
    """Run and print the tables."""
    options = arguments(__doc__).parse_args()
    psdr.set_workers(1)
    report = Report("moving_glass", options.output)
    found = []
    for ball, bsdf in BALLS.items():
        rows, terms = measured(ball, Study(bsdf, 16 if options.quick else BATCHES))
        found.append((rows, terms))
    title = f"A room with a ball, {SIZE} × {SIZE} pixels, depth {DEPTH}, five motions"
    report.table(
        f"{title}: noise² × time of differences over that of gradients", [r for rows, _ in found for r in rows]
    )
    report.table(f"{title}: terms, means over the motions", [r for _, terms in found for r in terms])


if __name__ == "__main__":
    main()
