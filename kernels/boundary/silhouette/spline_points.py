"""Points at which segments can touch a cubic grid of signed distances: its surface and its silhouettes, voxel by voxel.

Such a surface has no creases, so the items are voxels alone (``grid_points.py``). A line or a slice of a voxel may hold
several points. All of them count: one is drawn, each with the same probability, and is weighted with their number
``roots``. A point at the border of two voxels counts in both, with shares that add up to one.

Derivation: ``docs/theory/implicit.md#silhouettes-of-cubic-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.silhouette.grid_points import (
    TouchPoint,
    VoxelFunctions,
    from_voxels,
    make_touch_sink,
    place_point,
    spread,
    surface_density,
    turn_axes,
    turn_axes_back,
)
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes
from warp_psdr.kernels.primitive.sdfgrid import Grid, bracketed, grid_of, polynomial, voxel_corner
from warp_psdr.kernels.primitive.sdfgrid_cubic import (
    spline_field,
    spline_hessian,
    spline_rates,
    spline_row,
    spline_weights,
)
from warp_psdr.kernels.primitive.sdfgrid_cubic_surface import make_spline_sink
from warp_psdr.kernels.structs import Scene, Triangle

#: Slot of the number that tells the points of a line or a slice apart.
SLOT_ROOT = 1 << 20
#: Halvings of a slice, after which a square holds one point of a silhouette. Two of them are that close only where the
#: curve runs along the slice, up to 2^-12 of its radius away from it.
FINEST = 5
#: Newton's steps from the middle of such a square, and the last one of those that count.
NEWTON, SETTLED = 8, 1.0e-4
#: Half width of the bands around the borders of squares in which two squares, or voxels, share a point: a silhouette
#: that runs along a border, as in a grid that is seen along its plane of symmetry, is found by rounding on either side.
BAND = 1.0 / 1024.0
#: The largest place in a voxel.
LAST_PLACE = 1.0 - 2.0**-24


@wp.func
def spline_bend(point: TouchPoint, w: wp.vec3) -> wp.vec3:
    """H w, in voxels."""
    m = point.mixed
    return wp.cw_mul(point.pure, w) + wp.vec3(
        m[2] * w[1] + m[1] * w[2], m[2] * w[0] + m[0] * w[2], m[1] * w[0] + m[0] * w[1]
    )


@wp.func
def spline_touch(scene: Scene, tri: Triangle, g: Grid, point: TouchPoint) -> TouchPoint:
    """Fill in what the surface is like at a place of a voxel."""
    r = point
    found = spline_field(scene, g, r.i, r.j, r.k, r.place)
    h = spline_hessian(scene, g, r.i, r.j, r.k, r.place)
    r.gradient = wp.vec3(found[0], found[1], found[2])
    r.pure = wp.vec3(h[0, 0], h[1, 1], h[2, 2])
    r.mixed = wp.vec3(h[1, 2], h[0, 2], h[0, 1])
    r.out = wp.normalize(cofactor(tri, wp.cw_mul(g.cells, r.gradient)))
    if determinant(tri) < 0.0:
        r.out = -r.out
    r.valid = wp.where(wp.length_sq(r.gradient) > 0.0, 1, 0)
    return place_point(tri, g, r)


@wp.func
def spline_curvature(tri: Triangle, g: Grid, point: TouchPoint, w: wp.vec3) -> wp.float32:
    """Normal curvature kappa_n of the surface along a tangent w, positive where it curves away."""
    slope = wp.length(cofactor(tri, wp.cw_mul(g.cells, point.gradient))) / wp.abs(determinant(tri))
    along = wp.cw_mul(g.cells, from_axes(tri, w))
    return wp.dot(along, spline_bend(point, along)) / slope


@wp.func
def spline_direction(point: TouchPoint, eye: wp.vec3, distant: wp.bool) -> wp.vec3:
    """Tangent of the silhouette from an eye, in voxels, of unit length: along grad phi x H (x - eye)."""
    away = eye
    if not distant:
        away = voxel_corner(point.i, point.j, point.k) + point.place - eye
    return wp.normalize(wp.cross(point.gradient, spline_bend(point, away)))


@wp.func
def spline_curve_density(t: wp.vec3) -> wp.float32:
    """Density of the points of a silhouette per length, t from ``spline_direction``: slices across three axes."""
    return spread(t) / 3.0


@wp.func
def spline_line(
    scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32, axis: wp.int32, place: wp.vec3
) -> wp.vec4:
    """Coefficients, constant first, of phi along an axis through a place in a voxel, from face to face."""
    wx = spline_weights(place[0])
    wy = spline_weights(place[1])
    wz = spline_weights(place[2])
    v = wp.vec4(0.0, 0.0, 0.0, 0.0)
    row = wp.int32(0)
    while row < 16:
        b = row & 3
        c = row >> 2
        four = spline_row(scene, g, i, j + b - 1, k + c - 1)
        if axis == 0:
            v += (wy[b] * wz[c]) * four
        elif axis == 1:
            v[b] += wp.dot(wx, four) * wz[c]
        else:
            v[c] += wp.dot(wx, four) * wy[b]
        row += 1
    return wp.vec4(
        (v[0] + 4.0 * v[1] + v[2]) / 6.0,
        0.5 * (v[2] - v[0]),
        0.5 * (v[0] + v[2]) - v[1],
        (v[3] - v[0]) / 6.0 + 0.5 * (v[1] - v[2]),
    )


@wp.func
def any_root(c: wp.vec4, choice: wp.float32) -> tuple[wp.float32, wp.float32]:
    """One of a cubic's roots in [0, 1), each as likely, and how many there are."""
    r0 = wp.float32(1.0)
    r1 = wp.float32(1.0)
    discriminant = c[2] * c[2] - 3.0 * c[3] * c[1]
    if discriminant > 0.0:
        q = -(c[2] + wp.where(c[2] >= 0.0, 1.0, -1.0) * wp.sqrt(discriminant))
        a = q / (3.0 * c[3])
        b = c[1] / q
        r0 = wp.clamp(wp.min(a, b), 0.0, 1.0)
        r1 = wp.clamp(wp.max(a, b), 0.0, 1.0)
    count = wp.float32(0.0)
    root = wp.float32(0.0)
    u = wp.float32(choice)
    low = wp.float32(0.0)
    for piece in range(3):
        high = wp.where(piece == 0, r0, wp.where(piece == 1, r1, 1.0))
        inside = polynomial(c, low) < 0.0
        if high > low and (polynomial(c, high) < 0.0) != inside:
            count += 1.0
            # The latest of n roots is kept with the probability 1 / n.
            if u * count < 1.0:
                root = bracketed(c, low, high, inside)
                u = u * count
            else:
                u = (u - 1.0 / count) / (1.0 - 1.0 / count)
        low = wp.max(low, high)
    return root, count


