"""Boundary methods of shapes without triangles: error against time on three scenes of an exact sphere.

    python examples/benchmarks/implicit_methods.py [--quick] [--output results.jsonl]

A ball under a sky, a ball above a lit floor with its shadow, and the shadow of a ball that is not seen; the derivatives
of a weighted image by its radius and its place, every term, depth 2. The error is the standard deviation of one
gradient, of independent seeds, over the derivative's size, lengths of vectors of the four numbers; the size is that of
the mean of all methods. Guiding is built by a first gradient, which does not count. Time is the processor's. "to 1 %"
follows from error^2 ~ 1 / time.
"""

import time

import numpy as np
from common import Report, arguments, psdr

T = psdr.Transform
SIZE, DEPTH = 16, 2
BALL = "ball.to_world"
POSE = T.translate([0.1, 0.0, 0.8]).rotate([0.0, 0.6, 0.8], 35.0).scale(0.35)
METHODS = {
    "PathSpace()": psdr.boundary.PathSpace(),
    "PathSpace(guiding=KdTree())": psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree()),
    "Projective()": psdr.boundary.Projective(),
    "SignedDistance()": psdr.boundary.SignedDistance(),
    "NeuralSignedDistance()": psdr.boundary.NeuralSignedDistance(),
}


def camera(origin: list[float], target: list[float], fov: float) -> dict:
    """Return a small pinhole camera."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    return {"type": "perspective", "fov": fov, "to_world": T.look_at(origin, target, [0, 0, 1]), "film": film}


def diffuse(*color: float) -> dict:
    """Return a plain material."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(color)}}


def scenes() -> dict[str, dict]:
    """Return the scenes by name."""
    ball = {"type": "sphere", "exact": True, "to_world": POSE, "bsdf": diffuse(0.7, 0.5, 0.3)}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    floor = {"type": "rectangle", "to_world": T.scale(6.0), "bsdf": diffuse(0.6, 0.6, 0.6)}
    pose = T.translate([0.8, -0.8, 2.5]).rotate([1, 0, 0], 180.0).scale(0.4)
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": [12.0, 12.0, 12.0]}}
    light = {"type": "rectangle", "to_world": pose, "emitter": emitter}
    view = camera([0.3, -2.2, 3.0], [0.0, 0.0, 0.2], 38.0)
    lit = {"ball": ball, "floor": floor, "light": light}
    beside = {**ball, "to_world": T(T.translate([0.0, 0.0, 0.5]).matrix @ POSE.matrix)}
    return {
        "ball under a sky": {"sensor": camera([0.3, -2.2, 3.0], [0.0, 0.0, 0.6], 38.0), "ball": ball, "sky": sky},
        "ball and its shadow": {"sensor": view, **lit},
        "shadow alone": {"sensor": camera([-0.6, -1.0, 1.0], [-0.6, 0.35, 0.0], 34.0), **lit, "ball": beside},
    }


def gradients(scene, method, spp: int, repeat: int) -> tuple[np.ndarray, float]:
    """Return derivatives (repeat, 4) by radius, x, y, z, and the median of their seconds."""
    params = psdr.traverse(scene)
    params.requires_grad(BALL)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    adjoint = ((np.sin(3.0 * x + 1.0) * np.cos(4.0 * y) + 0.7)[..., None] * [1.0, 0.6, 0.3]).astype(np.float32)
    pose = params[BALL].numpy().astype(np.float64)
    integrator = psdr.PathIntegrator(max_depth=DEPTH, boundary=method)
    found, seconds = [], []
    for seed in range(repeat + 1):
        params.zero_grad()
        start = time.process_time()
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=seed)
        seconds.append(time.process_time() - start)
        g = params[BALL].grad.numpy().astype(np.float64)
        found.append([(g[:3, :3] * pose[:3, :3]).sum(), *g[:3, 3]])
    return np.array(found[1:]), float(np.median(seconds[1:]))


def main() -> None:
    """Measure every method on every scene."""
    options = arguments(__doc__).parse_args()
    repeat, spp = options.repeat or (8 if options.quick else 24), 16 if options.quick else 64
    psdr.set_workers(options.threads)
    report = Report("implicit_methods.py", options.output)
    title = f"Derivatives of exact spheres, {SIZE} × {SIZE} pixels, {spp} samples, depth {DEPTH}"
    for name, nodes in scenes().items():
        scene = psdr.load_dict({"type": "scene", **nodes})
        found = {label: gradients(scene, method, spp, repeat) for label, method in METHODS.items()}
        size = np.linalg.norm(np.mean([values.mean(axis=0) for values, _s in found.values()], axis=0))
        rows = []
        for label, (values, seconds) in found.items():
            error = float(np.linalg.norm(values.std(axis=0, ddof=1)) / size)
            others = [v.mean(axis=0) for other, (v, _s) in found.items() if other != label]
            off = float(np.linalg.norm(values.mean(axis=0) - np.mean(others, axis=0)) / size)
            variances = [v.var(axis=0, ddof=1) for v, _s in found.values()]
            own = values.var(axis=0, ddof=1)
            rest = (sum(variances) - own) / len(others) ** 2
            noise = float(np.sqrt((own + rest).sum() / repeat) / size)
            rows.append(
                {
                    "scene": name,
                    "boundary method": label,
                    "seconds": seconds,
                    "error": error,
                    "seconds to 1 %": seconds * (error / 0.01) ** 2,
                    "off the others": off,
                    "of which noise": noise,
                }
            )
        report.table(title, rows)


if __name__ == "__main__":
    main()
