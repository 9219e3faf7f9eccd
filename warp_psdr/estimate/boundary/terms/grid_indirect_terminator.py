"""Curves where interpolated normals of grids of signed distances turn away from other path vertices."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import foreground_grid
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.kernels.boundary.shading_normals.grid_indirect_terminator import make_grid_indirect_terminator_kernel
from warp_psdr.options.boundary import PathSpace
from warp_psdr.topology.grid_normals import interpolated_grids, turned_items


def launch(r: Request) -> Term | None:
    """Return the term of the curves where interpolated normals turn away from other path vertices."""
    found = turned_items(r.scene, interpolated_grids(r.scene), None)
    if found is None:
        return None
    kernel = make_grid_indirect_terminator_kernel(r.config, r.role, r.moves.camera)
    head = [r.scene.data(), r.camera, found]
    return foreground_grid.launch_with(r, TERM, kernel, head, foreground_grid.SHARE)


TERM = BoundaryTerm(
    name="grid_indirect_terminator",
    title="indirect shading terminators of grids",
    stream=22,
    methods=(PathSpace,),
    launch=launch,
    applies=foreground_grid.applies,
    exact=True,
)
