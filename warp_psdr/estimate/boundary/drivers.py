"""Drivers of the boundary term: its launches over samples, in reverse and in forward mode."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch_shards
from warp_psdr.estimate.arguments import MOST_SAMPLES
from warp_psdr.estimate.boundary.terms import Term
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.passes import Progress, part
from warp_psdr.invalid import counting

if TYPE_CHECKING:
    from warp_psdr.estimate.gradient_sums import GradientSums
    from warp_psdr.scene.scene import Scene

#: All samples of a term.
ALL = Draw(1)
#: Samples of a launch beside shapes without triangles: to prepare one takes as long as some hundred samples.
LEAST = 1024


def launch_backward(
    scene: Scene,
    found: list[Term],
    adjoint: wp.array,
    sums: GradientSums,
    draw: Draw = ALL,
    progress: Progress | None = None,
) -> None:
    """Add the gradient of some terms.

    Args:
        scene: the scene.
        found: its terms, of role "reverse".
        adjoint: (H, W) of vec3.
        sums: what it is added to.
        draw: which of their samples are drawn.
        progress: called with the finished fraction.
    """
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    for term, reported in _reporting(found, progress):
        shards = _shards(scene, term, sums.shards)
        outputs = functools.partial(_reverse, sums, shards, dummy)
        _run(scene, term, adjoint, outputs, shards, draw, reported)


def launch_forward(
    scene: Scene,
    found: list[Term],
    tangents: wp.array,
    shape: tuple[int, int],
    draw: Draw = ALL,
    progress: Progress | None = None,
) -> wp.array:
    """Return the derivative of some terms, of role "forward", along flat tangents, an image (H, W) of vec3."""
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    height, width = shape
    most = workers.shard_count(3 * height * width) if scene.device.is_cpu else 1
    own = draw.share.of(most) if scene.device.is_cpu else range(1)
    images = wp.zeros((max(len(own), 1), height, width), dtype=wp.vec3, device=scene.device)
    for term, reported in _reporting(found, progress):
        shards = _shards(scene, term, most)
        outputs = functools.partial(_forward, images, most // shards, own.start, tangents)
        _run(scene, term, dummy, outputs, shards, draw, reported)
    return workers.tree_sum(images)


def _reverse(sums: GradientSums, shards: int, unused: wp.array, shard: int) -> list:
    return [sums.buffer(shard, shards), unused]


def _forward(images: wp.array, step: int, first: int, tangents: wp.array, shard: int) -> list:
    return [tangents, images[shard * step - first]]


def launch_samples(scene: Scene, term: Term, adjoint: wp.array, records: wp.array) -> None:
    """Write the record of every sample of a term of role "samples"."""
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    _run(scene, term, adjoint, lambda _shard: [records, dummy], 1, ALL)


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


def _shards(scene: Scene, term: Term, most: int) -> int:
    """Return how many shards a term's launches are dealt out to: few samples are not worth many launches."""
    return min(most, workers.below(max(term.samples // LEAST, 1))) if scene.builder.primitives else most


def _run(
    scene: Scene,
    term: Term,
    adjoint: wp.array,
    outputs: Callable[[int], list],
    shards: int,
    draw: Draw,
    progress: Progress | None = None,
) -> None:
    """Launch the samples of a term; ``outputs``: of a shard."""
    begin, count = draw.of_term(_checked(term).samples)
    least = LEAST if scene.builder.primitives else workers.MIN_CHUNK
    with counting(scene, term.kind, count, shards) as of_shard:

        def arguments(first: int, _count: int, shard: int) -> tuple[list, list]:
            data, *rest = term.inputs(begin + first, adjoint)
            return [of_shard(data, shard), *rest], outputs(shard)

        launch_shards(
            term.kernel,
            count,
            arguments,
            shards=shards,
            device=scene.device,
            progress=progress,
            least=least,
            share=draw.share,
        )
