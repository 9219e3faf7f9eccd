"""Light that cubic grids of signed distances send past their silhouettes to path vertices other than the camera."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import foreground_grid, secondary_cubic
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.options.boundary import PathSpace


def applies(r: Request) -> bool:
    """Whether paths are long enough for light that is scattered by a grid and then by another surface."""
    return secondary_cubic.applies(r) and foreground_grid.slides(r)


def launch(r: Request) -> Term | None:
    """Return the term of what a grid sends beside its silhouettes."""
    return foreground_grid.launch_foreground(r, TERM, False, True)


TERM = BoundaryTerm(
    name="foreground_cubic",
    title="silhouettes of cubic grids, in front",
    stream=32,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
    part="smooth",
    recorded="secondary",
)
