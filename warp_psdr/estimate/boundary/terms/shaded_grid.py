"""Creases of grids of signed distances that other path vertices than the camera see from the front."""

from __future__ import annotations

import functools

from warp_psdr.estimate.boundary.terms import foreground_silhouettes
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.options.boundary import PathSpace
from warp_psdr.options.words import words
from warp_psdr.topology.kinds.family import Shares
from warp_psdr.topology.kinds.grid_silhouettes import grid_items, only
from warp_psdr.topology.kinds.grids import GRID

SHARES = Shares(values=1.0 / 24.0, pose=1.0 / 8.0)


def launch(r: Request) -> Term | None:
    """Return the term of jumps of what grids send."""
    found = grid_items(r.scene, GRID.shapes(r.scene), [], concave=True)
    found = found if r.creases is None else only(found, r.creases)
    return foreground_silhouettes.launch_items(r, TERM, "grid creases", found, SHARES)


TERM = BoundaryTerm(
    name="shaded_grid",
    title="indirect creases of grids",
    stream=17,
    methods=(PathSpace,),
    launch=launch,
    applies=functools.partial(foreground_silhouettes.applies, GRID),
    knows=words("material_points", "slides"),
    recorded="secondary",
)
