"""Points of grids of signed distances and directions of their own, with densities; cubic grids and networks share them.

At a crease directions are uniform in the wedge in which it is a silhouette, or in that in which it is seen from the
front; inside of a voxel they are uniform in the tangent plane.

Derivation: ``docs/theory/implicit.md#silhouettes-of-grids``.
"""

import warp as wp

from warp_psdr.kernels.boundary.path_space.direction import Wedge, pdf_wedge, wedge_direction
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    VOXEL_ITEM,
    TouchPoint,
    VoxelFunctions,
    area_of_voxel_area,
    crease_point,
    curve_density,
    curve_direction,
    curve_point,
    from_voxels,
    make_linear_touch_sink,
    surface_density,
    surface_point,
    touch_curvature,
)
from warp_psdr.kernels.constants import INV_TWO_PI, PI, TWO_PI
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.sdfgrid import Grid, grid_of
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def crease_wedge(point: TouchPoint) -> Wedge:
    """Directions in which a crease is a silhouette: those between one sheet and what continues the other."""
    r = Wedge()
    r.t = wp.normalize(point.along)
    r.a = wp.normalize(point.up - wp.dot(point.up, r.t) * r.t)
    r.b = wp.cross(r.t, r.a)
    x = wp.dot(point.down, r.a)
    y = wp.dot(point.down, r.b)
    r.width = wp.atan2(wp.abs(y), -x)
    r.start = wp.max(wp.atan2(y, x), 0.0)
    return r


@wp.func
def front_wedge(point: TouchPoint) -> Wedge:
    """Half of the directions in which a crease is seen from the front; the other half is opposite."""
    r = crease_wedge(point)
    r.start += r.width
    r.width = PI - r.width
    return r


@wp.func
def own_density(tri: Triangle, g: Grid, point: TouchPoint, curvature: wp.float32) -> wp.float32:
    """Density of an item's point and of a direction of its own, whichever technique has drawn them."""
    if point.crease == 1:
        return point.density * pdf_wedge(crease_wedge(point))
    return surface_density(point) / area_of_voxel_area(tri, g, point) * INV_TWO_PI / curvature


@wp.func
def own_direction(point: TouchPoint, u: wp.vec2) -> wp.vec3:
    """A direction in which an item may be a silhouette: uniform in a crease's wedge, or in the tangent plane."""
    if point.crease == 1:
        return wedge_direction(crease_wedge(point), u)
    s_axis = any_tangent(point.out)
    theta = TWO_PI * u[1]
    return wp.cos(theta) * s_axis + wp.sin(theta) * wp.cross(point.out, s_axis)


@wp.func
def front_direction(tri: Triangle, g: Grid, point: TouchPoint, u: wp.vec2) -> wp.vec3:
    """A direction from the front, in which phi falls: uniform in the wedge and its opposite."""
    w = wedge_direction(front_wedge(point), u)
    normal = wp.cross(point.along, point.up)
    if wp.dot(normal, w) * wp.dot(normal, from_voxels(tri, g, point.gradient)) > 0.0:
        w = -w
    return w


@wp.func
def linear_seen(
    scene: Scene,
    tri: Triangle,
    g: Grid,
    parts: wp.vec4i,
    eye: wp.vec3,
    distant: wp.bool,
    along: wp.float32,
    choice: wp.float32,
) -> TouchPoint:
    """Point of a crease, or of the silhouette that an eye, in voxels, sees in a voxel."""
    r = TouchPoint()
    if parts[3] == VOXEL_ITEM:
        r = curve_point(scene, tri, g, parts, eye, distant, along)
    else:
        r = crease_point(scene, tri, g, parts, along)
    r.roots = 1.0
    return r


@wp.func
def linear_place(
    scene: Scene, tri: Triangle, g: Grid, parts: wp.vec4i, along: wp.float32, across: wp.float32, choice: wp.float32
) -> TouchPoint:
    """Point of a crease, or of the surface in a voxel."""
    r = TouchPoint()
    if parts[3] == VOXEL_ITEM:
        r = surface_point(scene, tri, g, parts, along, across)
    else:
        r = crease_point(scene, tri, g, parts, along)
    r.roots = 1.0
    return r


LINEAR_VOXELS = VoxelFunctions(
    record=grid_of,
    seen=linear_seen,
    place=linear_place,
    curvature=touch_curvature,
    direction=curve_direction,
    density=curve_density,
    make_sink=make_linear_touch_sink,
    roots=False,
)
#: Creases that are seen from the front, where the normal and the reflected light jump, as on flat meshes
#: (``path_space/flat_creases.py``).
CREASES = LINEAR_VOXELS._replace(front=True)
