"""Points at which segments can touch a tri-linear grid of signed distances: creases, and the surface inside of voxels.

The normal jumps where the surface passes a face between two voxels: the face holds a curved edge between two sheets, a
crease. An *item* is a face or a voxel that the surface passes. Its number is 4 n + kind, with n the node in front of
it; kinds 0 to 2 are the faces across that axis in front of the voxel, and kind 3 is the voxel. Lengths and areas are
measured in voxels; the vectors of a point are in the world.

Derivation: ``docs/theory/implicit.md#creases``.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.guiding.slots import Slots
from warp_psdr.kernels.boundary.silhouette.edge_on import is_beside
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes, make_pose_sink, to_axes
from warp_psdr.kernels.primitive.sdfgrid import Grid, Voxel, grid_of, value_and_gradient, voxel_at, voxel_corner
from warp_psdr.kernels.primitive.sdfgrid_adjoint import bend_of, make_voxel_sink, mixed_differences
from warp_psdr.kernels.structs import Scene, Triangle

#: Kind of an item that is a voxel.
VOXEL_ITEM = wp.constant(3)
#: Slope inside of a face over that across it, below which a crease has no direction.
LEVEL = 1.0e-6
#: ``edge_on.py``'s sine for sheets of voxels, whose normals are differences of values.
EDGEWISE_IN_GRIDS = 4.0e-6


@wp.struct
class GridItems:
    """Items of grids, by record and number.

    With the first ``aimed`` of them segments are drawn towards lights, with all a fraction ``share`` of the segments in
    directions of their own. ``slots`` are read by guided kernels.
    """

    items: wp.array(dtype=wp.vec2i)
    aimed: wp.int32
    share: wp.float32
    slots: Slots


@wp.struct
class TouchPoint:
    """A point of a crease, or of the surface in a voxel."""

    valid: wp.int32
    face: wp.int32  # number of the record
    crease: wp.int32  # 1: of a crease
    convex: wp.int32  # 1: of one whose sheets fall away from it
    i: wp.int32  # the voxel
    j: wp.int32
    k: wp.int32
    place: wp.vec3  # in it, [0, 1]^3
    q: wp.vec3  # in [0, 1]^3
    x: wp.vec3
    gradient: wp.vec3  # of phi, in voxels; of a crease: in the face
    mixed: wp.vec3  # second derivatives (``mixed_differences``)
    pure: wp.vec3  # those by x, y and z alone, of smooth grids
    roots: wp.float32  # of smooth grids: points of a line or a slice that this one stands for
    density: wp.float32  # per length of the curve, or area of the surface, in voxels
    along: wp.vec3  # tangent of the curve, one voxel long
    out: wp.vec3  # unit normal to the outside, not of creases
    up: wp.vec3  # of creases: into the sheet of the voxel, and into that in front of the face
    down: wp.vec3


@wp.func
def turn_voxel(c: Voxel, axis: wp.int32) -> Voxel:
    """The voxel with an axis as its first one; the others follow in turn."""
    r = c
    if axis == 1:
        r.v100 = c.v010
        r.v010 = c.v001
        r.v001 = c.v100
        r.v110 = c.v011
        r.v101 = c.v110
        r.v011 = c.v101
    if axis == 2:
        r.v100 = c.v001
        r.v010 = c.v100
        r.v001 = c.v010
        r.v110 = c.v101
        r.v101 = c.v011
        r.v011 = c.v110
    return r


@wp.func
def turn_axes(w: wp.vec3, axis: wp.int32) -> wp.vec3:
    return wp.vec3(w[axis], w[(axis + 1) % 3], w[(axis + 2) % 3])


@wp.func
def turn_axes_back(w: wp.vec3, axis: wp.int32) -> wp.vec3:
    return wp.vec3(w[(3 - axis) % 3], w[(4 - axis) % 3], w[(5 - axis) % 3])


@wp.func
def item_parts(g: Grid, number: wp.int32) -> wp.vec4i:
    """(i, j, k, kind)."""
    node = number >> 2
    return wp.vec4i(node % g.nx, (node // g.nx) % g.ny, node // (g.nx * g.ny), number & 3)


@wp.func
def from_voxels(tri: Triangle, g: Grid, w: wp.vec3) -> wp.vec3:
    """A direction that is measured in voxels, in the world."""
    return to_axes(tri, wp.cw_div(w, g.cells))


@wp.func
def eye_in_voxels(tri: Triangle, g: Grid, eye: wp.vec3, distant: wp.bool) -> wp.vec3:
    """A point, or with ``distant`` a direction, of the world."""
    here = from_axes(tri, eye)
    if not distant:
        here = from_axes(tri, eye - tri.normal)
    return wp.cw_mul(g.cells, here)


@wp.func
def place_point(tri: Triangle, g: Grid, point: TouchPoint) -> TouchPoint:
    r = point
    r.q = wp.cw_div(voxel_corner(r.i, r.j, r.k) + r.place, g.cells)
    r.x = tri.normal + to_axes(tri, r.q)
    return r


@wp.func
def spread(n: wp.vec3) -> wp.float32:
    """Sum of the sizes of a unit vector's components."""
    return wp.abs(n[0]) + wp.abs(n[1]) + wp.abs(n[2])


