"""Derivatives at glossy surfaces: variance and time of the methods made for them against ``interior.Replay``.

    python examples/benchmarks/shape_derivatives.py [--method resampled] [--quick] [--output results.jsonl]

By the shape of lobes, ``interior.Resampled``; by roughnesses of metal, other numbers of single lobes and weights,
``interior.Decomposed`` beside it; by what turns normals, ``interior.Antithetic`` and ``interior.Resampled``.

A glossy ball on a floor under a lamp of some width and an even sky. The variance is that of the derivative image, all
pixels together, from independent seeds at equal samples; the time that of gradients in reverse mode. What counts is the
last column, the ratio of the variances at equal time: above 1, branches pay.
"""

import numpy as np
from common import Report, arguments, in_turns, psdr, ratio

#: Depth of the paths.
DEPTH = 4


def rgb(*value: float) -> dict:
    """Return a colour."""
    return {"type": "rgb", "value": list(value)}


def metal(alpha: float) -> dict:
    """Return a rough metal."""
    return {
        "type": "roughconductor",
        "distribution": "ggx",
        "alpha": alpha,
        "eta": rgb(0.2, 0.9, 1.1),
        "k": rgb(4, 2, 2),
    }


def mapped(nested: dict) -> dict:
    """Return a material under an even normal map."""
    return {"type": "normalmap", "normalmap": rgb(0.55, 0.48, 0.9), "nested": nested}


#: Materials and what is differentiated.
PLASTIC = {"type": "roughplastic", "distribution": "ggx", "alpha": 0.2, "diffuse_reflectance": rgb(0.5, 0.2, 0.1)}
BLEND = {
    "type": "blendbsdf",
    "weight": 0.4,
    "bsdf_0": {"type": "diffuse", "reflectance": rgb(0.6, 0.3, 0.1)},
    "bsdf_1": metal(0.2),
}
RARE = {**BLEND, "weight": 0.02}
GROOVES = {"type": "orennayar", "sigma": 0.4, "reflectance": rgb(0.7, 0.5, 0.4)}
LONG_TAILS = {"type": "abc", "A": 2.0, "B": 60.0, "C": 1.3, "eta": rgb(0.2, 0.9, 1.1), "k": rgb(4, 2, 2)}
#: Where a case's parameter moves to; 1.0: a number.
RIGHT, ASIDE = np.array([1.0, 0.0, 0.0]), np.zeros((4, 4))
ASIDE[0, 3] = 1.0
#: (name, material, parameter, direction, half width of the lamp, power of the lamp, radiance of the sky).
SHAPES = (
    ("metal, alpha 0.15, small lamp", metal(0.15), "ball.bsdf.alpha.value", 1.0, 0.1, 24.0, 0.0),
    ("metal, alpha 0.15, lamp", metal(0.15), "ball.bsdf.alpha.value", 1.0, 0.7, 24.0, 0.0),
    ("metal, alpha 0.15, lamp and sky", metal(0.15), "ball.bsdf.alpha.value", 1.0, 0.7, 24.0, 0.3),
    ("metal, alpha 0.15, wide lamp and sky", metal(0.15), "ball.bsdf.alpha.value", 1.0, 3.0, 24.0, 1.0),
    ("metal, alpha 0.05, wide lamp and sky", metal(0.05), "ball.bsdf.alpha.value", 1.0, 3.0, 24.0, 1.0),
    ("metal, alpha 0.4, wide lamp and sky", metal(0.4), "ball.bsdf.alpha.value", 1.0, 3.0, 24.0, 1.0),
    ("plastic, alpha 0.2, lamp and sky", PLASTIC, "ball.bsdf.alpha", 1.0, 0.7, 24.0, 0.3),
    ("blend of paint and metal, weight 0.4, lamp and sky", BLEND, "ball.bsdf.weight.value", 1.0, 0.7, 24.0, 0.3),
    ("blend of paint and metal, weight 0.02, lamp and sky", RARE, "ball.bsdf.weight.value", 1.0, 0.7, 24.0, 0.3),
)
NORMAL = "ball.bsdf.normalmap.value"
NORMALS = (
    ("metal, alpha 0.05, map, small lamp", mapped(metal(0.05)), NORMAL, RIGHT, 0.1, 24.0, 0.0),
    ("metal, alpha 0.05, map, lamp", mapped(metal(0.05)), NORMAL, RIGHT, 0.7, 24.0, 0.0),
    ("metal, alpha 0.05, map, wide lamp and sky", mapped(metal(0.05)), NORMAL, RIGHT, 3.0, 24.0, 1.0),
    ("metal, alpha 0.15, map, wide lamp and sky", mapped(metal(0.15)), NORMAL, RIGHT, 3.0, 24.0, 1.0),
    ("metal, alpha 0.4, map, wide lamp and sky", mapped(metal(0.4)), NORMAL, RIGHT, 3.0, 24.0, 1.0),
    ("plastic, alpha 0.2, map, wide lamp and sky", mapped(PLASTIC), NORMAL, RIGHT, 3.0, 24.0, 1.0),
    ("metal, alpha 0.05, moves, lamp", metal(0.05), "ball.to_world", ASIDE, 0.7, 24.0, 0.0),
    ("metal, alpha 0.05, moves, wide lamp and sky", metal(0.05), "ball.to_world", ASIDE, 3.0, 24.0, 1.0),
)
BRUSHED = {**metal(0.1), "alpha_u": 0.1, "alpha_v": 0.3}
del BRUSHED["alpha"]
BECKMANN = {**metal(0.15), "distribution": "beckmann"}
#: Others whose lobes have closed forms, and all that do.
OTHERS = (
    ("Beckmann, alpha 0.15, wide lamp and sky", BECKMANN, "ball.bsdf.alpha.value", 1.0, 3.0, 24.0, 1.0),
    ("brushed, alpha_u 0.1 of (0.1, 0.3), wide lamp and sky", BRUSHED, "ball.bsdf.alpha_u.value", 1.0, 3.0, 24.0, 1.0),
    ("abc, B, lamp and sky", LONG_TAILS, "ball.bsdf.B.value", 1.0, 0.7, 24.0, 0.3),
    ("orennayar, sigma 0.4, lamp and sky", GROOVES, "ball.bsdf.sigma.value", 1.0, 0.7, 24.0, 0.3),
)
CLOSED = (*SHAPES[:6], *OTHERS, *SHAPES[7:])
#: label -> (methods, cases, what they differentiate by).
TABLES = {
    "resampled": ((psdr.interior.Resampled(),), SHAPES, "the shape of lobes"),
    "decomposed": ((psdr.interior.Decomposed(), psdr.interior.Resampled()), CLOSED, "lobes with closed forms"),
    "antithetic": ((psdr.interior.Antithetic(), psdr.interior.Resampled()), NORMALS, "what turns normals"),
}


