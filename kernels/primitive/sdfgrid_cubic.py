"""Signed distances on a smooth grid: the surface phi = 0 of the uniform cubic B-spline with the nodes' values.

The pose, the ``Grid`` record and the contents of a vertex are those of ``sdfgrid.py``. Beyond the border, a grid
continues with the values of its outermost nodes. phi has continuous second derivatives. It does not pass through the
values, but smooths them. In a voxel, phi lies between the least and the greatest of its Bezier coefficients; the
``reach`` of voxels whose coefficients have both signs is 0. Along a ray, phi in a voxel is a polynomial of degree 9.

Derivation: ``docs/theory/implicit.md#cubic-grids``.
"""

import warp as wp

from warp_psdr.kernels.primitive.sdfgrid import ITERATIONS, Grid
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.structs import Scene

#: Degree of phi along a ray in a voxel.
DEGREE = wp.constant(9)
#: Bernstein coefficients of such a polynomial over [0, 1].
BERNSTEIN = wp.types.vector(length=10, dtype=wp.float32)
#: Halvings of a voxel's part of a ray, after which what is left of it holds no root or two of them, which are one to
#: rounding: between them phi is less than 2^-26 of its second derivative.
DEEPEST = 12
#: Coefficients over the greatest value of a voxel that are rounding.
FAINT = 1.0e-7


@wp.func
def spline_weights(x: wp.float32) -> wp.vec4:
    """Weights of four values around a place in a voxel, [0, 1], along an axis."""
    y = 1.0 - x
    return wp.static(1.0 / 6.0) * wp.vec4(
        y * y * y, 4.0 + x * x * (3.0 * x - 6.0), 4.0 + y * y * (3.0 * y - 6.0), x * x * x
    )


@wp.func
def spline_rates(x: wp.float32) -> wp.vec4:
    """Derivatives of ``spline_weights``."""
    y = 1.0 - x
    return wp.vec4(-0.5 * y * y, x * (1.5 * x - 2.0), y * (2.0 - 1.5 * y), 0.5 * x * x)


@wp.func
def spline_bends(x: wp.float32) -> wp.vec4:
    """Second derivatives of ``spline_weights``."""
    y = 1.0 - x
    return wp.vec4(y, 3.0 * x - 2.0, 3.0 * y - 2.0, x)


@wp.func
def spline_blossom(u: wp.float32, v: wp.float32, w: wp.float32) -> wp.vec4:
    """Weights of four values in the polar form of their piece: at u = v = w ``spline_weights``."""
    a = 0.5 * (1.0 - w) * (1.0 - v)
    b = 0.5 * ((1.0 - w) * (1.0 + v) + w * (2.0 - v))
    c = 0.5 * w * v
    return wp.static(1.0 / 3.0) * wp.vec4(
        a * (1.0 - u), a * (2.0 + u) + b * (2.0 - u), b * (1.0 + u) + c * (3.0 - u), c * u
    )


@wp.func
def spline_row(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32) -> wp.vec4:
    """Four values along x around the voxel i, in a row of nodes, which goes on behind the border."""
    first = g.first + (wp.clamp(k, 0, g.nz - 1) * g.ny + wp.clamp(j, 0, g.ny - 1)) * g.nx
    return wp.vec4(
        load_float(scene.values, first + wp.max(i - 1, 0)),
        load_float(scene.values, first + i),
        load_float(scene.values, first + i + 1),
        load_float(scene.values, first + wp.min(i + 2, g.nx - 1)),
    )


@wp.func
def spline_field(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32, x: wp.vec3) -> wp.vec4:
    """(gradient, phi) at the place x in a voxel, [0, 1]^3."""
    wx = spline_weights(x[0])
    wy = spline_weights(x[1])
    wz = spline_weights(x[2])
    dx = spline_rates(x[0])
    dy = spline_rates(x[1])
    dz = spline_rates(x[2])
    r = wp.vec4(0.0, 0.0, 0.0, 0.0)
    row = wp.int32(0)
    while row < 16:
        b = row & 3
        c = row >> 2
        four = spline_row(scene, g, i, j + b - 1, k + c - 1)
        value = wp.dot(wx, four)
        r += wp.vec4(
            wp.dot(dx, four) * wy[b] * wz[c], value * dy[b] * wz[c], value * wy[b] * dz[c], value * wy[b] * wz[c]
        )
        row += 1
    return r


@wp.func
def spline_hessian(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32, x: wp.vec3) -> wp.mat33:
    """Second derivatives of phi, in voxels, at the place x in a voxel."""
    wx = spline_weights(x[0])
    wy = spline_weights(x[1])
    wz = spline_weights(x[2])
    dx = spline_rates(x[0])
    dy = spline_rates(x[1])
    dz = spline_rates(x[2])
    bx = spline_bends(x[0])
    by = spline_bends(x[1])
    bz = spline_bends(x[2])
    pure = wp.vec3(0.0, 0.0, 0.0)
    mixed = wp.vec3(0.0, 0.0, 0.0)
    row = wp.int32(0)
    while row < 16:
        b = row & 3
        c = row >> 2
        four = spline_row(scene, g, i, j + b - 1, k + c - 1)
        value = wp.dot(wx, four)
        rate = wp.dot(dx, four)
        pure += wp.vec3(wp.dot(bx, four) * wy[b] * wz[c], value * by[b] * wz[c], value * wy[b] * bz[c])
        mixed += wp.vec3(value * dy[b] * dz[c], rate * wy[b] * dz[c], rate * dy[b] * wz[c])
        row += 1
    return wp.mat33(
        pure[0], mixed[2], mixed[1],
        mixed[2], pure[1], mixed[0],
        mixed[1], mixed[0], pure[2],
    )  # fmt: skip


