"""Edges inside of interpolated normals that the camera sees: light may reach one side only."""

from __future__ import annotations

import math

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, film_edges_of, term_of
from warp_psdr.kernels.boundary.path_space.primary import make_primary_kernel
from warp_psdr.options.boundary import EdgeSampling, PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.topology.film_edges import crease_edges


def applies(r: Request) -> bool:
    """Whether there are interpolated normals, surfaces scatter light, and points do not stay beside creases."""
    if r.config.material_first:
        return False
    return r.config.surfaces.smooth and r.config.scatter and bool(r.scene.builder.emitters) and r.scatters_smoothly


def launch(r: Request) -> Term | None:
    """Return the term of edges inside of interpolated normals that the camera sees: light may reach one side only."""
    found = crease_edges(r.scene, film_edges_of(r))
    if found is None:
        return None
    edges, sine = found
    # The variance is in proportion to the sine: jumps are, on a band of edges as wide; there are the more edges.
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * math.sqrt(sine))
    kernel = make_primary_kernel(r.config, r.role, r.moves.camera)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, edges], samples)


TERM = BoundaryTerm(
    name="creases",
    title="smooth creases",
    stream=7,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch,
    applies=applies,
    knows=words("material_points", "slides", "media", "transient"),
)
