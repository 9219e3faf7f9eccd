"""Drivers of the boundary term: its launches over samples, in reverse and in forward mode."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch, launch_lanes
from warp_psdr.estimate.arguments import MOST_SAMPLES
from warp_psdr.estimate.boundary.terms import Term, terms
from warp_psdr.invalid import counting
from warp_psdr.kernels.reduction import add_images

if TYPE_CHECKING:
    from warp_psdr.estimate.gradient_sums import GradientSums
    from warp_psdr.scene.scene import Scene

#: Images of forward mode's lanes together hold at most this many floats (64 MB).
LANE_IMAGE_FLOATS = 1 << 24


def backward(
    scene: Scene, plan, names: list[str], adjoint: wp.array, sums: GradientSums, *, sensor: int, spp: int, seed: int
) -> None:
    """Add the gradient of the boundary term.

    Args:
        scene: the scene.
        plan: with the method in ``boundary``.
        names: what is differentiated.
        adjoint: (H, W) of vec3.
        sums: what it is added to.
        sensor: which camera.
        spp: samples a pixel of the interior term.
        seed: of the boundary term's stream.
    """
    launch_backward(scene, terms(scene, plan, names, "reverse", sensor, spp, seed), adjoint, sums)


def launch_backward(scene: Scene, found: list[Term], adjoint: wp.array, sums: GradientSums) -> None:
    """Add the gradient of some terms."""
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    buffers = sums.buffers
    for term in found:
        _run(scene, term, adjoint, lambda lane: [buffers[lane], dummy], len(buffers))


def forward(
    scene: Scene, plan, names: list[str], tangents: wp.array, image: wp.array, *, sensor: int, spp: int, seed: int
) -> None:
    """Add the derivative of the boundary term along flat tangents to an image (arguments as in ``backward``)."""
    launch_forward(scene, terms(scene, plan, names, "forward", sensor, spp, seed), tangents, image)


def launch_forward(scene: Scene, found: list[Term], tangents: wp.array, image: wp.array) -> None:
    """Add the derivative of some terms along flat tangents to an image."""
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    height, width = image.shape
    lanes = max(2, min(workers.LANES, LANE_IMAGE_FLOATS // (3 * height * width))) if scene.device.is_cpu else 1
    images = wp.zeros((lanes, height, width), dtype=wp.vec3, device=scene.device)
    for term in found:
        _run(scene, term, dummy, lambda lane: [tangents, images[lane]], lanes)
    launch(add_images, dim=(height, width), inputs=[images], outputs=[image], device=scene.device)


def launch_samples(scene: Scene, term: Term, adjoint: wp.array, records: wp.array) -> None:
    """Write the record of every sample of a term of role "samples"."""
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    _run(scene, term, adjoint, lambda _lane: [records, dummy], 1)


def _checked(term: Term) -> Term:
    if term.samples > MOST_SAMPLES:
        raise ValueError(
            f"the boundary term {term.kind!r} has {term.samples} samples, expected at most {MOST_SAMPLES}; lower its "
            "samples a pixel (or spp) and average the gradients of several seeds"
        )
    return term


def _run(scene: Scene, term: Term, adjoint: wp.array, outputs: Callable[[int], list], lanes: int) -> None:
    """Launch the samples of a term; ``outputs``: of a lane."""
    count = _checked(term).samples
    with counting(scene, term.kind, count, lanes) as of_lane:

        def arguments(first: int, _count: int, lane: int) -> tuple[list, list]:
            data, *rest = term.inputs(first, adjoint)
            return [of_lane(data, lane), *rest], outputs(lane)

        launch_lanes(term.kernel, count, arguments, lanes=lanes, device=scene.device)
