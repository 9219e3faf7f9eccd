"""Signed distances on a grid: the surface phi = 0 of the tri-linear interpolation of values at nodes.

The nodes fill the corners of [0, 1]^3, in front of the pose ``to_world``. The flat values hold the pose, the
``HEADER``, the grid, x fastest, the ``reach`` of each voxel, and a block of voxels that contains the surface. The reach
is the number of voxels, along the axes or across, to the nearest voxel that the surface may pass, and 0 in those. In
one voxel phi is a cubic polynomial along a ray. A point q of [0, 1]^3 is held as two numbers, whose bits are
fixed-point coordinates: 21 bits of x, 21 of y, 20 of z.

Derivation: ``docs/theory/implicit.md#grids``.
"""

import warp as wp

from warp_psdr.kernels.primitive.affine import to_axes
from warp_psdr.kernels.reading import load_float, load_vec3
from warp_psdr.kernels.structs import Scene, Triangle

#: Values between the first one of the pose and the grid: 16 of the pose, the nodes along x, y and z, and whether the
#: shading normals are smooth.
HEADER = 20
#: Most steps of a root between its bounds: bisection alone reaches the last bit in fewer.
ITERATIONS = 48
#: Steps of the fixed-point coordinates in [0, 1]; those of z are two.
STEPS = 2097152.0
#: Halvings of the number of a voxel of smooth grids, and a cell of networks, to that of a block (``Kind.patch``).
PATCH = 1


@wp.struct
class Grid:
    """Where the values of a grid are."""

    first: wp.int32  # flat offset of the node (0, 0, 0)
    reach: wp.int32  # the same of the voxels' reaches
    nx: wp.int32  # nodes
    ny: wp.int32
    nz: wp.int32
    smooth: wp.int32  # 1: shading normals are interpolated
    cells: wp.vec3  # voxels along the axes
    low: wp.vec3  # the block of voxels in which rays look for the surface
    high: wp.vec3


@wp.struct
class Voxel:
    """The values at the corners of a voxel, named by their x, y, z."""

    v000: wp.float32
    v100: wp.float32
    v010: wp.float32
    v110: wp.float32
    v001: wp.float32
    v101: wp.float32
    v011: wp.float32
    v111: wp.float32


@wp.func
def grid_of(scene: Scene, tri: Triangle) -> Grid:
    g = Grid()
    g.first = tri.i0 + wp.static(HEADER)
    g.nx = wp.int32(load_float(scene.values, tri.i0 + 16))
    g.ny = wp.int32(load_float(scene.values, tri.i0 + 17))
    g.nz = wp.int32(load_float(scene.values, tri.i0 + 18))
    g.smooth = wp.int32(load_float(scene.values, tri.i0 + 19))
    g.reach = g.first + g.nx * g.ny * g.nz
    g.cells = wp.vec3(wp.float32(g.nx - 1), wp.float32(g.ny - 1), wp.float32(g.nz - 1))
    block = g.reach + (g.nx - 1) * (g.ny - 1) * (g.nz - 1)
    g.low = load_vec3(scene.values, block)
    g.high = load_vec3(scene.values, block + 3)
    return g


@wp.func
def voxel_at(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32) -> Voxel:
    p = g.first + (k * g.ny + j) * g.nx + i
    q = p + g.nx * g.ny
    c = Voxel()
    c.v000 = load_float(scene.values, p)
    c.v100 = load_float(scene.values, p + 1)
    c.v010 = load_float(scene.values, p + g.nx)
    c.v110 = load_float(scene.values, p + g.nx + 1)
    c.v001 = load_float(scene.values, q)
    c.v101 = load_float(scene.values, q + 1)
    c.v011 = load_float(scene.values, q + g.nx)
    c.v111 = load_float(scene.values, q + g.nx + 1)
    return c


@wp.func
def voxel_corner(i: wp.int32, j: wp.int32, k: wp.int32) -> wp.vec3:
    return wp.vec3(wp.float32(i), wp.float32(j), wp.float32(k))


@wp.func
def voxel_of(g: Grid, p: wp.vec3) -> wp.vec3i:
    """The voxel around a point, in voxels."""
    return wp.vec3i(
        wp.clamp(wp.int32(p[0]), 0, g.nx - 2),
        wp.clamp(wp.int32(p[1]), 0, g.ny - 2),
        wp.clamp(wp.int32(p[2]), 0, g.nz - 2),
    )


@wp.func
def voxel_number(g: Grid, at: wp.vec3i, halvings: wp.int32) -> wp.int32:
    """The number of a voxel, or of a block of them, whose sides have 2^halvings."""
    return ((at[2] >> halvings) * g.ny + (at[1] >> halvings)) * g.nx + (at[0] >> halvings)


@wp.func
def value_and_gradient(c: Voxel, x: wp.vec3) -> wp.vec4:
    """(gradient, phi) at the place x in a voxel, [0, 1]^3."""
    x00 = wp.lerp(c.v000, c.v100, x[0])
    x10 = wp.lerp(c.v010, c.v110, x[0])
    x01 = wp.lerp(c.v001, c.v101, x[0])
    x11 = wp.lerp(c.v011, c.v111, x[0])
    y0 = wp.lerp(x00, x10, x[1])
    y1 = wp.lerp(x01, x11, x[1])
    d0 = wp.lerp(c.v100 - c.v000, c.v110 - c.v010, x[1])
    d1 = wp.lerp(c.v101 - c.v001, c.v111 - c.v011, x[1])
    return wp.vec4(wp.lerp(d0, d1, x[2]), wp.lerp(x10 - x00, x11 - x01, x[2]), y1 - y0, wp.lerp(y0, y1, x[2]))


