"""The point where a ray enters a tube about a cubic: cones touch the tube circle by circle, until their heights vanish.

Derivation: ``docs/theory/implicit.md#curves``.
"""

import warp as wp

#: Rounds in which a ray is carried from cone to cone along a piece. They double the digits; a few suffice.
ROUNDS = 12
#: Slope above which a secant is not followed.
LEAST_FALL = -0.2
#: Change of the place along a segment, 1 for all of it, at which a round was the last one.
CLOSE = 2.0e-5
#: Distance along a segment from the circle to where the ray enters its cone, up to which the two are one: where the ray
#: grazes, that distance jumps, and steps are small far from the tube as well.
ON_CIRCLE = 1.0e-3
#: How far behind the ends of a piece a hit still counts, so that nothing passes between two: along a segment, 1 for all
#: of it; more by rounding, ``BLUR`` over the size of the coordinates, up to ``JOINT``.
OVERLAP = 1.0e-5
BLUR = 2.4e-7
JOINT = 1.0e-3
#: Height over a cone, in radii, doubled, up to which a ray that passes it may yet enter the tube beside it.
GRAZING = 0.02
#: Share of the square of a direction below which it runs along the axis.
ALONG = 1.0e-7
#: What has become of a search.
SEARCHES = wp.constant(0)
FOUND = wp.constant(1)
MISSED = wp.constant(2)
GRAZES = wp.constant(3)


@wp.struct
class Spline:
    """c(v) = a0 + v (a1 + v (a2 + v a3)), (x, y, z, radius), of a segment; 0 <= v <= 1."""

    a0: wp.vec4
    a1: wp.vec4
    a2: wp.vec4
    a3: wp.vec4


@wp.func
def place_on(s: Spline, v: wp.float32) -> wp.vec4:
    return s.a0 + v * (s.a1 + v * (s.a2 + v * s.a3))


@wp.func
def slope_on(s: Spline, v: wp.float32) -> wp.vec4:
    return s.a1 + v * (2.0 * s.a2 + (3.0 * v) * s.a3)


@wp.func
def xyz(p: wp.vec4) -> wp.vec3:
    return wp.vec3(p[0], p[1], p[2])


@wp.func
def entry(a: wp.float32, b: wp.float32, c: wp.float32, discriminant: wp.float32) -> wp.float32:
    """The root of a t^2 + 2 b t + c at which it becomes negative; without roots where it is least."""
    root = wp.sqrt(wp.max(discriminant, 0.0))
    other = b < 0.0 and discriminant >= 0.0
    return wp.where(other, c, -(b + root)) / wp.where(other, root - b, wp.where(a == 0.0, 1.0e-30, a))


@wp.struct
class Approach:
    """Where a ray enters the cone that touches a tube along one of its circles."""

    t: wp.float32
    step: wp.float32  # along the segment, from the circle to the point
    misses: wp.int32  # 1: the ray passes the cone, nearest at t
    grazes: wp.int32  # 1: it passes it closely


@wp.func
def enter_cone(q: wp.vec3, d: wp.vec3, c: wp.vec3, radius: wp.float32, slope: wp.float32) -> Approach:
    """Enter |p - s c| = radius + slope s, s = p . c / |c|^2, with p = q + t d, |d| = 1."""
    at = Approach()
    inverse = 1.0 / wp.max(wp.dot(c, c), 1.0e-30)
    s0 = wp.dot(q, c) * inverse
    s1 = wp.dot(d, c) * inverse
    across = d - s1 * c
    beside = q - s0 * c
    squared = wp.dot(across, across)
    # From the point next to the axis on, so that thin tubes keep their digits.
    leaves = squared > wp.static(ALONG)
    t = wp.where(leaves, -wp.dot(beside, across) / wp.where(leaves, squared, 1.0), 0.0)
    beside += t * across
    s0 += t * s1
    r = radius + slope * s0
    a = squared - s1 * s1 * slope * slope
    b = wp.dot(beside, across) - s1 * slope * r
    e = wp.dot(beside, beside) - r * r
    discriminant = b * b - a * e
    at.misses = wp.where(discriminant < 0.0, 1, 0)
    at.grazes = wp.where(discriminant < 0.0 and discriminant > -wp.static(GRAZING) * a * r * r, 1, 0)
    more = entry(a, b, e, discriminant)
    at.t = t + more
    at.step = s0 + more * s1
    return at


