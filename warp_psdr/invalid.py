"""Samples that were dropped because they were not finite: counted by kind, reported once a call, never silent.

Kernels count what they drop (``kernels/invalid.py``). A launch draws samples of one kind, and each of its shards has a
counter of its own. The counts stay with the scene. A right scene has none, so a call that met some warns: it says how
many of how many, and which was the first, whose path ``psdr.trace_sample`` prints.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np
import warp as wp

from warp_psdr.device import move_on, shared_copy
from warp_psdr.kernels.invalid import COUNTER_SIZE
from warp_psdr.kernels.lanes.lanes import QUEUE_ROOM, ROOM

if TYPE_CHECKING:
    from warp_psdr.kernels import structs
    from warp_psdr.scene.scene import Scene

P = ParamSpec("P")
R = TypeVar("R")

#: Kinds of samples: paths of the image and of the interior term, the terms of the boundary term by the names of
#: ``estimate/boundary/terms``, evaluations of the integrand that guiding follows, and paths from the lights.
KINDS = (
    "image",
    "interior",
    "primary",
    "primary_silhouette",
    "flat_creases",
    "creases",
    "terminator",
    "secondary",
    "secondary_silhouette",
    "primary_grid",
    "creases_grid",
    "grid_terminator",
    "secondary_grid",
    "foreground_grid",
    "shaded_grid",
    "grid_indirect_terminator",
    "grid_horizon",
    "grid_light_horizon",
    "media_secondary",
    "media_silhouette",
    "primary_tubes",
    "secondary_tubes",
    "foreground_tubes",
    "primary_cubic",
    "secondary_cubic",
    "foreground_cubic",
    "primary_network",
    "secondary_network",
    "foreground_network",
    "intersection_curve",
    "film_crossing",
    "vertex_crossing",
    "media_vertex_crossing",
    "indirect_terminator",
    "geometric_horizon",
    "media_horizon",
    "edge_sampling",
    "media_edge_sampling",
    "hard_shadows",
    "media_hard_shadows",
    "through_mirrors",
    "texture_steps",
    "sliding_steps",
    "film_tube_steps",
    "vertex_tube_steps",
    "media_intersection_curve",
    "light_frame",
    "film_border",
    "path_warped_area",
    "guiding",
    "light",
)
#: Kinds whose samples are not drawn again.
NUMBERED = ("guiding", "light")
#: Kinds whose samples belong to a pixel.
TRACED = ("image", "interior")


@dataclass
class Count:
    """Samples of one kind.

    Attributes:
        samples: how many were drawn.
        invalid: how many contributions were dropped.
        first: the first of the last launch that dropped any: (x, y, index) of a pixel's, (number, index) of another.
    """

    samples: int = 0
    invalid: int = 0
    first: tuple[int, ...] = ()


class Ledger:
    """What a scene's launches counted; ``Scene.invalid``."""

    def __init__(self) -> None:
        self.counts = {kind: Count() for kind in KINDS}

    def add(self, kind: str, samples: int, invalid: int, first: tuple[int, ...] = ()) -> None:
        """Add a launch."""
        count = self.counts[kind]
        count.samples += samples
        count.invalid += invalid
        if invalid:
            count.first = first

    def drop(self, kind: str, values: np.ndarray) -> np.ndarray:
        """Return host values with 0 in place of those that are not finite, which are counted."""
        valid = np.isfinite(values)
        self.add(kind, values.size, int(values.size - valid.sum()))
        return np.where(valid, values, 0.0)

    def snapshot(self) -> dict[str, tuple[int, int]]:
        """Return (samples, invalid) of every kind."""
        return {kind: (c.samples, c.invalid) for kind, c in self.counts.items()}


def invalid_samples(scene: Scene, *, reset: bool = False) -> dict[str, int]:
    """Return how many samples were not finite, and therefore dropped, by kind.

    A sample of the interior term counts if the radiance that it needs (``kernels/interior/replay.py``), or any of its
    derivatives, is not finite; in reverse mode it loses those derivatives, in forward mode all of it is dropped. One of
    a boundary term counts for each of its contributions that is dropped.

    Args:
        scene: a loaded scene.
        reset: start counting anew.

    Returns:
        Kind -> number since the scene was loaded, or since the last reset, over all renderings and gradients of it:
        "image", "interior", the terms of the boundary ("primary", "secondary", ...) and "guiding" (evaluations of its
        integrand) and "light" (paths from the lights). All are 0 for a scene within the range of float32.
    """
    counts = {kind: c.invalid for kind, c in scene.invalid.counts.items()}
    if reset:
        scene.invalid = Ledger()
    return counts