@wp.func
def spline_surface_point(
    scene: Scene, tri: Triangle, g: Grid, at: wp.vec4i, u: wp.float32, v: wp.float32, choice: wp.float32
) -> TouchPoint:
    """Point of the surface in a voxel: on a line along one of three axes, one of all roots."""
    r = TouchPoint()
    r.i = at[0]
    r.j = at[1]
    r.k = at[2]
    axis = wp.clamp(wp.int32(3.0 * u), 0, 2)
    y = 3.0 * u - wp.float32(axis)
    line = spline_line(scene, g, r.i, r.j, r.k, axis, turn_axes_back(wp.vec3(0.0, y, v), axis))
    root, count = any_root(line, choice)
    if count == 0.0:
        return r
    r.place = turn_axes_back(wp.vec3(root, y, v), axis)
    r = spline_touch(scene, tri, g, r)
    r.density = surface_density(r)
    r.roots = count
    return r


@wp.func
def spline_slice(
    scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32, axis: wp.int32, x: wp.float32
) -> tuple[wp.mat44, wp.mat44]:
    """Bezier coefficients of phi, and of its derivative along an axis, in a slice across it; rows: the third axis."""
    w = spline_weights(x)
    d = spline_rates(x)
    value = wp.mat44()
    rate = wp.mat44()
    row = wp.int32(0)
    while row < 16:
        b = row & 3
        c = row >> 2
        four = spline_row(scene, g, i, j + b - 1, k + c - 1)
        if axis == 0:
            value[c, b] = wp.dot(w, four)
            rate[c, b] = wp.dot(d, four)
        elif axis == 1:
            for a in range(4):
                value[a, c] += w[b] * four[a]
                rate[a, c] += d[b] * four[a]
        else:
            for a in range(4):
                value[b, a] += w[c] * four[a]
                rate[b, a] += d[c] * four[a]
        row += 1
    bezier = wp.static(1.0 / 6.0) * wp.mat44(
        1.0, 4.0, 1.0, 0.0,
        0.0, 4.0, 2.0, 0.0,
        0.0, 2.0, 4.0, 0.0,
        0.0, 1.0, 4.0, 1.0,
    )  # fmt: skip
    back = wp.transpose(bezier)
    return bezier * value * back, bezier * rate * back


