"""Path vertices with interpolated normals whose own triangle turns away from light."""

from __future__ import annotations

import math

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.shading_normals.geometric_horizon import make_geometric_horizon_kernel
from warp_psdr.options.boundary import EdgeSampling, PathSpace, Projective
from warp_psdr.plan.discontinuities import GEOMETRIC_HORIZON
from warp_psdr.topology.interpolated_normals import interpolated_choice


def applies(r: Request) -> bool:
    """Whether a direction can meet light, and shapes move."""
    return GEOMETRIC_HORIZON.applies(r.asked)


def launch(r: Request) -> Term | None:
    """Return the term of path vertices with interpolated normals whose own triangle turns away from light."""
    found = interpolated_choice(r.scene)
    if found is None:
        return None
    cdf, faces, sine = found
    # What a sample is worth is in proportion to the sine; lights of small extent need more samples than that says.
    samples = math.ceil(r.pixels * (r.method.spp_secondary or r.spp) * math.sqrt(sine))
    kernel = make_geometric_horizon_kernel(r.config, r.role, r.moves.camera, r.indirect)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, cdf, faces], samples)


TERM = BoundaryTerm(
    name="geometric_horizon",
    title="{} horizons",
    stream=6,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch,
    applies=applies,
    knows=GEOMETRIC_HORIZON.knows,
    splits=True,
)
