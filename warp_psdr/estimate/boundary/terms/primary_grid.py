"""Creases and smooth silhouettes of grids of signed distances that the camera sees."""

from __future__ import annotations

import math

import warp as wp

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.grid_points import GridItems
from warp_psdr.kernels.boundary.silhouette.primary import make_primary_silhouette_kernel
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.options.boundary import PathSpace
from warp_psdr.topology.grid_contacts import require_uncut_grids
from warp_psdr.topology.grid_silhouettes import camera_eyes, grid_items, grid_shapes, only

#: Samples over the interior's (``docs/theory/implicit.md#shares-of-the-samples``): where single values move the
#: surface, and where a pose or the camera does.
SHARE_OF_VALUES, SHARE = 1.0 / 10.0, 1.0 / 4.0


def applies(r: Request) -> bool:
    """Whether there are grids, and they or the camera move."""
    return LINEAR_GRID.number in r.config.primitives and bool(r.moves.shapes or r.moves.camera)


def launch_silhouettes(r: Request, term: BoundaryTerm, cubic: bool) -> Term | None:
    """Return the term of linear grids, or of cubic ones."""
    shapes = [i for i in grid_shapes(r.scene, cubic) if r.moves.camera or i in r.moves.shapes]
    require_uncut_grids(r.scene, r.sensor, shapes)
    kernel = make_primary_silhouette_kernel(r.config, r.role, r.moves.camera, "cubic" if cubic else "grid")
    found = grid_items(r.scene, shapes, [camera_eyes(r.scene, r.sensor)])
    return launch_items(r, term, kernel, found if r.creases is None else only(found, r.creases))


def launch_items(r: Request, term: BoundaryTerm, kernel: wp.Kernel, found: GridItems | None) -> Term | None:
    """Return the term of those items that the camera may see a silhouette of."""
    if found is None or found.aimed == 0:
        return None
    found.items = found.items[: found.aimed]
    share = SHARE_OF_VALUES if r.moves.values else SHARE
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * share)
    return term_of(r, term, kernel, [r.scene.data(), r.camera, found], samples)


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes that the camera sees."""
    return launch_silhouettes(r, TERM, False)


TERM = BoundaryTerm(
    name="primary_grid",
    title="primary silhouettes of grids",
    stream=13,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
    part="both",
    recorded="primary",
)
