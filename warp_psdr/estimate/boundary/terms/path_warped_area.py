"""The motion of rays against the points that they find, along paths [XBLZ23]."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.warped_area.auxiliary import WarpedOptions
from warp_psdr.kernels.boundary.warped_area.path_warped_area import make_path_warped_area_kernel
from warp_psdr.options.boundary import PathWarpedArea
from warp_psdr.rows.replay import moved_request
from warp_psdr.rows.warped_area import compiled, kept_vertices


def launch(r: Request) -> Term:
    """Return the term."""
    assert isinstance(r.method, PathWarpedArea) and r.plan.wanted is not None
    most = kept_vertices(r.plan.max_depth)
    options = compiled(r.method)
    assert isinstance(options, WarpedOptions)
    kernel = make_path_warped_area_kernel(r.config, moved_request(r.plan.wanted), r.role, options, most)
    spp = r.method.spp_secondary or r.spp
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera], r.pixels * spp, count=spp)


TERM = BoundaryTerm(
    name="path_warped_area",
    title="rays that move",
    stream=41,
    methods=(PathWarpedArea,),
    launch=launch,
)
