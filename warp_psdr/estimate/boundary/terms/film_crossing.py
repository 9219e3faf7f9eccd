"""Curves of intersection between shapes without triangles and other surfaces, as the camera sees them."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.crossing.film import make_film_crossing_kernel
from warp_psdr.options.boundary import PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.topology.crossings import crossings


def applies(r: Request) -> bool:
    """Whether there are such shapes, and they, what runs through them, or the camera move.

    Properties do not jump there: both surfaces pass through the point, and normals are those of meshes.
    """
    return not r.config.shown and bool(r.config.surfaces.primitives) and bool(r.moves.shapes or r.moves.camera)


def launch(r: Request) -> Term | None:
    """Return the term of the curves that the camera sees."""
    found = crossings(r.scene, None if r.moves.camera else r.moves.shapes)
    if found is None:
        return None
    kernel = make_film_crossing_kernel(r.config, r.role, r.moves.camera)
    samples = r.pixels * (r.method.spp_primary or r.spp)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, found], samples)


TERM = BoundaryTerm(
    name="film_crossing",
    title="curves of intersection of shapes without triangles",
    stream=50,
    methods=(PathSpace, Projective),
    launch=launch,
    applies=applies,
    knows=words("material_points", "slides", "media"),
)
