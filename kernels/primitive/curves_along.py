"""The point where a ray that runs along a tube about a cubic enters it: parts are halved in order, and none is lost.

Where d . c' is not zero, the plane of the circle at v cuts the ray t d at one point, x(v) = (z + m) d, with z = c . d,
p = c - z d, m = p . p' / z'. The point is inside of the circle where F = |p|^2 + m^2 - r^2 is negative. In a part of
the piece with the middle value F, slope g, half length h and the bound b of |F''|, F lies within |g| h + b h^2 / 2 of
its middle value. If that is less than |F|, F has one sign; if |g| > b h, F is monotone. Other parts are halved.

Derivation: ``docs/theory/implicit.md#curves``.
"""

import warp as wp

from warp_psdr.kernels.primitive.curves_search import BLUR, JOINT, OVERLAP, Spline, place_on, slope_on, xyz
from warp_psdr.kernels.primitive.sdfgrid import ITERATIONS

#: Square of the least cosine between a ray and the axis of a piece, all along it, by which a ray can be followed.
FOLLOWED = 2.5e-3
#: Square of the sine, over the radius over that of curvature, up to which cones are not enough.
CURVED = 4.0
#: Halvings of a piece, after which the far end of what is left decides.
SHORTEST = 14
#: Newton's step along a segment which is the last one.
AT_REST = 1.0e-7


@wp.func
def middle_leg(s: Spline, low: wp.float32, size: wp.float32) -> wp.vec4:
    """The middle Bezier point of c' over a piece; the others are its values at the ends."""
    return slope_on(s, low) + size * (s.a2 + (3.0 * low) * s.a3)


@wp.func
def follows(s: Spline, d: wp.vec3, low: wp.float32, size: wp.float32, share: wp.float32) -> wp.bool:
    """Whether a direction, |d| = 1, has a small angle to c' everywhere on a piece: to all Bezier points of c'.

    ``share`` is the square of the least cosine.
    """
    a = xyz(slope_on(s, low))
    b = xyz(middle_leg(s, low, size))
    c = xyz(slope_on(s, low + size))
    along_a = wp.dot(a, d)
    along_b = wp.dot(b, d)
    along_c = wp.dot(c, d)
    one_way = along_a * along_b > 0.0 and along_b * along_c > 0.0
    near_a = along_a * along_a > share * wp.dot(a, a)
    near_b = along_b * along_b > share * wp.dot(b, b)
    near_c = along_c * along_c > share * wp.dot(c, c)
    return one_way and near_a and near_b and near_c


@wp.func
def can_follow(s: Spline, d: wp.vec3, low: wp.float32, size: wp.float32) -> wp.bool:
    """Whether a ray can be followed along a piece."""
    return follows(s, d, low, size, wp.static(FOLLOWED))


@wp.func
def must_follow(s: Spline, d: wp.vec3, low: wp.float32, size: wp.float32) -> wp.bool:
    """Whether a ray has to be followed along a piece at once: by its angle, and by how much the piece bends."""
    high = low + size
    radius = wp.max(place_on(s, low)[3], place_on(s, high)[3])
    a = xyz(slope_on(s, low))
    c = xyz(slope_on(s, high))
    bend_a = xyz(s.a2 + (3.0 * low) * s.a3)
    bend_c = xyz(s.a2 + (3.0 * high) * s.a3)
    bend = 2.0 * wp.sqrt(wp.max(wp.dot(bend_a, bend_a), wp.dot(bend_c, bend_c)))
    speed = wp.max(wp.min(wp.dot(a, a), wp.dot(c, c)), 1.0e-30)
    share = 1.0 - wp.static(CURVED) * radius * bend / speed
    return follows(s, d, low, size, wp.max(share, wp.static(FOLLOWED)))


@wp.struct
class TubeCourse:
    """Bounds over a piece of a tube that a ray runs along, by v."""

    steep: wp.float32  # of |p'|
    flow: wp.float32  # lower one of |z'|
    taper: wp.float32  # of |r'|
    bend: wp.float32  # of |c''| and |r''|
    third: wp.float32  # of |c'''| and |r'''|


@wp.func
def leg_across(leg: wp.vec4, d: wp.vec3) -> wp.float32:
    """The square of a leg's part across a direction."""
    across = xyz(leg) - wp.dot(xyz(leg), d) * d
    return wp.dot(across, across)


@wp.func
def course_of(s: Spline, d: wp.vec3, low: wp.float32, size: wp.float32) -> TubeCourse:
    r = TubeCourse()
    a = slope_on(s, low)
    b = middle_leg(s, low, size)
    c = slope_on(s, low + size)
    bend_a = s.a2 + (3.0 * low) * s.a3
    bend_c = s.a2 + (3.0 * (low + size)) * s.a3
    joint = wp.static(JOINT)
    r.third = 6.0 * wp.length(s.a3)
    r.bend = 2.0 * wp.sqrt(wp.max(wp.dot(bend_a, bend_a), wp.dot(bend_c, bend_c))) + joint * r.third
    squared = wp.max(leg_across(a, d), wp.max(leg_across(b, d), leg_across(c, d)))
    r.steep = wp.sqrt(squared) + joint * r.bend
    along = wp.min(wp.abs(wp.dot(xyz(a), d)), wp.min(wp.abs(wp.dot(xyz(b), d)), wp.abs(wp.dot(xyz(c), d))))
    r.flow = wp.max(along - joint * r.bend, 0.5 * along)
    r.taper = wp.max(wp.abs(a[3]), wp.max(wp.abs(b[3]), wp.abs(c[3]))) + joint * r.bend
    return r