def scene_of(material: dict, width: float, power: float, sky: float, size: int) -> psdr.Scene:
    """Return a scene."""
    t = psdr.Transform
    lamp = t.translate([0.5, -1.5, 3.0]) @ t.rotate([1, 0, 0], 180.0) @ t.scale(width)
    radiance = power / (2.0 * width) ** 2
    description = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 26.0,
            "to_world": t.look_at([0, -4, 1.2], [0, 0, 0.2], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "ball": {"type": "sphere", "bsdf": material},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": rgb(*3 * [radiance])}},
        "floor": {
            "type": "rectangle",
            "to_world": t.translate([0, 0, -1.0]) @ t.scale(4.0),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.6, 0.4, 0.3)},
        },
        "sky": {"type": "constant", "radiance": rgb(sky, sky, sky)},
    }
    return psdr.load_dict(description, device="cpu")


def main() -> None:
    """Run and print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--method", choices=TABLES, default="resampled", help="whose table")
    options = parser.parse_args()
    made, cases, by = TABLES[options.method]
    methods = {type(method).__name__.lower(): method for method in (psdr.interior.Replay(), *made)}
    size, spp, seeds = (64, 4, 8) if options.quick else (128, 16, 16)
    psdr.set_workers(options.threads)
    report = Report("glossy surfaces", options.output)
    rows = []
    for name, material, parameter, direction, width, power, sky in cases:
        scene = scene_of(material, width, power, sky, size)
        params = psdr.traverse(scene)
        params.requires_grad(parameter)
        integrators = {
            label: psdr.PathIntegrator(max_depth=DEPTH, interior=method, boundary=None)
            for label, method in methods.items()
        }
        adjoint = np.ones((size, size, 3), np.float32)
        variance = {}
        for first, (label, integrator) in enumerate(integrators.items()):
            images = [
                psdr.render_forward(
                    scene, params, {parameter: direction}, integrator=integrator, spp=spp, seed=2 * s + first
                ).numpy()
                for s in range(seeds)
            ]
            variance[label] = float(np.var(np.array(images, np.float64), axis=0, ddof=1).sum())

        def gradient(integrator, scene=scene, params=params, adjoint=adjoint):
            return lambda seed: psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=seed)

        times = in_turns({label: gradient(i) for label, i in integrators.items()}, options.repeat or 5)
        for label in list(methods)[1:]:
            noise, cost = variance["replay"] / variance[label], ratio(times, label, "replay", "cpu")
            found = {
                "variance at equal samples": noise,
                "time of a sample": cost,
                "variance at equal time": noise / cost,
            }
            rows.append({"case": name, **({"method": label} if len(methods) > 2 else {}), **found})
    report.table(f"Derivatives by {by}: a ball, {size} × {size} pixels, {spp} samples, depth {DEPTH}", rows)


if __name__ == "__main__":
    main()
