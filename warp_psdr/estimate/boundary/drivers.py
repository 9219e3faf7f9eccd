"""Drivers of the boundary term: its launches over samples, in reverse and in forward mode."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch, launch_shards
from warp_psdr.estimate.arguments import MOST_SAMPLES
from warp_psdr.estimate.boundary.terms import Term
from warp_psdr.estimate.passes import Progress, part
from warp_psdr.invalid import counting
from warp_psdr.kernels.reduction import add_images

if TYPE_CHECKING:
    from warp_psdr.estimate.gradient_sums import GradientSums
    from warp_psdr.scene.scene import Scene

#: Samples of a launch beside shapes without triangles: to prepare one takes as long as some hundred samples.
LEAST = 1024
#: Images of forward mode's shards together hold at most this many floats (64 MB).
SHARD_IMAGE_FLOATS = 1 << 24


def launch_backward(
    scene: Scene, found: list[Term], adjoint: wp.array, sums: GradientSums, progress: Progress | None = None
) -> None:
    """Add the gradient of some terms.

    Args:
        scene: the scene.
        found: its terms, of role "reverse".
        adjoint: (H, W) of vec3.
        sums: what it is added to.
        progress: called with the finished fraction.
    """
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    buffers = sums.buffers
    for term, reported in _reporting(found, progress):
        _run(scene, term, adjoint, lambda shard: [buffers[shard], dummy], len(buffers), reported)


def launch_forward(
    scene: Scene, found: list[Term], tangents: wp.array, image: wp.array, progress: Progress | None = None
) -> None:
    """Add the derivative of some terms, of role "forward", along flat tangents to an image."""
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    height, width = image.shape
    shards = max(2, min(workers.SHARDS, SHARD_IMAGE_FLOATS // (3 * height * width))) if scene.device.is_cpu else 1
    images = wp.zeros((shards, height, width), dtype=wp.vec3, device=scene.device)
    for term, reported in _reporting(found, progress):
        _run(scene, term, dummy, lambda shard: [tangents, images[shard]], shards, reported)
    launch(add_images, dim=(height, width), inputs=[images], outputs=[image], device=scene.device)


def launch_samples(scene: Scene, term: Term, adjoint: wp.array, records: wp.array) -> None:
    """Write the record of every sample of a term of role "samples"."""
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    _run(scene, term, adjoint, lambda _shard: [records, dummy], 1)


def _reporting(found: list[Term], progress: Progress | None) -> Iterator[tuple[Term, Progress | None]]:
    """Yield every term with what reports its finished fraction, by samples, as that of all of them."""
    done, total = 0, sum(term.samples for term in found)
    for term in found:
        yield term, part(progress, done / total, term.samples / total)
        done += term.samples


def _checked(term: Term) -> Term:
    if term.samples > MOST_SAMPLES:
        raise ValueError(
            f"the boundary term {term.kind!r} has {term.samples} samples, expected at most {MOST_SAMPLES}; lower its "
            "samples a pixel (or spp) and average the gradients of several seeds"
        )
    return term


def _run(
    scene: Scene,
    term: Term,
    adjoint: wp.array,
    outputs: Callable[[int], list],
    shards: int,
    progress: Progress | None = None,
) -> None:
    """Launch the samples of a term; ``outputs``: of a shard."""
    count = _checked(term).samples
    least = LEAST if scene.builder.primitives else workers.MIN_CHUNK
    with counting(scene, term.kind, count, shards) as of_shard:

        def arguments(first: int, _count: int, shard: int) -> tuple[list, list]:
            data, *rest = term.inputs(first, adjoint)
            return [of_shard(data, shard), *rest], outputs(shard)

        launch_shards(term.kernel, count, arguments, shards=shards, device=scene.device, progress=progress, least=least)
