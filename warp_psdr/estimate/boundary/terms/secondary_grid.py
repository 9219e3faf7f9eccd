"""Creases and smooth silhouettes of grids of signed distances between two path vertices."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.grid_points import GridItems
from warp_psdr.kernels.boundary.silhouette.grid_secondary import make_secondary_grid_kernel
from warp_psdr.kernels.constants import PRIMITIVE_SDFGRID
from warp_psdr.options.boundary import PathSpace
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.grid_silhouettes import grid_items, grid_shapes, light_eyes, only


def applies(r: Request) -> bool:
    """Whether light is scattered beside grids, and anything moves."""
    return PRIMITIVE_SDFGRID in r.config.primitives and r.lit and r.moves.edges and r.scatters_smoothly


def launch_segments(r: Request, term: BoundaryTerm, cubic: bool) -> Term | None:
    """Return the term of linear grids, or of cubic ones."""
    eyes = light_eyes(r.scene)
    found = grid_items(r.scene, grid_shapes(r.scene, cubic), eyes)
    return launch_items(r, term, found if r.creases is None else only(found, r.creases), eyes == [], cubic)


def launch_items(
    r: Request, term: BoundaryTerm, found: GridItems | None, unlit: bool, cubic: bool, network: bool = False
) -> Term | None:
    """Return the term of items; ``unlit``: there is no light to aim at."""
    if found is None:
        return None
    found.share = 1.0 if found.aimed == 0 or unlit else r.own_share
    moves = r.moves
    kernel = make_secondary_grid_kernel(r.config, r.role, moves.camera, moves.light_pose, r.indirect, cubic, network)
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    return term_of(r, term, kernel, [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)], samples)


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes between two path vertices, neither of which need be on what moves."""
    return launch_segments(r, TERM, False)


TERM = BoundaryTerm(
    name="secondary_grid",
    title="{} silhouettes of grids",
    stream=14,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    splits=True,
    exact=True,
    part="both",
)
