"""Path vertices with interpolated normals whose own triangle turns away from light."""

from __future__ import annotations

import math

import warp as wp

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.shading_normals.geometric_horizon import make_geometric_horizon_kernel
from warp_psdr.kernels.boundary.shading_normals.media_horizon import make_media_horizon_kernel
from warp_psdr.options.boundary import EdgeSampling, PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.plan.discontinuities import GEOMETRIC_HORIZON
from warp_psdr.topology.interpolated_normals import interpolated_choice


def applies(r: Request) -> bool:
    """Whether a direction can meet light, and shapes move, where there are no media."""
    return r.config.media is None and GEOMETRIC_HORIZON.applies(r.asked)


def applies_in_media(r: Request) -> bool:
    """Whether a direction can meet light, and shapes move, where there are media."""
    return r.config.media is not None and GEOMETRIC_HORIZON.applies(r.asked)


def launch(r: Request) -> Term | None:
    """Return the term of path vertices with interpolated normals whose own triangle turns away from light."""
    kernel = make_geometric_horizon_kernel(r.config, r.role, r.moves.camera, r.indirect)
    return _term(r, ON_SURFACES, kernel)


def launch_in_media(r: Request) -> Term | None:
    """Return the same in media."""
    return _term(r, IN_MEDIA, make_media_horizon_kernel(r.config, r.role, r.moves.camera, r.moves.grids))


def _term(r: Request, term: BoundaryTerm, kernel: wp.Kernel) -> Term | None:
    found = interpolated_choice(r.scene)
    if found is None:
        return None
    cdf, faces, sine = found
    # What a sample is worth is in proportion to the sine; lights of small extent need more samples than that says.
    samples = math.ceil(r.pixels * (r.method.spp_secondary or r.spp) * math.sqrt(sine))
    return term_of(r, term, kernel, [r.scene.data(), r.camera, cdf, faces], samples)


ON_SURFACES = BoundaryTerm(
    name="geometric_horizon",
    title="{} horizons",
    stream=6,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch,
    applies=applies,
    knows=GEOMETRIC_HORIZON.knows,
    splits=True,
)
IN_MEDIA = BoundaryTerm(
    name="media_horizon",
    title="horizons in media",
    stream=63,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch_in_media,
    applies=applies_in_media,
    knows=words("media", "material_points"),
)
TERMS = {term.name: term for term in (ON_SURFACES, IN_MEDIA)}
