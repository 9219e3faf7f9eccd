"""Creases of grids of signed distances that other path vertices than the camera see from the front."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import foreground_grid
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.options.boundary import PathSpace


def launch(r: Request) -> Term | None:
    """Return the term of jumps of what grids send."""
    return foreground_grid.launch_foreground(r, TERM, True)


TERM = BoundaryTerm(
    name="shaded_grid",
    title="indirect creases of grids",
    stream=17,
    methods=(PathSpace,),
    launch=launch,
    applies=foreground_grid.applies,
    exact=True,
    recorded="secondary",
)
