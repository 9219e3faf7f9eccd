"""Shadow edges of point, spot and directional lights alone, in media."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import hard_shadows
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.path_space.media_secondary import make_media_secondary_kernel
from warp_psdr.options.boundary import EdgeSampling
from warp_psdr.options.words import words
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.edges_there import secondary_edges_there


def applies(r: Request) -> bool:
    """Whether there is such a light, and edges, lights or the camera move."""
    return r.config.media is not None and r.moves.edges and hard_shadows.applies(r)


def launch(r: Request) -> Term | None:
    """Return the term of the shadow edges of point, spot and directional lights, of what is there."""
    edges = secondary_edges_there(r.scene, set(r.moves.shapes))
    if edges is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    deep = r.plan.max_depth != 2
    kernel = make_media_secondary_kernel(r.config, r.role, r.moves.camera, r.moves.light_pose, deep, r.moves.grids)
    # No share of the wedge: every sample goes to a light.
    head = [hard_shadows.point_like_lights(r), r.camera, edges, moving_shapes(r.scene, r.moves), Guide()]
    return term_of(r, TERM, kernel, head, samples)


TERM = BoundaryTerm(
    name="media_hard_shadows",
    title="hard shadows in media",
    stream=11,
    methods=(EdgeSampling,),
    launch=launch,
    applies=applies,
    knows=words("media"),
)