@wp.func
def cubic_along(c: Voxel, x: wp.vec3, d: wp.vec3) -> wp.vec4:
    """Coefficients, constant first, of phi(x + s d) in a voxel."""
    # phi = a + z b, both of the form (1, x, y, xy) . coefficients.
    a0 = c.v000
    a1 = c.v100 - c.v000
    a2 = c.v010 - c.v000
    a3 = (c.v110 - c.v010) - a1
    b0 = c.v001 - c.v000
    b1 = (c.v101 - c.v001) - a1
    b2 = (c.v011 - c.v001) - a2
    b3 = ((c.v111 - c.v011) - (c.v101 - c.v001)) - a3
    m0 = x[0] * x[1]
    m1 = x[0] * d[1] + x[1] * d[0]
    m2 = d[0] * d[1]
    u0 = a0 + a1 * x[0] + a2 * x[1] + a3 * m0
    u1 = a1 * d[0] + a2 * d[1] + a3 * m1
    u2 = a3 * m2
    w0 = b0 + b1 * x[0] + b2 * x[1] + b3 * m0
    w1 = b1 * d[0] + b2 * d[1] + b3 * m1
    w2 = b3 * m2
    return wp.vec4(u0 + x[2] * w0, u1 + x[2] * w1 + d[2] * w0, u2 + x[2] * w2 + d[2] * w1, d[2] * w2)


@wp.func
def polynomial(c: wp.vec4, s: wp.float32) -> wp.float32:
    return c[0] + s * (c[1] + s * (c[2] + s * c[3]))


@wp.func
def bracketed(c: wp.vec4, low: wp.float32, high: wp.float32, inside: wp.bool) -> wp.float32:
    """Where a cubic, monotone in [low, high], becomes negative, or with ``inside`` ceases to be."""
    a = wp.float32(low)
    b = wp.float32(high)
    s = 0.5 * (low + high)
    for _k in range(wp.static(ITERATIONS)):
        f = polynomial(c, s)
        if (f < 0.0) == inside:
            a = s
        else:
            b = s
        following = s - f / (c[1] + s * (2.0 * c[2] + 3.0 * s * c[3]))
        # False for NaN, too.
        if not (following > a and following < b):
            following = 0.5 * (a + b)
        if following == s or following == a or following == b:
            break
        s = following
    return s


@wp.func
def first_root(c: wp.vec4, inside: wp.bool) -> wp.float32:
    """The first s in [0, 1] behind which a cubic is no longer negative (``inside``), or is so; -1: there is none.

    The cubic is monotone between the roots of its derivative.
    """
    r0 = wp.float32(1.0)
    r1 = wp.float32(1.0)
    discriminant = c[2] * c[2] - 3.0 * c[3] * c[1]
    if discriminant > 0.0:
        q = -(c[2] + wp.where(c[2] >= 0.0, 1.0, -1.0) * wp.sqrt(discriminant))
        # Infinite where the cubic is a parabola; q is not 0.
        a = q / (3.0 * c[3])
        b = c[1] / q
        r0 = wp.clamp(wp.min(a, b), 0.0, 1.0)
        r1 = wp.clamp(wp.max(a, b), 0.0, 1.0)
    low = wp.float32(0.0)
    for piece in range(3):
        high = wp.where(piece == 0, r0, wp.where(piece == 1, r1, 1.0))
        if high > low or piece == 2:
            if (polynomial(c, high) < 0.0) != inside:
                return bracketed(c, low, high, inside)
            low = high
    return -1.0


@wp.func
def pack(q: wp.vec3) -> wp.vec2:
    """Two numbers whose bits hold a point of [0, 1]^3; both are finite: bit 30 is 0."""
    x = wp.min(wp.uint32(wp.clamp(q[0], 0.0, 1.0) * wp.static(STEPS)), wp.uint32(2097151))
    y = wp.min(wp.uint32(wp.clamp(q[1], 0.0, 1.0) * wp.static(STEPS)), wp.uint32(2097151))
    z = wp.min(wp.uint32(wp.clamp(q[2], 0.0, 1.0) * wp.static(0.5 * STEPS)), wp.uint32(1048575))
    low = z & wp.uint32(1023)
    high = z >> wp.uint32(10)
    a = x | ((low & wp.uint32(511)) << wp.uint32(21)) | ((low >> wp.uint32(9)) << wp.uint32(31))
    b = y | ((high & wp.uint32(511)) << wp.uint32(21)) | ((high >> wp.uint32(9)) << wp.uint32(31))
    return wp.vec2(wp.cast(a, wp.float32), wp.cast(b, wp.float32))


@wp.func
def unpack(u: wp.float32, v: wp.float32) -> wp.vec3:
    """The point that two numbers hold."""
    a = wp.cast(u, wp.uint32)
    b = wp.cast(v, wp.uint32)
    low = ((a >> wp.uint32(21)) & wp.uint32(511)) | ((a >> wp.uint32(31)) << wp.uint32(9))
    high = ((b >> wp.uint32(21)) & wp.uint32(511)) | ((b >> wp.uint32(31)) << wp.uint32(9))
    return wp.vec3(
        (wp.float32(a & wp.uint32(2097151)) + 0.5) * wp.static(1.0 / STEPS),
        (wp.float32(b & wp.uint32(2097151)) + 0.5) * wp.static(1.0 / STEPS),
        (wp.float32(low | (high << wp.uint32(10))) + 0.5) * wp.static(2.0 / STEPS),
    )


@wp.func
def boxed_position(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
    """The point of the box that two numbers hold, in the world."""
    return tri.normal + to_axes(tri, unpack(u, v))
