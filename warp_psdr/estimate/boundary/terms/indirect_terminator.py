"""Curves where interpolated normals turn away from other path vertices."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.shading_normals.indirect_terminator import make_indirect_terminator_kernel
from warp_psdr.kernels.boundary.shading_normals.media_indirect_terminator import (
    make_media_indirect_terminator_kernel,
)
from warp_psdr.options.boundary import EdgeSampling, PathSpace, Projective
from warp_psdr.plan.discontinuities import INDIRECT_TERMINATOR
from warp_psdr.topology.interpolated_normals import interpolated_choice


def applies(r: Request) -> bool:
    """Whether paths have more than one vertex that scatters, and vertices move against each other."""
    return INDIRECT_TERMINATOR.applies(r.asked)


def launch(r: Request) -> Term | None:
    """Return the term of the curves where interpolated normals turn away from other path vertices."""
    found = interpolated_choice(r.scene)
    if found is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    if r.config.media is None:
        kernel = make_indirect_terminator_kernel(r.config, r.role, r.moves.camera)
    else:
        kernel = make_media_indirect_terminator_kernel(r.config, r.role, r.moves.camera, r.moves.grids)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, *found[:2]], samples)


TERM = BoundaryTerm(
    name="indirect_terminator",
    title="indirect shading terminator",
    stream=4,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch,
    applies=applies,
    knows=INDIRECT_TERMINATOR.knows,
)
