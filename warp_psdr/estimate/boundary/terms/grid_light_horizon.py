"""Vertices of grids of signed distances with interpolated normals whose surface turns away from a light of no area."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import secondary_silhouettes
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.shading_normals.grid_light_horizon import make_grid_light_horizon_kernel
from warp_psdr.kernels.constants import DELTA_LIGHTS
from warp_psdr.options.boundary import PathSpace
from warp_psdr.options.words import words
from warp_psdr.topology.grid_normals import interpolated_grids
from warp_psdr.topology.kinds.grid_silhouettes import grid_items, light_eyes, only
from warp_psdr.topology.kinds.grids import GRID, POSES


def applies(r: Request) -> bool:
    """Whether there are such lights, and anything moves."""
    return bool(DELTA_LIGHTS & set(r.config.lights.others)) and secondary_silhouettes.applies(GRID, r)


def launch(r: Request) -> Term | None:
    """Return the term of the edges of own shadows."""
    found = only(grid_items(r.scene, interpolated_grids(r.scene), light_eyes(r.scene, DELTA_LIGHTS)), False)
    if found is None or found.aimed == 0:
        return None
    kernel = make_grid_light_horizon_kernel(r.config, r.role, r.moves.camera, r.moves.light_pose)
    head = [r.scene.data(), r.camera, found]
    return term_of(r, TERM, kernel, head, secondary_silhouettes.samples_of(r, POSES))


TERM = BoundaryTerm(
    name="grid_light_horizon",
    title="own shadows of grids",
    stream=24,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    knows=words("material_points", "slides"),
)