@wp.func
def crease_point(scene: Scene, tri: Triangle, g: Grid, at: wp.vec4i, u: wp.float32) -> TouchPoint:
    """Point of the curve in a face: on a line along one of the face's axes, each as likely, with one root at most.

    Its density is that of both, the balance heuristic's.
    """
    r = TouchPoint()
    axis = at[3]
    r.crease = 1
    r.i = at[0]
    r.j = at[1]
    r.k = at[2]
    c = turn_voxel(voxel_at(scene, g, r.i, r.j, r.k), axis)
    before = turn_voxel(
        voxel_at(
            scene, g, r.i - wp.where(axis == 0, 1, 0), r.j - wp.where(axis == 1, 1, 0), r.k - wp.where(axis == 2, 1, 0)
        ),
        axis,
    )
    y = wp.float32(0.0)
    z = wp.float32(0.0)
    f0 = wp.float32(0.0)
    f1 = wp.float32(0.0)
    if u < 0.5:
        y = 2.0 * u
        f0 = wp.lerp(c.v000, c.v010, y)
        f1 = wp.lerp(c.v001, c.v011, y)
    else:
        z = 2.0 * u - 1.0
        f0 = wp.lerp(c.v000, c.v001, z)
        f1 = wp.lerp(c.v010, c.v011, z)
    if (f0 < 0.0) == (f1 < 0.0):
        return r
    root = wp.clamp(f0 / (f0 - f1), 0.0, 1.0)
    if u < 0.5:
        z = root
    else:
        y = root
    gy = wp.lerp(c.v010 - c.v000, c.v011 - c.v001, z)
    gz = wp.lerp(c.v001 - c.v000, c.v011 - c.v010, y)
    here = wp.vec3(0.0, y, z)
    rise_up = value_and_gradient(c, here)[0]
    rise_down = value_and_gradient(before, wp.vec3(1.0, y, z))[0]
    length = wp.sqrt(gy * gy + gz * gz)
    if length <= LEVEL * (wp.abs(rise_up) + wp.abs(rise_down)):
        return r
    gy /= length
    gz /= length
    r.valid = 1
    r.convex = wp.where(rise_up > rise_down, 1, 0)
    r.density = 0.5 * (wp.abs(gy) + wp.abs(gz))
    r.place = turn_axes_back(here, axis)
    r.gradient = length * turn_axes_back(wp.vec3(0.0, gy, gz), axis)
    r.along = from_voxels(tri, g, turn_axes_back(wp.vec3(0.0, -gz, gy), axis))
    up = rise_up / length
    down = rise_down / length
    r.up = from_voxels(tri, g, turn_axes_back(wp.vec3(1.0, -up * gy, -up * gz), axis))
    r.down = from_voxels(tri, g, turn_axes_back(wp.vec3(-1.0, down * gy, down * gz), axis))
    return place_point(tri, g, r)


