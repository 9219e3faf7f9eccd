"""Curves where interpolated normals turn away from the camera."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.shading_normals.terminator import make_terminator_kernel
from warp_psdr.options.boundary import EdgeSampling, PathSpace, Projective
from warp_psdr.plan.discontinuities import TERMINATOR
from warp_psdr.topology.interpolated_normals import terminator_faces


def applies(r: Request) -> bool:
    """Whether surfaces scatter."""
    return TERMINATOR.applies(r.asked)


def launch(r: Request) -> Term | None:
    """Return the term of the curves where interpolated normals turn away from the camera."""
    shapes = set(r.moves.shapes | r.moves.normals)
    found = terminator_faces(r.scene, r.sensor, shapes, camera_moves=r.moves.camera)
    if found is None:
        return None
    samples = r.pixels * (r.method.spp_primary or r.spp)
    kernel = make_terminator_kernel(r.config, r.role, r.moves.camera)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, *found], samples)


TERM = BoundaryTerm(
    name="terminator",
    title="terminators",
    stream=2,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch,
    applies=applies,
    knows=TERMINATOR.knows,
)
