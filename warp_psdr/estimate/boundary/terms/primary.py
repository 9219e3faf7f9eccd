"""Edges that the camera sees: silhouettes, borders and curves of intersection [LADL18]."""

from __future__ import annotations

import math

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, curves_of, film_edges_of, term_of
from warp_psdr.kernels.boundary.path_space.primary import make_primary_kernel
from warp_psdr.options.boundary import EdgeSampling, FilmEdges, PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.topology.clip_planes import require_uncut
from warp_psdr.topology.film_edges import primary_edges


def launch(r: Request) -> Term | None:
    """Return the term of the edges that the camera sees."""
    require_uncut(r.scene, r.sensor, set(r.moves.shapes), camera_moves=r.view_moves)
    found = film_edges_of(r)
    edges = primary_edges(r.scene, found, curves_of(r, camera_moves=r.view_moves))
    if edges is None:
        return None
    creases = 0.0 if r.config.material_first else found.share
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * (1.0 - creases))
    kernel = make_primary_kernel(r.config, r.role, r.moves.camera)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, edges], samples)


TERM = BoundaryTerm(
    name="primary",
    title="primary boundary",
    stream=0,
    methods=(PathSpace, Projective, EdgeSampling, FilmEdges),
    launch=launch,
    knows=words("material_points", "media", "slides", "transient"),
    recorded="primary",
)