@wp.func
def with_surface(tri: Triangle, g: Grid, voxel: Voxel, point: TouchPoint) -> TouchPoint:
    """Fill in what the surface is like at a place of a voxel."""
    r = point
    found = value_and_gradient(voxel, r.place)
    r.gradient = wp.vec3(found[0], found[1], found[2])
    r.mixed = mixed_differences(voxel, r.place)
    r.out = wp.normalize(cofactor(tri, wp.cw_mul(g.cells, r.gradient)))
    if determinant(tri) < 0.0:
        r.out = -r.out
    r.valid = wp.where(wp.length_sq(r.gradient) > 0.0, 1, 0)
    return place_point(tri, g, r)


@wp.func
def curve_direction(point: TouchPoint, eye: wp.vec3, distant: wp.bool) -> wp.vec3:
    """Tangent of the silhouette from an eye, in voxels, of unit length: along grad phi x H (x - eye)."""
    away = eye
    if not distant:
        away = voxel_corner(point.i, point.j, point.k) + point.place - eye
    return wp.normalize(wp.cross(point.gradient, bend_of(point.mixed, away)))


@wp.func
def curve_density(t: wp.vec3) -> wp.float32:
    """Density of ``curve_point`` per length, t from ``curve_direction``: three axes, two places for roots."""
    return spread(t) / 6.0


@wp.func
def curve_point(
    scene: Scene, tri: Triangle, g: Grid, at: wp.vec4i, eye: wp.vec3, distant: wp.bool, u: wp.float32
) -> TouchPoint:
    """Point of the silhouette that an eye, in voxels, sees in a voxel: in a slice across an axis, one of two roots.

    In a slice phi and grad phi . (x - eye) are both bilinear, (a_0 + a_1 y) + z (a_2 + a_3 y) and so on; without z a
    quadratic equation is left.
    """
    r = TouchPoint()
    r.i = at[0]
    r.j = at[1]
    r.k = at[2]
    voxel = voxel_at(scene, g, r.i, r.j, r.k)
    case = wp.clamp(wp.int32(6.0 * u), 0, 5)
    axis = case >> 1
    x = 6.0 * u - wp.float32(case)
    c = turn_voxel(voxel, axis)
    a0 = wp.lerp(c.v000, c.v100, x)
    a1 = wp.lerp(c.v010, c.v110, x) - a0
    a2 = wp.lerp(c.v001, c.v101, x) - a0
    a3 = wp.lerp(c.v011, c.v111, x) - wp.lerp(c.v001, c.v101, x) - a1
    d0 = c.v100 - c.v000
    d1 = (c.v110 - c.v010) - d0
    d2 = (c.v101 - c.v001) - d0
    d3 = ((c.v111 - c.v011) - (c.v101 - c.v001)) - d1
    p0 = wp.float32(0.0)
    p1 = wp.float32(0.0)
    p2 = wp.float32(0.0)
    p3 = wp.float32(0.0)
    if distant:
        w = turn_axes(eye, axis)
        p0 = d0 * w[0] + a1 * w[1] + a2 * w[2]
        p1 = d1 * w[0] + a3 * w[2]
        p2 = d2 * w[0] + a3 * w[1]
        p3 = d3 * w[0]
    else:
        e = turn_axes(eye - voxel_corner(r.i, r.j, r.k), axis)
        away = x - e[0]
        p0 = d0 * away - a1 * e[1] - a2 * e[2]
        p1 = d1 * away + a1 - a3 * e[2]
        p2 = d2 * away + a2 - a3 * e[1]
        p3 = d3 * away + 2.0 * a3
    qa = a1 * p3 - p1 * a3
    qb = a0 * p3 + a1 * p2 - p0 * a3 - p1 * a2
    qc = a0 * p2 - p0 * a2
    discriminant = qb * qb - 4.0 * qa * qc
    if discriminant < 0.0:
        return r
    root = -0.5 * (qb + wp.where(qb < 0.0, -1.0, 1.0) * wp.sqrt(discriminant))
    y = wp.where((case & 1) == 0, root / qa, qc / root)
    # False for NaN, too.
    if not (y >= 0.0 and y <= 1.0):
        return r
    by_phi = a2 + a3 * y
    by_psi = p2 + p3 * y
    of_phi = wp.abs(a1) + wp.abs(a2) + wp.abs(a3)
    of_psi = wp.abs(p1) + wp.abs(p2) + wp.abs(p3)
    z = wp.where(wp.abs(by_phi) * of_psi >= wp.abs(by_psi) * of_phi, -(a0 + a1 * y) / by_phi, -(p0 + p1 * y) / by_psi)
    if not (z >= 0.0 and z <= 1.0):
        return r
    r.place = turn_axes_back(wp.vec3(x, y, z), axis)
    r = with_surface(tri, g, voxel, r)
    t = curve_direction(r, eye, distant)
    r.density = curve_density(t)
    r.along = from_voxels(tri, g, t)
    r.valid = wp.where(r.density > 0.0, r.valid, 0)
    return r


