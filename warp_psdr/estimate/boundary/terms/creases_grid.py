"""Creases of grids of signed distances that the camera sees from the front, where the reflected light jumps."""

from __future__ import annotations

import math

from warp_psdr.estimate.boundary.terms import primary_grid
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.primary import make_primary_silhouette_kernel
from warp_psdr.options.boundary import PathSpace
from warp_psdr.topology.grid_silhouettes import camera_eyes, facing_creases, grid_shapes

#: Samples over the interior's (``docs/theory/implicit.md#shares-of-the-samples``): where single values move the
#: surface, and where a pose or the camera does.
SHARE_OF_VALUES, SHARE = 1.0 / 16.0, 1.0 / 4.0


def applies(r: Request) -> bool:
    """Whether light meets grids, and they or the camera move."""
    return primary_grid.applies(r) and r.lit


def launch(r: Request) -> Term | None:
    """Return the term of the creases that the camera sees."""
    shapes = [i for i in grid_shapes(r.scene, False) if r.moves.camera or i in r.moves.shapes]
    found = facing_creases(r.scene, shapes, camera_eyes(r.scene, r.sensor))
    if found is None:
        return None
    kernel = make_primary_silhouette_kernel(r.config, r.role, r.moves.camera, "grid creases")
    share = SHARE_OF_VALUES if r.moves.values else SHARE
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * share)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, found], samples)


TERM = BoundaryTerm(
    name="creases_grid",
    title="creases of grids",
    stream=16,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
    recorded="primary",
)
