"""Smooth silhouettes of cubic grids of signed distances that the camera sees."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import primary_grid
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.options.boundary import PathSpace


def applies(r: Request) -> bool:
    """Whether there are such grids, and they or the camera move."""
    return CUBIC_GRID.number in r.config.primitives and bool(r.moves.shapes or r.moves.camera)


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes that the camera sees."""
    return primary_grid.launch_silhouettes(r, TERM, True)


TERM = BoundaryTerm(
    name="primary_cubic",
    title="primary silhouettes of cubic grids",
    stream=30,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
    part="smooth",
    recorded="primary",
)
