"""Grids of signed distances, smooth cubic B-splines of their values: a kind of shapes (``sdfgrid_cubic.py``)."""

import functools

import warp as wp

from warp_psdr.kernels.lanes.grid_lanes import make_grid_lanes
from warp_psdr.kernels.primitive.affine import from_axes
from warp_psdr.kernels.primitive.kind import FLOWS, Kind
from warp_psdr.kernels.primitive.sdfgrid import (
    PATCH,
    boxed_position,
    grid_of,
    unpack,
    voxel_corner,
    voxel_number,
    voxel_of,
)
from warp_psdr.kernels.primitive.sdfgrid_adjoint import make_sdfgrid_sink
from warp_psdr.kernels.primitive.sdfgrid_cubic import spline_hessian
from warp_psdr.kernels.primitive.sdfgrid_cubic_surface import (
    make_sdfgrid_cubic_surface,
    sdfgrid_cubic_normal,
    spline_point,
)
from warp_psdr.kernels.primitive.sdfgrid_walk import make_sdfgrid_hit
from warp_psdr.kernels.primitive.sliding import make_sliding_jvp
from warp_psdr.kernels.primitive.turned_normal import turned_normal
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def cubic_turn(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32, x_dot: wp.vec3) -> wp.vec3:
    """The rate of the unit normal as a point moves over a grid, by the Hessian."""
    g = grid_of(scene, tri)
    at = spline_point(scene, g, u, v)
    x = at.p - voxel_corner(at.i, at.j, at.k)
    h = spline_hessian(scene, g, at.i, at.j, at.k, x)
    bent = h * wp.cw_mul(g.cells, from_axes(tri, x_dot))
    return turned_normal(tri, wp.cw_mul(g.cells, at.gradient), wp.cw_mul(g.cells, bent))


@wp.func
def cubic_patch(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> wp.int32:
    """A block of voxels."""
    g = grid_of(scene, tri)
    return voxel_number(g, voxel_of(g, wp.cw_mul(g.cells, unpack(u, v))), PATCH)


def _sink(role: str, _uv: bool, _tangent: bool, _rays: bool, flow: bool) -> wp.Function:
    return make_sdfgrid_sink(role, True, False, flow)


CUBIC_GRID = Kind(
    number=6,
    moves=FLOWS,
    make_hit=lambda _shadow: make_sdfgrid_hit(True),
    make_lanes=functools.partial(make_grid_lanes, cubic=True, network=False),
    make_surface=lambda _uv, tangent: make_sdfgrid_cubic_surface(tangent),
    position=boxed_position,
    normal=sdfgrid_cubic_normal,
    make_sink=_sink,
    make_velocity=lambda uv, tangent, flow: make_sliding_jvp(
        _sink("forward", uv, tangent, True, flow), False, False, flow
    ),
    make_turn=lambda: cubic_turn,
    patch=cubic_patch,
)
