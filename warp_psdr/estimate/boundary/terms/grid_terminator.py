"""Curves where interpolated normals of grids of signed distances turn away from the camera."""

from __future__ import annotations

import math

from warp_psdr.estimate.boundary.terms import creases_grid
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.shading_normals.grid_terminator import make_grid_terminator_kernel
from warp_psdr.options.boundary import PathSpace
from warp_psdr.options.words import words
from warp_psdr.topology.grid_normals import interpolated_grids, turned_items
from warp_psdr.topology.kinds.grid_silhouettes import camera_eyes
from warp_psdr.topology.kinds.grids import PRIMARY


def launch(r: Request) -> Term | None:
    """Return the term of the curves where interpolated normals turn away from the camera."""
    shapes = [i for i in interpolated_grids(r.scene) if r.moves.camera or i in r.moves.shapes]
    found = turned_items(r.scene, shapes, camera_eyes(r.scene, r.sensor))
    if found is None:
        return None
    kernel = make_grid_terminator_kernel(r.config, r.role, r.moves.camera)
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * PRIMARY.pose)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, found], samples)


TERM = BoundaryTerm(
    name="grid_terminator",
    title="terminators of grids",
    stream=21,
    methods=(PathSpace,),
    launch=launch,
    applies=creases_grid.applies,
    knows=words("material_points", "slides"),
)
