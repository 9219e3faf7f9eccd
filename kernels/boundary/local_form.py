"""The local form of the boundary term, which all of its estimators share.

A boundary segment x_1 -> x_b -> x_2 touches an edge at x_b, at the distance t_1 = |x_b - x_1| of d = |x_2 - x_1|; tau =
t_1 / d. Let W_1 and L_2 be the importance and the radiance past the occluder, n the normal of the plane through edge
and segment, and phi the angle between them. Then dI = W_1 . L_2 . n . ( x_b' - (1 - tau) x_1' - tau x_2' ) sin(phi) dl
dsigma.

Derivation: ``docs/theory/boundary.md#local-form``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.pull_record import record_pull
from warp_psdr.kernels.boundary.silhouette.edge_on import EDGEWISE, is_beside
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.distribution import find_interval_64
from warp_psdr.kernels.sink import make_sink_vec3
from warp_psdr.kernels.step import passing_step
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.texture.steps import make_slide_sink, place_gradient, place_slopes

#: Squared sine of the angle between two faces below which they count as parallel when a seam's velocity is split.
SEAM_PARALLEL = 1.0e-4
#: A half-segment starts this many ray epsilons behind the edge point, so that a surface that touches the edge is met.
START_BEHIND = 20.0
#: The same where the ray epsilon is the least step (``kernels/step.py``), which is precious: roundings of what touches.
START_BEHIND_LEAST = 4.0
#: A surface counts as that of a point within this many ray epsilons of its plane, if it is met this near: what lies
#: far behind a plane seen edge-on is in it, too.
ON_PLANE, NEAR = 0.5, 2000.0
#: Sine of the angle between the normals of two triangles below which one continues the other: roundings of corners.
#: Needles that meet in a point, as at the pole of a sphere, are turned by little more, and have edges of their own.
IN_PLANE = 1.0e-4
#: Sine of the angle between a face and light up to which they are parallel: some roundings of normals.
PARALLEL = 1.0e-5
#: ``Edges.ends`` of what has no vertices: a curve in which two faces run through each other; a step of a texture.
CURVE, STEP = wp.constant(-1), wp.constant(-2)


@wp.struct
class Edges:
    """Candidate edges, of position-welded vertices. ``ends`` and ``twins`` are the vertices of the first two faces.

    On a seam the two sides have vertices of their own at the same positions; elsewhere the pairs are equal. A curve in
    which two faces run through each other is an edge without vertices: ``ends`` and ``twins`` are CURVE. A line on one
    face along which a texture jumps (``texture/steps.py``) has STEP and the texture's number in ``ends``, STEP and the
    axis of its place in ``twins``.
    """

    cdf: wp.array(dtype=wp.float32)  # cumulative selection probabilities, n + 1
    points: wp.array2d(dtype=wp.vec3)  # (n, 2) where it starts and ends
    ends: wp.array2d(dtype=wp.int32)  # (n, 2) global vertex indices
    twins: wp.array2d(dtype=wp.int32)
    faces: wp.array(dtype=wp.int32)  # adjacent triangles of all edges
    first: wp.array(dtype=wp.int32)  # where an edge's triangles start, n + 1
    low: wp.array(dtype=wp.float32)  # stretch of the edge that is sampled, in [0, 1]
    high: wp.array(dtype=wp.float32)
    # Of every triangle, its part of its mesh: parts share no edge. One zero where nobody asks.
    parts: wp.array(dtype=wp.int32)
    # Of every triangle, bit k: its side from corner k on is among the edges. One zero where nobody asks.
    sides: wp.array(dtype=wp.int32)
    # Edges of other shapes that run along an edge, and where its own start, n + 1. One zero where nobody asks.
    beside: wp.array(dtype=wp.int32)
    beside_first: wp.array(dtype=wp.int32)


@wp.struct
class EdgePoint:
    """A sampled point of an edge."""

    sample: wp.int32  # its number
    edge: wp.int32
    s: wp.float32  # fraction of the way from its first to its second end
    pdf: wp.float32  # density of s
    p0: wp.vec3
    p1: wp.vec3
    x: wp.vec3


@wp.func
def edge_point(scene: Scene, edges: Edges, sample: wp.int32, samples: wp.int32, jitter: wp.float32) -> EdgePoint:
    """Stratified point on the edges."""
    r = edge_at(scene, edges, (wp.float64(sample) + wp.float64(jitter)) / wp.float64(samples))
    r.sample = sample
    return r


@wp.func
def edge_at(scene: Scene, edges: Edges, u: wp.float64) -> EdgePoint:
    """Point on the edges at a coordinate u in [0, 1) of their cumulative distribution.

    One number for the edge and for the position along it, in double precision: the cumulative probabilities are
    multiples of 2^-24, so what a single float would lose at 10^5 edges stays exact.
    """
    r = EdgePoint()
    low = find_interval_64(edges.cdf, 0, edges.cdf.shape[0] - 1, u)
    r.edge = low
    probability = edges.cdf[low + 1] - edges.cdf[low]
    along = wp.clamp(wp.float32((u - wp.float64(edges.cdf[low])) / wp.float64(probability)), 0.0, 1.0)
    stretch = edges.high[low] - edges.low[low]
    r.s = edges.low[low] + along * stretch
    r.pdf = probability / stretch
    r.p0 = edges.points[low, 0]
    r.p1 = edges.points[low, 1]
    r.x = (1.0 - r.s) * r.p0 + r.s * r.p1
    return r


@wp.func
def edge_step(scene: Scene, edges: Edges, edge: wp.int32) -> wp.float32:
    """The ray epsilon at an edge, world units (``kernels/step.py``)."""
    if scene.least_step <= 0.0:
        return scene.ray_epsilon
    r = wp.float32(0.0)
    for i in range(edges.first[edge], edges.first[edge + 1]):
        r = wp.max(r, passing_step(scene, edges.faces[i]))
    return r


@wp.func
def edge_behind(scene: Scene, step: wp.float32) -> wp.float32:
    """How far behind an edge point, where the ray epsilon is ``step``, half-segments start."""
    if scene.least_step <= 0.0:
        return START_BEHIND * step
    return wp.max(START_BEHIND * (step - scene.least_step), START_BEHIND_LEAST * step)


@wp.func
def to_third(tri: Triangle, point: EdgePoint) -> wp.vec3:
    """Way from the first end of an edge of a triangle to its third corner, plus the edge."""
    return (tri.p0 - point.p0) + (tri.p1 - point.p0) + (tri.p2 - point.p0)


@wp.func
def one_side(above: wp.int32, below: wp.int32) -> wp.float32:
    """The side on which all faces lie of which so many lie above and below, else 0."""
    if below == 0:
        return 1.0
    if above == 0:
        return -1.0
    return 0.0


@wp.func
def interior_side(scene: Scene, edges: Edges, point: EdgePoint, m: wp.vec3, w: wp.vec3) -> wp.float32:
    """Return +1 or -1 if all faces of the edge lie on that side of the plane through edge and w, else 0.

    m is normal to the plane. Of a face in the plane the edge that rays along w come to first counts (``edge_on.py``).
    The faces of a curve of intersection, or of a step, lie on both sides of every plane through it.
    """
    if edges.ends[point.edge, 0] < 0:
        return 0.0
    along = wp.normalize(point.p1 - point.p0)
    above = wp.bool(True)
    below = wp.bool(True)
    for i in range(edges.first[point.edge], edges.first[point.edge + 1]):
        r = to_third(scene.triangles[edges.faces[i]], point)
        r -= wp.dot(r, along) * along
        above = above and is_beside(r, m, w, EDGEWISE)
        below = below and is_beside(r, -m, w, EDGEWISE)
    return wp.where(above, 1.0, wp.where(below, -1.0, 0.0))


@wp.func
def facing_side(scene: Scene, edges: Edges, point: EdgePoint, along: wp.vec3, w: wp.vec3) -> wp.float32:
    """Return ``interior_side`` for m = along x w, the same for all edges of a face that is parallel to w.

    With n its normal and r the way to its third corner, m . r = (n . w) (along x n) . r. A face whose n . w is 0, or a
    rounding, is lit as a whole, with all triangles in its plane: of the sides of a box under a vertical sun, which are
    neither lit nor dark, one edge each is a silhouette, and a sheet that casts no shadow has two whose shadows cancel.
    """
    if edges.ends[point.edge, 0] < 0:
        return 0.0
    above = wp.int32(0)
    below = wp.int32(0)
    for i in range(edges.first[point.edge], edges.first[point.edge + 1]):
        tri = scene.triangles[edges.faces[i]]
        r = to_third(tri, point)
        if (wp.dot(wp.cross(along, tri.normal), r) > 0.0) == (wp.dot(tri.normal, w) >= -PARALLEL):
            above += 1
        else:
            below += 1
    return one_side(above, below)


@wp.func
def on_plane(normal: wp.vec3, r: wp.vec3, step: wp.float32) -> wp.bool:
    """Whether what a ray meets at r from a point of a plane is that plane, for the ray epsilon ``step`` there."""
    return wp.abs(wp.dot(normal, r)) <= ON_PLANE * step and wp.length(r) <= NEAR * step


@wp.func
def on_planes(scene: Scene, edges: Edges, point: EdgePoint, face: wp.int32, x: wp.vec3, step: wp.float32) -> wp.bool:
    """Whether x, a point of ``face`` (-1: none), lies beside the point on the plane of one of the edge's faces.

    True of curves of intersection, which rays pass so far away that they may leave both triangles.
    """
    found = edges.ends[point.edge, 0] == CURVE
    if face >= 0:
        for i in range(edges.first[point.edge], edges.first[point.edge + 1]):
            found = found or on_plane(scene.triangles[edges.faces[i]].normal, x - point.x, step)
    return found


@wp.func
def is_pierced(scene: Scene, edges: Edges, point: EdgePoint, face: wp.int32, x: wp.vec3, step: wp.float32) -> wp.bool:
    """Whether an edge lies in the plane of ``face``, met at x beside it (-1: none), and runs through that surface.

    Its two faces lie on either side, so that a curve of intersection runs along the edge and has the jump.
    """
    first = edges.first[point.edge]
    if face < 0 or edges.ends[point.edge, 0] < 0 or edges.first[point.edge + 1] != first + 2:
        return False
    met = scene.triangles[face]
    near = ON_PLANE * step
    off = wp.max(wp.abs(wp.dot(met.normal, point.p0 - met.p0)), wp.abs(wp.dot(met.normal, point.p1 - met.p0)))
    if off > near or wp.length(x - point.x) > NEAR * step:
        return False
    a = wp.dot(met.normal, to_third(scene.triangles[edges.faces[first]], point))
    b = wp.dot(met.normal, to_third(scene.triangles[edges.faces[first + 1]], point))
    return wp.min(a, b) < -near and wp.max(a, b) > near


@wp.func
def barycentrics_at(tri: Triangle, x: wp.vec3) -> wp.vec2:
    """Barycentrics (u, v) of a point in the plane of a triangle."""
    e1 = tri.p1 - tri.p0
    e2 = tri.p2 - tri.p0
    n = wp.cross(e1, e2)
    s = x - tri.p0
    squared = wp.max(wp.dot(n, n), 1.0e-30)
    return wp.vec2(wp.dot(n, wp.cross(s, e2)) / squared, wp.dot(n, wp.cross(e1, s)) / squared)


@wp.func
def narrowest_face(
    scene: Scene, edges: Edges, point: EdgePoint, m: wp.vec3, d: wp.vec3
) -> tuple[wp.float32, wp.float32]:
    """Least width of the edge's faces at the point as seen along d, along the normal m to both; least sine to a face.

    In an image with the first axis along the edge, from 0 to 1, and the second along m, a triangle's third corner lies
    at (c, h), and over the point s it is h s / c wide if c > s, h (1 - s) / (1 - c) if not.
    """
    width = wp.float32(FAR)
    sine = wp.float32(1.0)
    along = point.p1 - point.p0
    along = along - wp.dot(along, d) * d
    along = along / wp.dot(along, along)
    for i in range(edges.first[point.edge], edges.first[point.edge + 1]):
        tri = scene.triangles[edges.faces[i]]
        # Two of the corners lie on the edge, at 0 and 1.
        third = to_third(tri, point)
        c = wp.dot(along, third) - 1.0
        share = wp.float32(1.0)
        if c > point.s:
            share = point.s / c
        elif c < point.s:
            share = (1.0 - point.s) / (1.0 - c)
        width = wp.min(width, wp.abs(wp.dot(m, third)) * share)
        sine = wp.min(sine, wp.abs(wp.dot(tri.normal, d)))
    return width, sine


@wp.func
def own_face(scene: Scene, edges: Edges, edge: wp.int32, face: wp.int32) -> wp.bool:
    """Whether a face (-1: none) is one of an edge's, or continues one in its plane."""
    if face < 0:
        return False
    for i in range(edges.first[edge], edges.first[edge + 1]):
        own = edges.faces[i]
        n, m = scene.triangles[face].normal, scene.triangles[own].normal
        if face == own or (wp.dot(n, m) > 0.0 and wp.length(wp.cross(n, m)) < IN_PLANE):
            return True
    return False


