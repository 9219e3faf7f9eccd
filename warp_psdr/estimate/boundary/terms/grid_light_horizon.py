"""Vertices of grids of signed distances with interpolated normals whose surface turns away from a light of no area."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import foreground_grid, secondary_grid
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.kernels.boundary.shading_normals.grid_light_horizon import make_grid_light_horizon_kernel
from warp_psdr.kernels.constants import DELTA_LIGHTS
from warp_psdr.options.boundary import PathSpace
from warp_psdr.topology.grid_normals import interpolated_grids
from warp_psdr.topology.grid_silhouettes import grid_items, light_eyes, only


def applies(r: Request) -> bool:
    """Whether there are such lights, and anything moves."""
    return bool(DELTA_LIGHTS & set(r.config.lights)) and secondary_grid.applies(r)


def launch(r: Request) -> Term | None:
    """Return the term of the edges of own shadows."""
    found = only(grid_items(r.scene, interpolated_grids(r.scene), light_eyes(r.scene, DELTA_LIGHTS)), False)
    if found is None or found.aimed == 0:
        return None
    kernel = make_grid_light_horizon_kernel(r.config, r.role, r.moves.camera, r.moves.light_pose)
    return foreground_grid.launch_with(r, TERM, kernel, [r.scene.data(), r.camera, found], foreground_grid.SHARE)


TERM = BoundaryTerm(
    name="grid_light_horizon",
    title="own shadows of grids",
    stream=24,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
)
