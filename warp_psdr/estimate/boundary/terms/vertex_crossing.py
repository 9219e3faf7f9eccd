"""Path vertices on curves of intersection between shapes without triangles and other surfaces."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.crossing.media_vertex import make_media_crossing_kernel
from warp_psdr.kernels.boundary.crossing.vertex import make_vertex_crossing_kernel
from warp_psdr.options.boundary import PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.plan.discontinuities import INTERSECTION_CURVE
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


def applies_in_media(r: Request) -> bool:
    """Whether rays in media can end on such a curve, and one of its shapes moves."""
    return bool(r.config.media is not None and r.config.surfaces.primitives and r.moves.shapes) and (
        INTERSECTION_CURVE.applies(r.asked)
    )


def launch_in_media(r: Request) -> Term | None:
    """Return the term of rays in media that end on curves which move."""
    found = crossings(r.scene, r.moves.shapes)
    if found is None:
        return None
    kernel = make_media_crossing_kernel(r.config, r.role, r.moves.camera, r.moves.grids)
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    return term_of(r, IN_MEDIA, kernel, [r.scene.data(), r.camera, found], samples)


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
IN_MEDIA = BoundaryTerm(
    name="media_vertex_crossing",
    title="curves of intersection of exact shapes in media",
    stream=69,
    methods=(PathSpace, Projective),
    launch=launch_in_media,
    applies=applies_in_media,
    knows=words("material_points", "media"),
)
TERMS = {term.name: term for term in (TERM, IN_MEDIA)}
