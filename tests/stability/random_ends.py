"""Renders and differentiates scenes with random numbers of which three in eight are 0, 1/2 or the largest below 1.

Run as a program, in a process of its own: ``python -m tests.stability.random_ends SCENE... METHOD...`` takes names of
``tests/boundary``'s scenes and of METHODS. What real numbers meet once in 10^7 samples, these meet in most: directions
along a surface or an edge, the rims of lobes and wedges, ends of edges. Prints the samples that were not finite.
"""

import json
import sys
import warnings

import numpy as np
import warp as wp

import warp_psdr as psdr
from tests.boundary import mirrors, scenes, test_bent, test_curves, test_horizon  # noqa: F401  register scenes
from warp_psdr.kernels import rng

METHODS = {
    "unguided": psdr.boundary.PathSpace(),
    "kdtree": psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree(max_leaves=64)),
    "edge": psdr.boundary.EdgeSampling(),
    "projective": psdr.boundary.Projective(),
}
SPP, DEPTH = 16, 3
MOVED = ("vertex_positions", "to_world", "reflectance.value", "alpha.value", "radiance.value")


@wp.func
def ends_float(bits: wp.uint32) -> wp.float32:
    """``rng.unit_float``, or an end by the bits that it does not use."""
    kind = bits & wp.uint32(7)
    if kind == wp.uint32(0):
        return 0.0
    if kind == wp.uint32(1):
        return 0.99999994
    if kind == wp.uint32(2):
        return 0.5
    return wp.float32(bits >> wp.uint32(8)) * rng.UNIT


def replace_numbers() -> None:
    """Let every kernel that is built from now on draw them."""
    for module in list(sys.modules.values()):
        if getattr(module, "__name__", "").startswith("warp_psdr") and hasattr(module, "unit_float"):
            module.unit_float = ends_float


def invalid(name: str, method: str) -> dict[str, int]:
    """Return the number of samples that were not finite, by kind, of image and reverse and forward gradients."""
    scene = psdr.load_dict({"type": "scene", **scenes.SCENES[name]()})
    params = psdr.traverse(scene)
    names = [n for n in params if n.endswith(MOVED)]
    integrator = psdr.PathIntegrator(max_depth=DEPTH, boundary=METHODS[method], sampler="independent")
    options = {"integrator": integrator, "spp": SPP}
    params.requires_grad(*names)
    image = psdr.render(scene, params, **options).numpy()
    psdr.render_backward(scene, params, np.ones_like(image), **options)
    random = np.random.default_rng(1)
    tangents = {n: random.normal(size=params[n].numpy().shape) for n in names}
    derivative = psdr.render_forward(scene, params, tangents, **options).numpy()
    assert all(np.isfinite(params[n].grad.numpy()).all() for n in names)
    assert np.isfinite(derivative).all() and derivative.any() and image.any()
    return {kind: count for kind, count in psdr.invalid_samples(scene).items() if count}


def main() -> None:
    replace_numbers()
    warnings.simplefilter("ignore")
    methods = [a for a in sys.argv[1:] if a in METHODS]
    found = {f"{a}, {m}": invalid(a, m) for a in sys.argv[1:] if a not in METHODS for m in methods}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
