"""Smooth silhouettes and rims of shapes without triangles that the camera sees."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.exact_touch import OutlineItems
from warp_psdr.kernels.boundary.silhouette.primary import make_primary_silhouette_kernel
from warp_psdr.kernels.primitive.table import affine_of
from warp_psdr.options.boundary import PathSpace, Projective
from warp_psdr.topology.exact_shapes import require_uncut
from warp_psdr.topology.joined_rims import outlines


def applies(r: Request) -> bool:
    """Whether there are such shapes, and they or the camera move."""
    return bool(affine_of(r.config.primitives)) and bool(r.moves.shapes or r.moves.camera)


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes that the camera sees."""
    found = outlines(r.scene, None if r.moves.camera else r.moves.shapes)
    if found is None:
        return None
    require_uncut(r.scene, r.sensor, None if r.moves.camera else r.moves.shapes)
    kernel = make_primary_silhouette_kernel(r.config, r.role, r.moves.camera, "exact")
    items = OutlineItems()
    items.items = found
    samples = r.pixels * (r.method.spp_primary or r.spp)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, items], samples)


TERM = BoundaryTerm(
    name="primary_silhouette",
    title="primary silhouettes of exact shapes",
    stream=9,
    methods=(PathSpace, Projective),
    launch=launch,
    applies=applies,
    exact=True,
    part="smooth",
    recorded="primary",
)