@wp.func
def sharpest(g: TubeCourse, beside: wp.float32, radius: wp.float32) -> wp.float32:
    """The bound of |F''| where |p| and r are at most as given."""
    ahead = beside * g.steep / g.flow  # |m|
    n_v = g.steep * g.steep + beside * g.bend  # |(p . p')'|
    ahead_v = (n_v + ahead * g.bend) / g.flow
    n_vv = 3.0 * g.steep * g.bend + beside * g.third
    ahead_vv = (n_vv + 2.0 * ahead_v * g.bend + ahead * g.third) / g.flow
    return 2.0 * (n_v + g.taper * g.taper + radius * g.bend + ahead_v * ahead_v + ahead * ahead_vv)


@wp.struct
class CircleCut:
    """Where the plane of a tube's circle cuts a ray."""

    t: wp.float32
    f: wp.float32  # F
    f_v: wp.float32
    beside: wp.float32  # |p|
    radius: wp.float32


@wp.func
def cut_circle(s: Spline, d: wp.vec3, v: wp.float32) -> CircleCut:
    r = CircleCut()
    c = place_on(s, v)
    c_v = slope_on(s, v)
    c_vv = 2.0 * xyz(s.a2) + (6.0 * v) * xyz(s.a3)
    z = wp.dot(xyz(c), d)
    z_v = wp.dot(xyz(c_v), d)
    z_vv = wp.dot(c_vv, d)
    p = xyz(c) - z * d
    p_v = xyz(c_v) - z_v * d
    n = wp.dot(p, p_v)
    ahead = n / z_v
    ahead_v = (wp.dot(p_v, p_v) + wp.dot(p, c_vv) - ahead * z_vv) / z_v
    squared = wp.dot(p, p)
    r.beside = wp.sqrt(squared)
    r.radius = c[3]
    r.t = z + ahead
    r.f = (r.beside - c[3]) * (r.beside + c[3]) + ahead * ahead
    r.f_v = 2.0 * (n - c[3] * c_v[3] + ahead * ahead_v)
    return r


@wp.func
def only_entry(s: Spline, d: wp.vec3, outside: wp.float32, inside: wp.float32) -> wp.float32:
    """Where F, monotone between two places, becomes negative."""
    a = wp.float32(outside)
    b = wp.float32(inside)
    v = 0.5 * (a + b)
    for _k in range(wp.static(ITERATIONS)):
        at = cut_circle(s, d, v)
        if at.f < 0.0:
            b = v
        else:
            a = v
        following = v - at.f / at.f_v
        # False for NaN, too.
        if not ((following - a) * (following - b) < 0.0):
            following = 0.5 * (a + b)
        moved = wp.abs(following - v)
        v = following
        if moved <= wp.static(AT_REST):
            break
    return v


@wp.func
def follow_tube(
    s: Spline,
    d: wp.vec3,
    low: wp.float32,
    size: wp.float32,
    least: wp.float32,
    most: wp.float32,
    extent: wp.float32,
) -> wp.vec2:
    """Where the ray t d, |d| = 1, that runs along a piece enters it first, least < t < most: (t, v).

    t infinite: it passes. ``extent`` is the size of the coordinates of which the segment's place was rounded. Parts are
    visited in the order of the ray, each once, and there are 2^``SHORTEST`` at most: no bound is left that could be
    exhausted.
    """
    high = low + size
    g = course_of(s, d, low, size)
    begin = low - wp.where(low > 0.0, wp.static(OVERLAP), wp.static(JOINT))
    end = high + wp.where(high < 1.0, wp.static(OVERLAP), wp.static(JOINT))
    if wp.dot(xyz(slope_on(s, low)), d) < 0.0:
        other = begin
        begin = end
        end = other
    span = end - begin
    sizes = wp.max(wp.length(xyz(place_on(s, low))), wp.length(xyz(place_on(s, high))))
    negative = cut_circle(s, d, begin).f < 0.0
    level = wp.int32(0)
    n = wp.int32(0)
    width = wp.float32(1.0)
    while level >= 0:
        near = begin + wp.float32(n) * width * span
        far = near + width * span
        half = 0.5 * width * wp.abs(span)
        at = cut_circle(s, d, 0.5 * (near + far))
        bend = sharpest(g, at.beside + half * g.steep, at.radius + half * g.taper)
        steep = wp.abs(at.f_v)
        varies = half * (steep + 0.5 * bend * half)
        monotone = steep > bend * half
        blur = wp.static(BLUR) * at.radius * (sizes + at.radius)
        crosses = wp.bool(False)
        v = 0.5 * (near + far)
        if wp.abs(at.f) > varies:
            # Only after rounding has lost a root.
            crosses = (at.f < 0.0) != negative
        elif monotone or level >= wp.static(SHORTEST) or not (varies > blur):
            crosses = (cut_circle(s, d, far).f < 0.0) != negative
            if crosses and not negative and monotone:
                v = only_entry(s, d, near, far)
        else:
            level += 1
            n *= 2
            width *= 0.5
            continue
        if crosses:
            negative = not negative
            if negative:
                found = cut_circle(s, d, v)
                if found.t >= most:
                    return wp.vec2(wp.inf, 0.0)
                # Two segments that meet have places of their own, each rounded, so that neither may have the root.
                blur = wp.static(BLUR) * found.radius * (extent + wp.abs(least) + sizes + found.radius)
                margin = wp.max(blur / wp.max(wp.abs(found.f_v), 1.0e-30), wp.static(OVERLAP))
                if found.t > least and v > low - margin and v < high + margin:
                    return wp.vec2(found.t, wp.clamp(v, 0.0, 1.0))
        n += 1
        while level > 0 and (n & 1) == 0:
            n = n >> 1
            level -= 1
            width *= 2.0
        if level == 0:
            level = -1
    return wp.vec2(wp.inf, 0.0)