@contextlib.contextmanager
def counting(
    scene: Scene, kind: str, samples: int, shards: int, raster: tuple[int, int] | None = None
) -> Iterator[Callable[[structs.Scene, int], structs.Scene]]:
    """Count the samples that the launches inside drop.

    Args:
        scene: the scene.
        kind: one of ``KINDS``.
        samples: how many are drawn.
        shards: launches that may run side by side.
        raster: (width, margin) of the raster whose pixels name the samples; None: they have plain numbers.

    Yields:
        (record of the scene, shard) -> the record that this shard has to pass to its kernels.
    """
    counters = wp.zeros((shards, COUNTER_SIZE), dtype=wp.int64, device=scene.device)
    rows = wp.empty((shards, (ROOM + QUEUE_ROOM) * scene.accelerator.width), dtype=wp.uint32, device=scene.device)
    records: list[structs.Scene | None] = [None] * shards
    first_shard: list[structs.Scene] = []

    def of_shard(data: structs.Scene, shard: int) -> structs.Scene:
        record = records[shard]
        if record is None:
            if not first_shard:
                template = shared_copy(data)
                template.invalid, template.rows = counters[0], rows[0]
                first_shard.append(template)
            record = shared_copy(first_shard[0])
            move_on(record, "invalid", shard * counters.strides[0])
            move_on(record, "rows", shard * rows.strides[0])
            records[shard] = record
        return record

    yield of_shard
    found = counters.numpy()
    first: tuple[int, ...] = ()
    hit = found[found[:, 0] > 0]
    if len(hit):
        pixel, index = (int(n) for n in hit[0, 1:])
        first = (pixel, index)
        if raster is not None:
            width, margin = raster
            first = (pixel % width - margin, pixel // width - margin, index)
    scene.invalid.add(kind, samples, int(found[:, 0].sum()), first)


def warns(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function that renders a scene warn about the samples that it dropped; its first parameter is the scene."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        bound = signature.bind(*args, **kwargs)
        scene: Scene = bound.arguments["scene"]
        ledger = getattr(scene, "invalid", None)
        before = ledger.snapshot() if ledger is not None else {}
        result = function(*args, **kwargs)
        if ledger is not None:
            _warn(ledger, before, bound.arguments.get("seed", 0))
        return result

    return wrapped


def _warn(ledger: Ledger, before: dict[str, tuple[int, int]], seed: int) -> None:
    found = []
    for kind, count in ledger.counts.items():
        samples, invalid = count.samples - before[kind][0], count.invalid - before[kind][1]
        if invalid:
            share = invalid / max(samples, 1)
            found.append(f"{kind}: {invalid} of {samples} ({share:.2g}){_name(kind, count, seed)}")
    if found:
        message = (
            f"samples that were not finite were dropped, which biases the result: {'; '.join(found)}. Look for values "
            "beyond the range of float32 (huge or tiny sizes, radiances, indices), for degenerate triangles there, and "
            "for light behind more surfaces that let it pass than are crossed (32; 64 in scenes with media); in those "
            "also for rays that meet a shape which has another medium on that side: name the medium that the sensor is "
            "in, and the exterior of what lies in a medium"
        )
        warnings.warn(message, RuntimeWarning, stacklevel=4)


def _name(kind: str, count: Count, seed: int) -> str:
    if kind in TRACED:
        x, y, index = count.first
        return (
            f", the first: pixel ({x}, {y}), sample {index}; print(psdr.trace_sample(scene, pixel=({x}, {y}), "
            f"sample={index}, seed={seed}, kind={kind!r}, ...)) shows its path"
        )
    if not count.first:
        return ""
    number = count.first[0]
    if kind in NUMBERED:
        return f", the first: number {number}"
    return (
        f", the first: number {number}; print(psdr.trace_sample(scene, sample={number}, seed={seed}, kind={kind!r}, "
        "params=params, ...)) shows its edge and paths"
    )