@wp.struct
class TubeSearch:
    """The search for where the ray t d, |d| = 1, enters a piece of a tube, from up to three circles of it."""

    status: wp.int32  # SEARCHES, FOUND, MISSED or GRAZES: ``follow_tube`` knows, if it can, or the search goes on
    start: wp.int32  # number of the circle that it started from; 3: there are no more
    first: wp.float32  # where along the segment the first of them is
    low: wp.float32  # the piece, longer by what hits count behind its ends
    high: wp.float32
    least: wp.float32  # least < t < most
    most: wp.float32
    v: wp.float32
    t: wp.float32
    before: wp.float32  # v a round ago, and what a step was there
    step_before: wp.float32
    rounds: wp.int32
    outside: wp.int32  # 1: v was beside the piece


@wp.func
def search_tube(
    s: Spline, d: wp.vec3, low: wp.float32, size: wp.float32, least: wp.float32, most: wp.float32
) -> TubeSearch:
    """Start from the end of the piece that the ray meets first; next are the other one, and the middle."""
    r = TubeSearch()
    slope = xyz(slope_on(s, low + 0.5 * size))
    blur = wp.static(BLUR) * wp.abs(least) / wp.sqrt(wp.max(wp.dot(slope, slope), 1.0e-30))
    more = wp.min(wp.static(OVERLAP) + blur, wp.static(JOINT))
    r.low = low - more
    r.high = low + size + more
    r.first = wp.where(wp.dot(slope, d) >= 0.0, low, low + size)
    r.least = least
    r.most = most
    r.v = r.first
    return r


@wp.func
def status_unfollowed(search: TubeSearch) -> wp.int32:
    """The status of a search whose ray grazes the tube and cannot be followed."""
    return wp.where(search.start == 3, MISSED, SEARCHES)


@wp.func
def search_on(s: Spline, d: wp.vec3, search: TubeSearch) -> TubeSearch:
    """The next round: from a circle of the tube to the one at the height where the ray enters its tangent cone.

    Steps vanish where the ray enters the tube: that place is looked for by secants, as far as they fall. They vanish
    at cones that a ray passes, too, and where it does so closely, it may enter the tube beside the circle. Without a
    branch, for loops over lanes.
    """
    r = search
    v = search.v
    low = search.low
    high = search.high
    margin = 0.5 * (high - low)
    here = place_on(s, v)
    slope = slope_on(s, v)
    at = enter_cone(-xyz(here), d, xyz(slope), here[3], slope[3])
    moved = search.rounds > 0 and v != search.before
    secant = (at.step - search.step_before) / wp.where(moved, v - search.before, 1.0)
    step = at.step / -wp.where(moved, wp.min(secant, wp.static(LEAST_FALL)), -1.0)
    settled = wp.abs(step) < wp.static(CLOSE) and wp.abs(at.step) < wp.static(ON_CIRCLE)
    goal = v + step
    inside = goal > low and goal < high
    found = settled and at.misses == 0 and inside and at.t > search.least and at.t < search.most and here[3] > 0.0
    after = v + wp.clamp(step, -margin, margin)
    beyond = after < low - margin or after > high + margin
    lost = settled or (beyond and search.outside == 1) or search.rounds + 1 == wp.static(ROUNDS)
    again = lost and not found
    other = wp.where(search.start == 0, low + high - search.first, 0.5 * (low + high))
    on = wp.where(again, other, wp.clamp(after, low - margin, high + margin))
    r.status = wp.where(again and search.start == 2, MISSED, SEARCHES)
    r.status = wp.where(found, FOUND, wp.where(settled and at.grazes == 1, GRAZES, r.status))
    r.start = search.start + wp.where(again, 1, 0)
    r.v = wp.where(found, wp.clamp(goal, 0.0, 1.0), on)
    r.t = at.t
    r.before = v
    r.step_before = at.step
    r.rounds = wp.where(again, 0, search.rounds + 1)
    r.outside = wp.where(beyond and not again, 1, 0)
    return r