@wp.func
def bezier_weights(a: wp.float32, b: wp.float32) -> wp.mat44:
    """Rows: weights of four values in the Bezier coefficients between a and b along an axis, times 1, 3, 3, 1."""
    return wp.matrix_from_rows(
        spline_blossom(a, a, a),
        3.0 * spline_blossom(a, a, b),
        3.0 * spline_blossom(a, b, b),
        spline_blossom(b, b, b),
    )


@wp.func
def spline_along(
    scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32, x: wp.vec3, d: wp.vec3
) -> tuple[BERNSTEIN, wp.float32]:
    """Bernstein coefficients of phi(x + s d) over s in [0, 1] in a voxel, and the size of its greatest value.

    The part of the voxel between both ends is a tri-cubic Bezier volume, all of whose coefficients are averages of
    values; on its diagonal those with a + b + c = m add up to the m-th one.
    """
    mx = bezier_weights(x[0], x[0] + d[0])
    my = bezier_weights(x[1], x[1] + d[1])
    mz = bezier_weights(x[2], x[2] + d[2])
    size = wp.float32(0.0)
    p = BERNSTEIN()
    plane = wp.int32(0)
    while plane < 4:
        q = BERNSTEIN()
        line = wp.int32(0)
        while line < 4:
            four = spline_row(scene, g, i, j + line - 1, k + plane - 1)
            size = wp.max(size, wp.max(wp.abs(four)))
            r = mx * four
            for b in range(4):
                w = my[b, line]
                for a in range(4):
                    q[a + b] += w * r[a]
            line += 1
        for c in range(4):
            w = mz[c, plane]
            for e in range(7):
                p[c + e] += w * q[e]
        plane += 1
    # The binomials (9, m).
    p[1] /= 9.0
    p[2] /= 36.0
    p[3] /= 84.0
    p[4] /= 126.0
    p[5] /= 126.0
    p[6] /= 84.0
    p[7] /= 36.0
    p[8] /= 9.0
    return p, size


@wp.func
def bernstein_part(p: BERNSTEIN, low: wp.float32, high: wp.float32) -> BERNSTEIN:
    """Coefficients over [low, high] of a polynomial whose coefficients over [0, 1] are p (de Casteljau's)."""
    q = p
    order = wp.int32(1)
    while order <= DEGREE:
        n = wp.int32(0)
        while n <= DEGREE - order:
            q[n] = wp.lerp(q[n], q[n + 1], low)
            n += 1
        order += 1
    t = (high - low) / (1.0 - low)
    order = wp.int32(1)
    while order <= DEGREE:
        n = DEGREE
        while n >= order:
            q[n] = wp.lerp(q[n - 1], q[n], t)
            n -= 1
        order += 1
    return q


@wp.func
def bernstein_value(p: BERNSTEIN, s: wp.float32) -> wp.vec2:
    """(value, derivative) at s."""
    q = p
    order = wp.int32(1)
    while order < DEGREE:
        n = wp.int32(0)
        while n <= DEGREE - order:
            q[n] = wp.lerp(q[n], q[n + 1], s)
            n += 1
        order += 1
    return wp.vec2(wp.lerp(q[0], q[1], s), wp.float32(DEGREE) * (q[1] - q[0]))


@wp.func
def only_crossing(p: BERNSTEIN, inside: wp.bool) -> wp.float32:
    """Where a polynomial whose coefficients change their sign once does, to the last bit."""
    a = wp.float32(0.0)
    b = wp.float32(1.0)
    s = wp.clamp(p[0] / (p[0] - p[9]), 0.0, 1.0)
    for _k in range(wp.static(ITERATIONS)):
        f = bernstein_value(p, s)
        if (f[0] < 0.0) == inside:
            a = s
        else:
            b = s
        following = s - f[0] / f[1]
        # False for NaN, too.
        if not (following > a and following < b):
            following = 0.5 * (a + b)
        if following == s or following == a or following == b:
            break
        s = following
    return s


@wp.func
def first_crossing(p: BERNSTEIN, size: wp.float32, inside: wp.bool) -> wp.float32:
    """The first s in [0, 1] behind which phi is no longer negative (``inside``), or is so; -1: there is none.

    A part is passed if all its coefficients have the sign that the ray carries; one with a single change holds one
    root; others are halved. Parts are visited from the front, each once, and there are 2^``DEEPEST`` at most: no bound
    is left that could be exhausted. Where the coefficients are rounding, or a part is as short as it may become, its
    far end decides.
    """
    level = wp.int32(0)
    n = wp.int32(0)
    width = wp.float32(1.0)
    while level >= 0:
        low = wp.float32(n) * width
        q = p
        if level > 0:
            q = bernstein_part(p, low, low + width)
        changes = wp.int32(0)
        most = wp.abs(q[0])
        before = (q[0] < 0.0) != inside
        if before:
            return low
        for m in range(1, 10):
            wrong = (q[m] < 0.0) != inside
            if wrong != before:
                changes += 1
            before = wrong
            most = wp.max(most, wp.abs(q[m]))
        if changes == 1:
            return low + width * only_crossing(q, inside)
        if changes > 1 and level < wp.static(DEEPEST) and most > wp.static(FAINT) * size:
            level += 1
            n *= 2
            width *= 0.5
        else:
            if before:
                return low + width
            n += 1
            while level > 0 and (n & 1) == 0:
                n = n >> 1
                level -= 1
                width *= 2.0
            if level == 0:
                level = -1
    return -1.0