@wp.func
def surface_density(point: TouchPoint) -> wp.float32:
    """Density per area, in voxels, of points on lines along one of three axes, each as likely."""
    return spread(wp.normalize(point.gradient)) / 3.0


@wp.func
def surface_point(scene: Scene, tri: Triangle, g: Grid, at: wp.vec4i, u: wp.float32, v: wp.float32) -> TouchPoint:
    """Point of the surface in a voxel: on a line along one of three axes, with one root at most."""
    r = TouchPoint()
    r.i = at[0]
    r.j = at[1]
    r.k = at[2]
    voxel = voxel_at(scene, g, r.i, r.j, r.k)
    axis = wp.clamp(wp.int32(3.0 * u), 0, 2)
    y = 3.0 * u - wp.float32(axis)
    c = turn_voxel(voxel, axis)
    f0 = value_and_gradient(c, wp.vec3(0.0, y, v))[3]
    f1 = value_and_gradient(c, wp.vec3(1.0, y, v))[3]
    if (f0 < 0.0) == (f1 < 0.0):
        return r
    r.place = turn_axes_back(wp.vec3(wp.clamp(f0 / (f0 - f1), 0.0, 1.0), y, v), axis)
    r = with_surface(tri, g, voxel, r)
    r.density = surface_density(r)
    return r


@wp.func
def area_of_voxel_area(tri: Triangle, g: Grid, point: TouchPoint) -> wp.float32:
    """Area in the world of a unit of area in voxels, at a point of the surface."""
    across = wp.cw_mul(g.cells, wp.normalize(point.gradient))
    return wp.length(cofactor(tri, across)) / (g.cells[0] * g.cells[1] * g.cells[2])


@wp.func
def touch_curvature(tri: Triangle, g: Grid, point: TouchPoint, w: wp.vec3) -> wp.float32:
    """Normal curvature kappa_n of the surface along a tangent w, positive where it curves away; 0 where it is flat."""
    slope = wp.length(cofactor(tri, wp.cw_mul(g.cells, point.gradient))) / wp.abs(determinant(tri))
    along = wp.cw_mul(g.cells, from_axes(tri, w))
    curvature = wp.dot(along, bend_of(point.mixed, along)) / slope
    # A voxel is 1 / |along| long.
    return wp.where(wp.abs(curvature) < wp.static(EDGEWISE_IN_GRIDS) * wp.length(along), 0.0, curvature)


@wp.func
def crease_side(point: TouchPoint, w: wp.vec3) -> wp.float32:
    """+1 or -1 if both sheets of a crease lie on that side of the plane with the normal ``along`` x w; else 0.

    Concave creases, which their own sheets hide, have no segments that touch them: 0.
    """
    m = wp.cross(point.along, w)
    side = wp.float32(0.0)
    edge_on = wp.static(EDGEWISE_IN_GRIDS)
    if is_beside(point.up, m, w, edge_on) and is_beside(point.down, m, w, edge_on):
        side = 1.0
    elif is_beside(point.up, -m, w, edge_on) and is_beside(point.down, -m, w, edge_on):
        side = -1.0
    return wp.where(point.convex == 1, side, 0.0)


@wp.func
def shows_both_sheets(point: TouchPoint, w: wp.vec3) -> wp.bool:
    """Whether a ray along w that meets a crease meets one sheet on one side of it, and the other on the other."""
    m = wp.cross(point.along, w)
    return wp.dot(m, point.up) * wp.dot(m, point.down) < 0.0


