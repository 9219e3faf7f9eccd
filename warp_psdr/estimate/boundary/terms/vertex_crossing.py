"""Path vertices on curves of intersection between shapes without triangles and other surfaces."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.crossing.vertex import make_vertex_crossing_kernel
from warp_psdr.options.boundary import PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.crossings import crossings


def applies(r: Request) -> bool:
    """Whether light can come from, or be scattered at, such a vertex, and anything moves."""
    if not r.config.surfaces.primitives or r.plan.max_depth == 1 or not r.scene.builder.emitters or not r.moves.edges:
        return False
    return (r.plan.max_depth != 2 or bool(r.config.lights.area)) and r.scatters_smoothly


def launch(r: Request) -> Term | None:
    """Return the term of the path vertices on curves, of which neither surface need move."""
    found = crossings(r.scene, None)
    if found is None:
        return None
    kernel = make_vertex_crossing_kernel(r.config, r.role, r.moves.camera, r.indirect)
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    head = [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)]
    return term_of(r, TERM, kernel, head, samples)


TERM = BoundaryTerm(
    name="vertex_crossing",
    title="{} curves of intersection of shapes without triangles",
    stream=51,
    methods=(PathSpace, Projective),
    launch=launch,
    applies=applies,
    splits=True,
    knows=words("material_points", "slides"),
)
