"""Smooth silhouettes of cubic grids of signed distances between two path vertices."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import secondary_grid
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.options.boundary import PathSpace


def applies(r: Request) -> bool:
    """Whether light is scattered beside such grids, and anything moves."""
    return CUBIC_GRID.number in r.config.primitives and r.lit and r.moves.edges and r.scatters_smoothly


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes between two path vertices, neither of which need be on what moves."""
    return secondary_grid.launch_segments(r, TERM, True)


TERM = BoundaryTerm(
    name="secondary_cubic",
    title="{} silhouettes of cubic grids",
    stream=31,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    splits=True,
    guided=True,
    exact=True,
    part="smooth",
    recorded="secondary",
)
