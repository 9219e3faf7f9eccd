"""Drivers of the boundary term: its launches over samples, in reverse and in forward mode."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr import workers
from warp_psdr.boundary.terms import Term, terms
from warp_psdr.device import launch, launch_lanes
from warp_psdr.kernels.reduction import add_images

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Images of forward mode's lanes together hold at most this many floats (64 MB).
LANE_IMAGE_FLOATS = 1 << 24


def backward(
    scene: Scene, plan, names: list[str], adjoint: wp.array, buffers: wp.array, *, sensor: int, spp: int, seed: int
) -> None:
    """Add the gradient of the boundary term to the lanes' flat buffers.

    Args:
        scene: the scene.
        plan: with the method in ``boundary``.
        names: what is differentiated.
        adjoint: (H, W) of vec3.
        buffers: (lanes, values).
        sensor: which camera.
        spp: samples a pixel of the interior term.
        seed: of the boundary term's stream.
    """
    launch_backward(scene, terms(scene, plan, names, "reverse", sensor, spp, seed), adjoint, buffers)


def launch_backward(scene: Scene, found: list[Term], adjoint: wp.array, buffers: wp.array) -> None:
    """Add the gradient of some terms to the lanes' flat buffers."""
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)

    def arguments(term: Term, first: int, _count: int, lane: int) -> tuple[list, list]:
        return term.inputs(first, adjoint), [buffers[lane], dummy]

    for term in found:
        launch_lanes(term.kernel, term.samples, partial(arguments, term), lanes=buffers.shape[0], device=scene.device)


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

    def arguments(term: Term, first: int, _count: int, lane: int) -> tuple[list, list]:
        return term.inputs(first, dummy), [tangents, images[lane]]

    for term in found:
        launch_lanes(term.kernel, term.samples, partial(arguments, term), lanes=lanes, device=scene.device)
    launch(add_images, dim=(height, width), inputs=[images], outputs=[image], device=scene.device)
