"""Vertices of grids of signed distances with interpolated normals whose surface turns away from light."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import secondary_silhouettes
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.shading_normals.grid_horizon import make_grid_horizon_kernel
from warp_psdr.options.boundary import PathSpace
from warp_psdr.options.words import words
from warp_psdr.topology.grid_normals import interpolated_grids, turned_items
from warp_psdr.topology.kinds.grids import GRID, POSES


def applies(r: Request) -> bool:
    """Whether a direction can meet light beside grids, and anything moves."""
    if not secondary_silhouettes.applies(GRID, r):
        return False
    # Light of no area is never met by a direction.
    kinds = {e.kind for e in r.scene.builder.emitters}
    return bool(kinds if r.plan.max_depth != 2 else kinds - c.DELTA_LIGHTS)


def launch(r: Request) -> Term | None:
    """Return the term of vertices whose surface turns away from light."""
    found = turned_items(r.scene, interpolated_grids(r.scene), None)
    if found is None:
        return None
    kernel = make_grid_horizon_kernel(r.config, r.role, r.moves.camera, r.indirect)
    head = [r.scene.data(), r.camera, found]
    return term_of(r, TERM, kernel, head, secondary_silhouettes.samples_of(r, POSES))


TERM = BoundaryTerm(
    name="grid_horizon",
    title="{} horizons of grids",
    stream=23,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    knows=words("material_points", "slides"),
    splits=True,
)
