"""Creases of grids of signed distances that the camera sees from the front, where the reflected light jumps."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import primary_silhouettes
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.primary import make_primary_silhouette_kernel
from warp_psdr.options.boundary import PathSpace
from warp_psdr.options.words import words
from warp_psdr.topology.kinds.family import Shares
from warp_psdr.topology.kinds.grid_silhouettes import camera_eyes, facing_creases
from warp_psdr.topology.kinds.grids import GRID

SHARES = Shares(values=1.0 / 16.0, pose=1.0 / 4.0)


def applies(r: Request) -> bool:
    """Whether light meets grids, and they or the camera move."""
    return primary_silhouettes.applies(GRID, r) and r.lit


def launch(r: Request) -> Term | None:
    """Return the term of the creases that the camera sees."""
    found = facing_creases(r.scene, primary_silhouettes.moving(GRID, r), camera_eyes(r.scene, r.sensor))
    if found is None:
        return None
    kernel = make_primary_silhouette_kernel(r.config, r.role, r.moves.camera, "grid creases")
    samples = primary_silhouettes.samples_of(r, SHARES)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, found], samples)


TERM = BoundaryTerm(
    name="creases_grid",
    title="creases of grids",
    stream=16,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    knows=words("material_points", "slides"),
    recorded="primary",
)
