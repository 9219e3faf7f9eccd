"""A point on a silhouette edge as seen from a path vertex, and its density.

With q = D(omega) sin(phi) / t_1^2, where D is the mixture of lobes along the edge, the density per length is pdf_l = q
boost / scale.

Derivation: ``docs/theory/edge_sampling.md#edges-as-a-path-vertex-sees-them``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.edge_sampling.edge_tree import EdgeTrees, make_choose, whole_edge
from warp_psdr.kernels.boundary.edge_sampling.ltc_line import Lobes, mixture_density, sample_mixture
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, interior_side
from warp_psdr.kernels.rng import Sampler, independent_2d
from warp_psdr.kernels.structs import Scene

#: First sample slot of an edge: light, position along it, resampling.
SLOT_LIGHT, SLOT_ALONG, SLOT_CHOICE = 0, 1, 2


@wp.struct
class DrawnEdge:
    """A point of an edge, whose number is -1 if there is none, and the way there from a path vertex."""

    point: EdgePoint
    t1: wp.float32  # distance
    w: wp.vec3  # direction
    tangent: wp.vec3
    sine: wp.float32  # of the angle between both
    side: wp.float32  # of the plane through both, with the normal tangent x w, on which the edge's faces lie; or 0
    density: wp.float32  # pdf_l = density sine / (scale t1^2)
    scale: wp.float32


@functools.cache
def make_drawn_edge(tree: bool, candidates: int):
    """Return ``draw_edge(scene, edges, trees, lobes, x, sampler) -> DrawnEdge``; arguments as of ``make_choose``."""
    choose = make_choose(tree, candidates)

    @wp.func
    def draw_edge(
        scene: Scene, edges: Edges, trees: EdgeTrees, lobes: Lobes, x: wp.vec3, sampler: Sampler
    ) -> DrawnEdge:
        r = DrawnEdge()
        chosen = choose(scene, edges, trees, lobes, x, sampler, SLOT_CHOICE)
        if chosen.edge < 0:
            r.point.edge = -1
            return r
        point = whole_edge(scene, edges, chosen.edge)
        along = point.p1 - point.p0
        point.s = sample_mixture(lobes, point.p0 - x, along, independent_2d(sampler, SLOT_ALONG))
        point.x = point.p0 + point.s * along
        length = wp.length(along)
        r.t1 = wp.length(point.x - x)
        r.w = (point.x - x) / r.t1
        r.tangent = along / length
        m = wp.cross(r.tangent, r.w)
        r.sine = wp.length(m)
        r.side = interior_side(scene, edges, point, m, r.w)
        r.density = trees.boost[chosen.edge] * mixture_density(lobes, r.w)
        r.scale = chosen.scale
        r.point = point
        return r

    return draw_edge