@wp.func
def slope_times(c: wp.vec4, low: wp.float32, high: wp.float32) -> wp.vec4:
    """Bezier coefficients of the derivative of a cubic times a linear function with these ends."""
    p0 = 3.0 * (c[1] - c[0])
    p1 = 3.0 * (c[2] - c[1])
    p2 = 3.0 * (c[3] - c[2])
    return wp.vec4(p0 * low, (2.0 * p1 * low + p0 * high) / 3.0, (p2 * low + 2.0 * p1 * high) / 3.0, p2 * high)


@wp.func
def bernstein_blossom(u: wp.float32, v: wp.float32, w: wp.float32) -> wp.vec4:
    """Weights of four Bezier coefficients in the polar form of their cubic."""
    x = 1.0 - u
    y = 1.0 - v
    z = 1.0 - w
    return wp.vec4(x * y * z, u * y * z + x * v * z + x * y * w, u * v * z + u * y * w + x * v * w, u * v * w)


@wp.func
def bezier_part(a: wp.float32, b: wp.float32) -> wp.mat44:
    """Rows: weights of four Bezier coefficients in those of their part [a, b]."""
    return wp.matrix_from_rows(
        bernstein_blossom(a, a, a),
        bernstein_blossom(a, a, b),
        bernstein_blossom(a, b, b),
        bernstein_blossom(b, b, b),
    )


@wp.func
def has_both_signs(c: wp.mat44) -> wp.bool:
    low = wp.min(wp.min(wp.min(c[0]), wp.min(c[1])), wp.min(wp.min(c[2]), wp.min(c[3])))
    high = wp.max(wp.max(wp.max(c[0]), wp.max(c[1])), wp.max(wp.max(c[2]), wp.max(c[3])))
    return low <= 0.0 and high >= 0.0


@wp.func
def interval_share(y: wp.float32, low: wp.float32, width: wp.float32) -> wp.float32:
    """Share that an interval has in a number: 1 inside, 0 outside, and in the bands around its ends in between.

    The shares of intervals side by side add up to 1.
    """
    a = wp.clamp(0.5 + wp.static(0.5 / BAND) * (y - low), 0.0, 1.0)
    b = wp.clamp(0.5 + wp.static(0.5 / BAND) * (y - (low + width)), 0.0, 1.0)
    return a - b


@wp.func
def common_root(f: wp.mat44, p: wp.mat44, low: wp.vec2, width: wp.float32) -> tuple[wp.vec2, wp.float32]:
    """Where two bicubic polynomials are zero in a square, and the square's share in that place; 0: nowhere."""
    y = low[0] + 0.5 * width
    z = low[1] + 0.5 * width
    last = wp.float32(1.0)
    for _k in range(wp.static(NEWTON)):
        by = bernstein_blossom(y, y, y)
        bz = bernstein_blossom(z, z, z)
        # Derivatives of the basis: three times the differences of the quadratic ones.
        y1 = 1.0 - y
        z1 = 1.0 - z
        dy = 3.0 * wp.vec4(-y1 * y1, y1 * y1 - 2.0 * y * y1, 2.0 * y * y1 - y * y, y * y)
        dz = 3.0 * wp.vec4(-z1 * z1, z1 * z1 - 2.0 * z * z1, 2.0 * z * z1 - z * z, z * z)
        f_y = f * by
        p_y = p * by
        f0 = wp.dot(bz, f_y)
        p0 = wp.dot(bz, p_y)
        f1 = wp.dot(bz, f * dy)
        p1 = wp.dot(bz, p * dy)
        f2 = wp.dot(dz, f_y)
        p2 = wp.dot(dz, p_y)
        det = f1 * p2 - f2 * p1
        step_y = (f0 * p2 - p0 * f2) / det
        step_z = (f1 * p0 - p1 * f0) / det
        # A step may leave the slice, but not by far.
        y = wp.clamp(y - step_y, -0.5, 1.5)
        z = wp.clamp(z - step_z, -0.5, 1.5)
        last = wp.abs(step_y) + wp.abs(step_z)
    # False for NaN, too.
    if last < wp.static(SETTLED):
        return wp.vec2(y, z), interval_share(y, low[0], width) * interval_share(z, low[1], width)
    return wp.vec2(y, z), 0.0


