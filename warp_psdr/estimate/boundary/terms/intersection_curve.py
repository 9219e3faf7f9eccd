"""Path vertices on curves of intersection."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, curves_of, term_of
from warp_psdr.kernels.boundary.path_space.intersection_curve import make_intersection_curve_kernel
from warp_psdr.kernels.boundary.path_space.media_intersection_curve import make_media_intersection_curve_kernel
from warp_psdr.options.boundary import EdgeSampling, PathSpace, Projective
from warp_psdr.plan.discontinuities import INTERSECTION_CURVE
from warp_psdr.topology.edges import curve_edges


def applies(r: Request) -> bool:
    """Whether light can come from, or be scattered at, such a vertex."""
    return r.config.media is None and INTERSECTION_CURVE.applies(r.asked)


def applies_in_media(r: Request) -> bool:
    """Whether rays in media can end on such a curve."""
    return r.config.media is not None and INTERSECTION_CURVE.applies(r.asked)


def launch(r: Request) -> Term | None:
    """Return the term of path vertices on curves of intersection."""
    edges = curve_edges(r.scene, curves_of(r, camera_moves=False))
    if edges is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    kernel = make_intersection_curve_kernel(r.config, r.role, r.moves.camera, r.indirect)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, edges], samples)


def launch_in_media(r: Request) -> Term | None:
    """Return the term of rays in media that end on curves of intersection."""
    edges = curve_edges(r.scene, curves_of(r, camera_moves=False))
    if edges is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    kernel = make_media_intersection_curve_kernel(r.config, r.role, r.moves.camera, r.moves.grids)
    return term_of(r, IN_MEDIA, kernel, [r.scene.data(), r.camera, edges], samples)


TERM = BoundaryTerm(
    name="intersection_curve",
    title="{} curves of intersection",
    stream=3,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch,
    applies=applies,
    splits=True,
    knows=INTERSECTION_CURVE.knows,
)
IN_MEDIA = BoundaryTerm(
    name="media_intersection_curve",
    title="curves of intersection in media",
    stream=64,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch_in_media,
    applies=applies_in_media,
    knows=INTERSECTION_CURVE.knows,
)
TERMS = {term.name: term for term in (TERM, IN_MEDIA)}
