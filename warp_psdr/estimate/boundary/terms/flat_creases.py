"""Creases between flat faces that the camera sees side by side."""

from __future__ import annotations

import math

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, film_edges_of, term_of
from warp_psdr.kernels.boundary.path_space.flat_creases import make_flat_creases_kernel
from warp_psdr.options.boundary import EdgeSampling, PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.topology.film_edges import flat_crease_edges


def applies(r: Request) -> bool:
    """Whether surfaces scatter light, and the points beside creases do not stay on them."""
    if r.config.material_first:
        return False
    return r.config.scatter and bool(r.scene.builder.emitters) and r.scatters_smoothly


def launch(r: Request) -> Term | None:
    """Return the term of creases between flat faces that the camera sees side by side."""
    found = film_edges_of(r)
    edges = flat_crease_edges(r.scene, found)
    if edges is None:
        return None
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * found.share)
    kernel = make_flat_creases_kernel(r.config, r.role, r.moves.camera)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, edges], samples)


TERM = BoundaryTerm(
    name="flat_creases",
    title="flat creases",
    stream=8,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch,
    applies=applies,
    knows=words("material_points", "slides", "transient"),
    recorded="primary",
)
