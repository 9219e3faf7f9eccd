"""The stripe of a light's triangle for which an edge is a silhouette: points are drawn exactly from it.

An edge is a silhouette between x and y where g_A(y) and g_B(y), both affine, have the same sign. On a triangle of a
light this leaves at most one convex polygon for each sign.

Derivation: ``docs/theory/guiding.md#stripes-of-lights``.
"""

import warp as wp

from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges
from warp_psdr.kernels.sampling import square_to_triangle
from warp_psdr.kernels.structs import Scene

#: Corners of a triangle that was cut by two lines, in barycentrics.
CORNERS = wp.types.matrix(shape=(5, 2), dtype=wp.float32)


@wp.struct
class Polygon:
    """A convex polygon in the barycentrics (u, v) of a triangle."""

    count: wp.int32
    corners: CORNERS
    area: wp.float32  # relative to the triangle's


@wp.struct
class Stripe:
    """The part of a triangle for which an edge is a silhouette: where g is positive, and where it is negative."""

    above: Polygon
    below: Polygon
    share: wp.float32  # of the triangle's area


@wp.func
def cut(polygon: Polygon, g: wp.vec3, sign: wp.float32) -> Polygon:
    """What lies where sign (g_0 + g_1 u + g_2 v) is positive [Sutherland and Hodgman 1974]."""
    r = Polygon()
    m = CORNERS()
    n = wp.int32(0)
    for i in range(polygon.count):
        j = wp.where(i + 1 == polygon.count, 0, i + 1)
        a = wp.vec2(polygon.corners[i, 0], polygon.corners[i, 1])
        b = wp.vec2(polygon.corners[j, 0], polygon.corners[j, 1])
        g_a = sign * (g[0] + g[1] * a[0] + g[2] * a[1])
        g_b = sign * (g[0] + g[1] * b[0] + g[2] * b[1])
        if g_a > 0.0 and n < 5:
            m[n, 0] = a[0]
            m[n, 1] = a[1]
            n += 1
        if ((g_a > 0.0 and g_b <= 0.0) or (g_a <= 0.0 and g_b > 0.0)) and n < 5:
            c = a + (g_a / (g_a - g_b)) * (b - a)
            m[n, 0] = c[0]
            m[n, 1] = c[1]
            n += 1
    r.count = n
    r.corners = m
    return r


@wp.func
def polygon_corner(polygon: Polygon, i: wp.int32) -> wp.vec2:
    return wp.vec2(polygon.corners[i, 0], polygon.corners[i, 1])


@wp.func
def fan_area(polygon: Polygon, i: wp.int32) -> wp.float32:
    """Area of triangle i of the polygon's fan, relative to the triangle's: twice that in (u, v)."""
    a = polygon_corner(polygon, 0)
    b = polygon_corner(polygon, i + 1) - a
    c = polygon_corner(polygon, i + 2) - a
    return wp.abs(b[0] * c[1] - b[1] * c[0])


@wp.func
def polygon_area(polygon: Polygon) -> wp.float32:
    area = wp.float32(0.0)
    for i in range(polygon.count - 2):
        area += fan_area(polygon, i)
    return area


@wp.func
def affine(scene: Scene, edges: Edges, point: EdgePoint, side: wp.int32, face: wp.int32) -> wp.vec3:
    """Coefficients (1, u, v) of g on a triangle of a light."""
    tri = scene.triangles[edges.faces[edges.first[point.edge] + side]]
    a = (tri.p0 - point.p0) + (tri.p1 - point.p0) + (tri.p2 - point.p0)
    n = wp.cross(a, point.p1 - point.p0)
    light = scene.triangles[face]
    return wp.vec3(wp.dot(light.p0 - point.p0, n), wp.dot(light.p1 - light.p0, n), wp.dot(light.p2 - light.p0, n))


@wp.func
def stripe_at(scene: Scene, edges: Edges, point: EdgePoint, face: wp.int32) -> Stripe:
    r = Stripe()
    m = CORNERS()
    m[1, 0] = 1.0
    m[2, 1] = 1.0
    whole = Polygon()
    whole.count = 3
    whole.corners = m
    whole.area = 1.0
    if edges.first[point.edge + 1] - edges.first[point.edge] != 2:
        r.above = whole
        r.share = 1.0
        return r
    g_a = affine(scene, edges, point, 0, face)
    g_b = affine(scene, edges, point, 1, face)
    r.above = cut(cut(whole, g_a, 1.0), g_b, 1.0)
    r.below = cut(cut(whole, g_a, -1.0), g_b, -1.0)
    r.above.area = polygon_area(r.above)
    r.below.area = polygon_area(r.below)
    r.share = r.above.area + r.below.area
    return r


@wp.func
def stripe_point(stripe: Stripe, u1: wp.float64, u2: wp.float64) -> wp.vec2:
    """Barycentrics of a point, uniform in area over the stripe."""
    polygon = stripe.above
    rest = wp.float32(u1 * wp.float64(stripe.share))
    if rest >= stripe.above.area:
        rest -= stripe.above.area
        polygon = stripe.below
    i = wp.int32(0)
    area = fan_area(polygon, 0)
    while rest >= area and i < polygon.count - 3:
        rest -= area
        i += 1
        area = fan_area(polygon, i)
    b = square_to_triangle(wp.vec2(wp.clamp(rest / area, 0.0, 1.0), wp.float32(u2)))
    c = polygon_corner(polygon, 0)
    return c + b[0] * (polygon_corner(polygon, i + 1) - c) + b[1] * (polygon_corner(polygon, i + 2) - c)


@wp.func
def triangle_to_square(u: wp.float32, v: wp.float32) -> wp.vec2:
    """The inverse of ``square_to_triangle``."""
    if u < v:
        return wp.vec2(2.0 * u, v + u)
    return wp.vec2(u + v, 2.0 * v)


@wp.func
def search(polygon: Polygon, at: wp.vec2, before: wp.float32, best: wp.vec4) -> wp.vec4:
    """(depth, u1 share, u2, -) of the fan's triangle that holds a point, if it lies deeper in it than in ``best``."""
    r = best
    done = before
    for i in range(polygon.count - 2):
        a = polygon_corner(polygon, 0)
        b = polygon_corner(polygon, i + 1) - a
        c = polygon_corner(polygon, i + 2) - a
        area = b[0] * c[1] - b[1] * c[0]
        if area != 0.0:
            q = at - a
            x = (q[0] * c[1] - q[1] * c[0]) / area
            y = (b[0] * q[1] - b[1] * q[0]) / area
            depth = wp.min(wp.min(x, y), 1.0 - x - y)
            if depth > r[0]:
                s = triangle_to_square(wp.clamp(x, 0.0, 1.0), wp.clamp(y, 0.0, 1.0))
                r = wp.vec4(depth, done + wp.clamp(s[0], 0.0, 1.0) * wp.abs(area), wp.clamp(s[1], 0.0, 1.0), 0.0)
        done += wp.abs(area)
    return r


@wp.func
def stripe_square(stripe: Stripe, u: wp.float32, v: wp.float32) -> wp.vec2:
    """The inverse of ``stripe_point``; a point just outside of the stripe is taken for the nearest of it."""
    best = search(stripe.above, wp.vec2(u, v), 0.0, wp.vec4(-1.0e30, 0.0, 0.0, 0.0))
    best = search(stripe.below, wp.vec2(u, v), stripe.above.area, best)
    return wp.vec2(wp.min(best[1] / wp.max(stripe.share, 1.0e-30), 0.99999994), wp.min(best[2], 0.99999994))