@wp.func
def ahead_of_sheet(point: TouchPoint, w: wp.vec3, out: wp.vec3) -> wp.float32:
    """How far in front of a crease rays along w, beside it along ``out``, meet its sheets, over their distance."""
    t = wp.normalize(point.along)
    e = wp.normalize(w - wp.dot(w, t) * t)
    up = -wp.dot(point.up, e) / wp.max(wp.abs(wp.dot(point.up, out)), 1.0e-30)
    down = -wp.dot(point.down, e) / wp.max(wp.abs(wp.dot(point.down, out)), 1.0e-30)
    return wp.max(wp.max(up, down), 0.0) / wp.max(wp.dot(w, e), 1.0e-30)


@wp.func
def choose_item(found: GridItems, count: wp.int32, u: wp.float64) -> tuple[wp.int32, wp.float32]:
    """One of the first ``count`` items, each as likely, and u within it."""
    scaled = u * wp.float64(count)
    n = wp.min(wp.int32(scaled), count - 1)
    return n, wp.clamp(wp.float32(scaled - wp.float64(n)), 0.0, 0.9999999)


class VoxelFunctions(NamedTuple):
    """What tells grids, and networks with cells for voxels, from each other; lengths and eyes are in voxels.

    Attributes:
        record: ``(scene, tri) -> Grid``.
        seen: ``(scene, tri, g, parts, eye, distant, along, choice) -> TouchPoint`` of the curve that an eye sees.
        place: ``(scene, tri, g, parts, along, across, choice) -> TouchPoint`` of the surface.
        curvature: ``(tri, g, point, w) -> float``: kappa_n in the world.
        direction: ``(point, eye, distant) -> vec3``: unit tangent of the silhouette.
        density: ``(tangent) -> float``: of ``seen`` per length.
        make_sink: ``(role) -> (scene, target, point, g) -> float``: the adjoint g of a point (``make_touch_sink``).
        roots: whether a line or a slice may hold several points, one of which is drawn.
        front: creases that are seen from the front, alone.
    """

    record: wp.Function
    seen: wp.Function
    place: wp.Function
    curvature: wp.Function
    direction: wp.Function
    density: wp.Function
    make_sink: Callable[[str], wp.Function]
    roots: bool = True
    front: bool = False


def make_touch_sink(role: str, record: wp.Function, accumulate_phi: wp.Function) -> wp.Function:
    """Return ``accumulate(scene, target, point, g) -> float``: the adjoint g of a point, across its curve or surface.

    The velocity is A' q + b' + A q', q' = -phi' gradient / |gradient|^2, of creases in the face
    (``docs/theory/implicit.md#creases``).

    Args:
        role: as of all sinks.
        record: as of ``VoxelFunctions``.
        accumulate_phi: ``(scene, target, g, point, a_phi) -> float``: the adjoint of phi at a point.
    """
    accumulate_pose = make_pose_sink(role)

    @wp.func
    def accumulate_touch(scene: Scene, target: wp.array(dtype=wp.float32), point: TouchPoint, a: wp.vec3) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        tri = scene.triangles[point.face]
        g = record(scene, tri)
        # A^T a in voxels: x = A p / cells + b.
        pulled = wp.cw_div(wp.vec3(wp.dot(tri.p0, a), wp.dot(tri.p1, a), wp.dot(tri.p2, a)), g.cells)
        a_phi = -wp.dot(pulled, point.gradient) / wp.length_sq(point.gradient)
        total = accumulate_phi(scene, target, g, point, a_phi)
        return total + accumulate_pose(target, tri, point.q[0] * a, point.q[1] * a, point.q[2] * a, a)

    return accumulate_touch


@functools.cache
def make_linear_touch_sink(role: str) -> wp.Function:
    """Return ``make_touch_sink``'s function for linear grids."""
    accumulate_voxel = make_voxel_sink(role)

    @wp.func
    def accumulate_linear_phi(
        scene: Scene, target: wp.array(dtype=wp.float32), g: Grid, point: TouchPoint, a_phi: wp.float32
    ) -> wp.float32:
        zero = wp.vec3(0.0, 0.0, 0.0)
        return accumulate_voxel(target, g, point.i, point.j, point.k, point.place, a_phi, zero)

    return make_touch_sink(role, grid_of, accumulate_linear_phi)
