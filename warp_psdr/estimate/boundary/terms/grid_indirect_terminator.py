"""Curves where interpolated normals of grids of signed distances turn away from other path vertices."""

from __future__ import annotations

import functools

from warp_psdr.estimate.boundary.terms import foreground_silhouettes, secondary_silhouettes
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.shading_normals.grid_indirect_terminator import make_grid_indirect_terminator_kernel
from warp_psdr.options.boundary import PathSpace
from warp_psdr.options.words import words
from warp_psdr.topology.grid_normals import interpolated_grids, turned_items
from warp_psdr.topology.kinds.grids import GRID, POSES


def launch(r: Request) -> Term | None:
    """Return the term of the curves where interpolated normals turn away from other path vertices."""
    found = turned_items(r.scene, interpolated_grids(r.scene), None)
    if found is None:
        return None
    kernel = make_grid_indirect_terminator_kernel(r.config, r.role, r.moves.camera)
    head = [r.scene.data(), r.camera, found]
    return term_of(r, TERM, kernel, head, secondary_silhouettes.samples_of(r, POSES))


TERM = BoundaryTerm(
    name="grid_indirect_terminator",
    title="indirect shading terminators of grids",
    stream=22,
    methods=(PathSpace,),
    launch=launch,
    applies=functools.partial(foreground_silhouettes.applies, GRID),
    knows=words("material_points", "slides"),
)
