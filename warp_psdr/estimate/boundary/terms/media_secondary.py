"""Shadow edges in media: surfaces, and points of the medium, lose light."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import OWN_SHARE, OWN_SHARE_DIRECT, BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.path_space.media_secondary import make_media_secondary_kernel
from warp_psdr.options.boundary import PathSpace
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.edges_there import secondary_edges_there


def applies(r: Request) -> bool:
    """Whether light is scattered, and edges, lights or the camera move."""
    return r.config.media is not None and r.lit and r.moves.edges


def launch(r: Request) -> Term | None:
    """Return the term of the edges of what is there."""
    edges = secondary_edges_there(r.scene, set(r.moves.shapes))
    if edges is None:
        return None
    deep = r.plan.max_depth != 2
    kernel = make_media_secondary_kernel(r.config, r.role, r.moves.camera, r.moves.light_pose, deep, r.moves.grids)
    guide = Guide()
    guide.share = OWN_SHARE if r.scene.builder.environment >= 0 else OWN_SHARE_DIRECT
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, edges, moving_shapes(r.scene, r.moves), guide], samples)


TERM = BoundaryTerm(
    name="media_secondary",
    title="shadows in media",
    stream=11,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    media=True,
)