@wp.func
def spline_curve_point(
    scene: Scene,
    tri: Triangle,
    g: Grid,
    at: wp.vec4i,
    eye: wp.vec3,
    distant: wp.bool,
    u: wp.float32,
    choice: wp.float32,
) -> TouchPoint:
    """Point of the silhouette that an eye, in voxels, sees in a voxel: in a slice across an axis, one of all.

    In a slice phi and grad phi . (x - eye) are both bicubic. Squares of the slice in which the Bezier coefficients of
    one of them have one sign hold none; the others are cut in four, and Newton's steps end in the finest.
    """
    r = TouchPoint()
    r.i = at[0]
    r.j = at[1]
    r.k = at[2]
    axis = wp.clamp(wp.int32(3.0 * u), 0, 2)
    x = 3.0 * u - wp.float32(axis)
    f, rate = spline_slice(scene, g, r.i, r.j, r.k, axis, x)
    low = turn_axes(eye, axis)
    high = turn_axes(eye, axis)
    across = low[0]
    if not distant:
        low = turn_axes(voxel_corner(r.i, r.j, r.k) - eye, axis)
        high = low + wp.vec3(1.0, 1.0, 1.0)
        across = low[0] + x
    turned = wp.transpose(f)
    p = across * rate
    p += wp.matrix_from_rows(
        slope_times(f[0], low[1], high[1]),
        slope_times(f[1], low[1], high[1]),
        slope_times(f[2], low[1], high[1]),
        slope_times(f[3], low[1], high[1]),
    )
    p += wp.matrix_from_cols(
        slope_times(turned[0], low[2], high[2]),
        slope_times(turned[1], low[2], high[2]),
        slope_times(turned[2], low[2], high[2]),
        slope_times(turned[3], low[2], high[2]),
    )
    count = wp.float32(0.0)
    root = wp.vec2(0.0, 0.0)
    rest = wp.float32(choice)
    level = wp.int32(0)
    n = wp.int32(0)
    width = wp.float32(1.0)
    while level >= 0:
        # The bits of n say in turn which halves of y and z the square is in.
        cy = wp.int32(0)
        cz = wp.int32(0)
        bit = wp.int32(0)
        while bit < level:
            cy += ((n >> (2 * bit)) & 1) << bit
            cz += ((n >> (2 * bit + 1)) & 1) << bit
            bit += 1
        corner = wp.vec2(width * wp.float32(cy), width * wp.float32(cz))
        along_y = wp.transpose(bezier_part(corner[0] - wp.static(BAND), corner[0] + width + wp.static(BAND)))
        along_z = bezier_part(corner[1] - wp.static(BAND), corner[1] + width + wp.static(BAND))
        may_hold = has_both_signs(along_z * f * along_y)
        if may_hold:
            may_hold = has_both_signs(along_z * p * along_y)
        if may_hold and level < wp.static(FINEST):
            level += 1
            n *= 4
            width *= 0.5
        else:
            if may_hold:
                found, share = common_root(f, p, corner, width)
                if share > 0.0:
                    count += share
                    chance = share / count
                    if rest < chance:
                        root = found
                        rest = rest / chance
                    else:
                        rest = (rest - chance) / (1.0 - chance)
            n += 1
            while level > 0 and (n & 3) == 0:
                n = n >> 2
                level -= 1
                width *= 2.0
            if level == 0:
                level = -1
    if count == 0.0:
        return r
    y = wp.clamp(root[0], 0.0, wp.static(LAST_PLACE))
    z = wp.clamp(root[1], 0.0, wp.static(LAST_PLACE))
    r.place = turn_axes_back(wp.vec3(x, y, z), axis)
    r = spline_touch(scene, tri, g, r)
    t = spline_direction(r, eye, distant)
    r.density = spline_curve_density(t)
    r.along = from_voxels(tri, g, t)
    r.roots = count
    r.valid = wp.where(r.density > 0.0, r.valid, 0)
    return r


@functools.cache
def make_cubic_touch_sink(role: str) -> wp.Function:
    """Return ``make_touch_sink``'s function for cubic grids."""
    accumulate_spline = make_spline_sink(role)

    @wp.func
    def accumulate_cubic_phi(
        scene: Scene, target: wp.array(dtype=wp.float32), g: Grid, point: TouchPoint, a_phi: wp.float32
    ) -> wp.float32:
        zero = wp.vec3(0.0, 0.0, 0.0)
        return accumulate_spline(target, g, point.i, point.j, point.k, point.place, a_phi, zero)

    return make_touch_sink(role, grid_of, accumulate_cubic_phi)


CUBIC_VOXELS = VoxelFunctions(
    record=grid_of,
    seen=spline_curve_point,
    place=spline_surface_point,
    curvature=spline_curvature,
    direction=spline_direction,
    density=spline_curve_density,
    make_sink=make_cubic_touch_sink,
)
