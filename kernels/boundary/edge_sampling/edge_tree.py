"""Choice of a silhouette edge as seen from a point: two hierarchies, split samples and resampling [LADL18, section 5].

One hierarchy holds edges by position (3-D), the other by position and face planes (6-D, Hough space [OZ06]). Nodes
without silhouettes are skipped. The other nodes share M samples in proportion to their estimated integrals, and one of
the edges that are reached is kept in proportion to Q(e) / p(e), without bias.

Derivation: ``docs/theory/edge_sampling.md#two-hierarchies``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.edge_sampling.ltc_line import Lobe, Lobes, mixture_integral
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, interior_side
from warp_psdr.kernels.constants import INV_FOUR_PI, INV_PI
from warp_psdr.kernels.distribution import find_interval
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.rng import Sampler, independent_1d
from warp_psdr.kernels.step import LEAVE, largest_coordinate
from warp_psdr.kernels.structs import Scene

#: Most samples that travel through the trees together: [LADL18] split 16 ways. Also the length of the stack.
MAX_SPLIT = 16
#: Least probability of a child that may hold silhouettes: the estimates of nodes are rough.
MIN_PROBABILITY = 0.01

NUMBERS = wp.types.vector(length=MAX_SPLIT, dtype=wp.int32)
PROBABILITIES = wp.types.vector(length=MAX_SPLIT, dtype=wp.float32)


@wp.struct
class EdgeNode:
    """Bounds of a set of edges, and of the planes of their faces."""

    center: wp.vec3
    half: wp.vec3
    n_center: wp.vec3
    n_half: wp.vec3
    d_low: wp.float32
    d_high: wp.float32
    weight: wp.float32
    left: wp.int32  # children; a leaf: -1 - number of its edge
    right: wp.int32


@wp.struct
class EdgeTrees:
    """Both trees. Node 0 is the root; ``boost``: factor of an edge's weight by what moves."""

    nodes: wp.array(dtype=EdgeNode)
    boost: wp.array(dtype=wp.float32)


@wp.struct
class ResampledEdge:
    """A resampled edge, -1: none. Drawn by q within it, a point has the density q boost / scale per length."""

    edge: wp.int32
    scale: wp.float32


@wp.func
def lobe_estimate(lobe: Lobe, w: wp.vec3, cosine: wp.float32, sine: wp.float32) -> wp.float32:
    """Estimate a lobe's largest density in a cone about w; positive unless the cone lies behind the lobe."""
    if lobe.share <= 0.0:
        return 0.0
    c = wp.clamp(wp.dot(w, lobe.z), -1.0, 1.0)
    if c < cosine:
        c = c * cosine + wp.sqrt(1.0 - c * c) * sine
    else:
        c = wp.float32(1.0)
    if c <= 0.0:
        return 0.0
    s2 = lobe.sx * lobe.sy
    r2 = 1.0 - c * c + s2 * c * c
    return lobe.share * INV_PI * c * s2 / (r2 * r2)


@wp.func
def may_hold_silhouette(node: EdgeNode, x: wp.vec3) -> wp.bool:
    """Whether the bounds allow an edge whose faces x lies on different sides of; n_half has room for roundings."""
    y = x - node.center
    middle = wp.dot(node.n_center, y)
    spread = wp.dot(node.n_half, wp.abs(y))
    return middle - spread <= node.d_high and middle + spread >= node.d_low


@wp.func
def node_importance(node: EdgeNode, lobes: Lobes, x: wp.vec3) -> wp.float32:
    """Estimate the node's part of the integral; 0 only where it holds nothing."""
    to = node.center - x
    n = lobes.cosine.z
    if lobes.sphere == 0.0 and wp.dot(n, to) + wp.dot(wp.abs(n), node.half) <= 0.0:
        return 0.0
    if not may_hold_silhouette(node, x):
        return 0.0
    squared = wp.dot(to, to)
    radius2 = wp.dot(node.half, node.half)
    w = n
    cosine = wp.float32(-1.0)
    sine = wp.float32(0.0)
    if squared > radius2:
        w = to / wp.sqrt(squared)
        sine = wp.sqrt(radius2 / squared)
        cosine = wp.sqrt(1.0 - radius2 / squared)
    value = lobe_estimate(lobes.cosine, w, cosine, sine)
    value += lobe_estimate(lobes.glossy, w, cosine, sine)
    value += lobe_estimate(lobes.light, w, cosine, sine)
    value += INV_FOUR_PI * lobes.sphere
    return node.weight * value / wp.max(squared, radius2)