@wp.func
def split_between(g: wp.vec3, n_a: wp.vec3, n_b: wp.vec3, squared: wp.float32) -> tuple[wp.vec3, wp.vec3]:
    """Return (a n_A, b n_B), whose sum is g, for g in the plane of both; ``squared`` is |n_A x n_B|^2."""
    cosine = wp.dot(n_a, n_b)
    along_a = wp.dot(g, n_a)
    along_b = wp.dot(g, n_b)
    return ((along_a - cosine * along_b) / squared) * n_a, ((along_b - cosine * along_a) / squared) * n_b


@functools.cache
def make_edge_sink(role: str, steps: bool = False):
    """Return ``accumulate_edge(scene, target, edges, point, g) -> float``: scatter the adjoint g of a point on an edge.

    ``steps``: some edges are steps of textures, which ride on a triangle and slide over it.

    Where two surfaces that are separate objects meet in an edge, it is their intersection: of the velocity v of such a
    curve only n_A . v = n_A . v_A and n_B . v = n_B . v_B are fixed, so g = a n_A + b n_B is split between them. The
    same holds where they run through each other, with v_A and v_B those of the material points at the curve.

    Role "samples": ``target`` holds a record a sample instead (``pull_record.py``). What is returned is not 0 if g was
    dropped because it is not finite.
    """
    if role == "samples":

        @wp.func
        def record(
            scene: Scene, target: wp.array(dtype=wp.float32), edges: Edges, point: EdgePoint, g: wp.vec3
        ) -> wp.float32:
            return record_pull(target, point.sample, point.x, point.p1 - point.p0, g)

        return record
    sink3 = make_sink_vec3(role)
    accumulate_slide = make_slide_sink(role) if steps else None

    @wp.func
    def accumulate_ends(
        scene: Scene, target: wp.array(dtype=wp.float32), i: wp.int32, j: wp.int32, s: wp.float32, g: wp.vec3
    ) -> wp.float32:
        return sink3(target, scene.positions + 3 * i, (1.0 - s) * g) + sink3(target, scene.positions + 3 * j, s * g)

    @wp.func
    def accumulate_face(
        scene: Scene, target: wp.array(dtype=wp.float32), face: wp.int32, x: wp.vec3, g: wp.vec3
    ) -> wp.float32:
        tri = scene.triangles[face]
        uv = barycentrics_at(tri, x)
        return (
            sink3(target, scene.positions + 3 * tri.i0, (1.0 - uv[0] - uv[1]) * g)
            + sink3(target, scene.positions + 3 * tri.i1, uv[0] * g)
            + sink3(target, scene.positions + 3 * tri.i2, uv[1] * g)
        )

    @wp.func
    def accumulate_step(
        scene: Scene, target: wp.array(dtype=wp.float32), edges: Edges, point: EdgePoint, g: wp.vec3
    ) -> wp.float32:
        face = edges.faces[edges.first[point.edge]]
        tri = scene.triangles[face]
        number = edges.ends[point.edge, 1]
        axis = edges.twins[point.edge, 1]
        slope = place_gradient(tri, place_slopes(scene, scene.textures[number], tri, axis))
        a = -wp.dot(g, slope) / wp.dot(slope, slope)
        uv = barycentrics_at(tri, point.x)
        slid = accumulate_slide(scene, target, number, axis, tri, uv[0], uv[1], a)
        return slid + accumulate_face(scene, target, face, point.x, g)

    @wp.func
    def accumulate_edge(
        scene: Scene, target: wp.array(dtype=wp.float32), edges: Edges, point: EdgePoint, g: wp.vec3
    ) -> wp.float32:
        if wp.static(steps):
            if edges.ends[point.edge, 0] == STEP:
                return accumulate_step(scene, target, edges, point, g)
        e = point.edge
        i0 = edges.ends[e, 0]
        i1 = edges.ends[e, 1]
        j0 = edges.twins[e, 0]
        j1 = edges.twins[e, 1]
        if i0 >= 0 and i0 == j0 and i1 == j1:
            return accumulate_ends(scene, target, i0, i1, point.s, g)
        n_a = scene.triangles[edges.faces[edges.first[e]]].normal
        n_b = scene.triangles[edges.faces[edges.first[e] + 1]].normal
        # Of the sine: 1 - cosine^2 would lose it where the faces are nearly parallel.
        squared = wp.length_sq(wp.cross(n_a, n_b))
        if i0 < 0:
            g_1, g_2 = split_between(g, n_a, n_b, squared)
            return accumulate_face(scene, target, edges.faces[edges.first[e]], point.x, g_1) + accumulate_face(
                scene, target, edges.faces[edges.first[e] + 1], point.x, g_2
            )
        g_a = 0.5 * g
        g_b = 0.5 * g
        if squared > SEAM_PARALLEL:
            g_a, g_b = split_between(g, n_a, n_b, squared)
        return accumulate_ends(scene, target, i0, i1, point.s, g_a) + accumulate_ends(
            scene, target, j0, j1, point.s, g_b
        )

    return accumulate_edge
