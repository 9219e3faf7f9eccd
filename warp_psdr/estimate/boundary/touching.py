"""Segments between two path vertices that touch shapes without triangles, with or without guiding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import warp as wp

from warp_psdr import compiler
from warp_psdr.estimate.guiding import store
from warp_psdr.estimate.guiding.grid import surface_ends
from warp_psdr.estimate.guiding.intervals import Intervals, Listing
from warp_psdr.estimate.guiding.structure import TECHNIQUES, Space
from warp_psdr.kernels.boundary.guiding.slots import Slots
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.options.guiding import Grid

if TYPE_CHECKING:
    from warp_psdr.estimate.boundary.terms import Request

#: Pieces, about, that the first coordinate is cut into before anything is known of the integrand, whatever the number
#: of shapes: a single one is measured in as many places as a mesh's edges are.
PIECES = 1024


class Maker(Protocol):
    """A factory of kernels with the scene, the camera and the indirect flag of a request."""

    def __call__(self, role: str, camera_moves: bool, light_pose: bool, guided: bool) -> wp.Kernel:
        """Return the kernel."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Touched:
    """What is known of what a term's segments touch.

    Attributes:
        record: the device's, which receives the slots of items that come and go.
        listed: technique -> its items, where they come and go: grids and curves.
        seeds: technique -> (N, 3) points of the cube near which segments carry light; None: not known.
        unlit: there is no light to aim at.
    """

    record: Any = None
    listed: dict[str, Listing] = field(default_factory=dict)
    seeds: Callable[[str], np.ndarray] | None = None
    unlit: bool = False


def guided_kernel(
    r: Request,
    name: str,
    make: Maker,
    head: list,
    items: int,
    cdf: np.ndarray | None = None,
    touched: Touched | None = None,
) -> tuple[wp.Kernel, Guide]:
    """Return the kernel of a term of shapes without triangles, or of edges in media, and what guides it.

    Args:
        r: what is asked for.
        name: of the term.
        make: its kernels.
        head: their arguments in front of the guide.
        items: among which the first coordinate chooses.
        cdf: (items + 1,) where they begin along it; None: all have the same share of it.
        touched: what more is known of the items.
    """
    guiding = getattr(r.method, "guiding", None)
    kernel = make(r.role, r.moves.camera, r.moves.light_pose, guiding is not None)
    if guiding is None:
        return kernel, Guide()
    evaluating = [make(role, False, False, False) for role in ("target", "ends")[: 1 + isinstance(guiding, Grid)]]
    compiler.begin([*evaluating, kernel], r.scene.device)
    known = touched or Touched()
    regular = _pieces(np.linspace(0.0, 1.0, items + 1)) if cdf is None else cdf

    def space(intervals: dict[str, Intervals]) -> Space:
        if known.listed:
            known.record.slots = _upload(r, known.listed, intervals)
        return Space(
            kernel=evaluating[0],
            head=head,
            cdf={t: _pieces(intervals[t].cdf) if t in intervals else regular for t in TECHNIQUES},
            facing=None,
            ends=lambda technique, points: surface_ends(r, evaluating[-1], head, technique, points),
            seeds=known.seeds,
            unlit=known.unlit,
        )

    return kernel, store.guide_surfaces(r, guiding, name, space, known.listed)


def _pieces(cdf: np.ndarray) -> np.ndarray:
    """Return boundaries of about as many pieces as ``PIECES``, with those between items."""
    count = len(cdf) - 1
    parts = -(-PIECES // count)
    return np.interp(np.arange(count * parts + 1) / parts, np.arange(count + 1), cdf)


def _upload(r: Request, listed: dict[str, Listing], intervals: dict[str, Intervals]) -> Slots:
    slots = Slots()
    for technique, name in (("wedge", "own"), ("light", "light")):
        order = listed[technique].order().astype(np.int32)
        setattr(slots, name, wp.array(order, dtype=wp.int32, device=r.scene.device))
        cdf = wp.array(intervals[technique].cdf, dtype=wp.float64, device=r.scene.device)
        setattr(slots, f"{name}_cdf", cdf)
    return slots