@wp.func
def whole_edge(scene: Scene, edges: Edges, edge: wp.int32) -> EdgePoint:
    """Return an edge with its first end as the point."""
    r = EdgePoint()
    r.edge = edge
    r.p0 = load_vec3(scene.values, scene.positions + 3 * edges.ends[edge, 0])
    r.p1 = load_vec3(scene.values, scene.positions + 3 * edges.ends[edge, 1])
    r.x = r.p0
    return r


@wp.func
def on_own_plane(scene: Scene, edges: Edges, edge: wp.int32, x: wp.vec3) -> wp.bool:
    """Whether x lies on the plane of one of the edge's faces, to float32's rounding."""
    largest = wp.max(wp.abs(x))
    for i in range(edges.first[edge], edges.first[edge + 1]):
        tri = scene.triangles[edges.faces[i]]
        if wp.abs(wp.dot(tri.normal, tri.p0 - x)) <= LEAVE * wp.max(largest, largest_coordinate(tri)):
            return True
    return False


@wp.func
def edge_importance(
    scene: Scene, edges: Edges, trees: EdgeTrees, lobes: Lobes, x: wp.vec3, edge: wp.int32
) -> wp.float32:
    """Q(e) as seen from x; 0 for what is no silhouette.

    From a point of a face its own edges and those of faces in its plane are none, and no rounding may make them so:
    they pass x as closely as can be, and Q is one over that distance.
    """
    at = whole_edge(scene, edges, edge)
    along = at.p1 - at.p0
    a = at.p0 - x
    if interior_side(scene, edges, at, wp.cross(along, a), a) == 0.0 or on_own_plane(scene, edges, edge, x):
        return 0.0
    return trees.boost[edge] * mixture_integral(lobes, a, along)


@functools.cache
def make_choose(tree: bool, candidates: int):
    """Return ``choose(scene, edges, trees, lobes, x, sampler, slot) -> ResampledEdge``.

    Args:
        tree: samples travel through the trees; otherwise they are drawn by length times (pi - dihedral angle).
        candidates: M, how many samples are resampled; with the trees at most MAX_SPLIT.
    """

    @wp.func
    def choose_flat(
        scene: Scene, edges: Edges, trees: EdgeTrees, lobes: Lobes, x: wp.vec3, sampler: Sampler, slot: wp.int32
    ) -> ResampledEdge:
        r = ResampledEdge()
        r.edge = -1
        total = wp.float32(0.0)
        count = edges.cdf.shape[0] - 1
        for i in range(candidates):
            edge = find_interval(edges.cdf, 0, count, independent_1d(sampler, slot + 2 * i))
            w = edge_importance(scene, edges, trees, lobes, x, edge) / (edges.cdf[edge + 1] - edges.cdf[edge])
            total += w
            if independent_1d(sampler, slot + 2 * i + 1) * total < w:
                r.edge = edge
        r.scale = total / wp.float32(candidates)
        return r

    @wp.func
    def choose_by_tree(
        scene: Scene, edges: Edges, trees: EdgeTrees, lobes: Lobes, x: wp.vec3, sampler: Sampler, slot: wp.int32
    ) -> ResampledEdge:
        r = ResampledEdge()
        r.edge = -1
        total = wp.float32(0.0)
        pending = NUMBERS()
        samples = NUMBERS()
        probabilities = PROBABILITIES()
        samples[0] = candidates
        probabilities[0] = 1.0
        top = wp.int32(1)
        draw = wp.int32(slot)
        while top > 0:
            top -= 1
            node = pending[top]
            m = samples[top]
            p = probabilities[top]
            while m > 0:
                left = trees.nodes[node].left
                right = trees.nodes[node].right
                u = independent_1d(sampler, draw)
                draw += 1
                if left < 0:
                    edge = -1 - left
                    w = wp.float32(m) * edge_importance(scene, edges, trees, lobes, x, edge) / p
                    total += w
                    if u * total < w:
                        r.edge = edge
                    m = wp.int32(0)
                else:
                    a = node_importance(trees.nodes[left], lobes, x)
                    b = node_importance(trees.nodes[right], lobes, x)
                    if a + b <= 0.0:
                        m = wp.int32(0)
                    else:
                        p_left = a / (a + b)
                        m_left = wp.int32(m)
                        if b > 0.0:
                            if a > 0.0:
                                p_left = wp.clamp(p_left, MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)
                            m_left = wp.int32(wp.float32(m) * p_left + u)
                        m_right = m - m_left
                        if m_left > 0 and m_right > 0:
                            pending[top] = right
                            samples[top] = m_right
                            probabilities[top] = p * (1.0 - p_left)
                            top += 1
                        if m_left > 0:
                            node = left
                            m = m_left
                            p = p * p_left
                        else:
                            node = right
                            p = p * (1.0 - p_left)
        r.scale = total / wp.float32(candidates)
        return r

    return choose_by_tree if tree else choose_flat
