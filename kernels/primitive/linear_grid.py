"""Grids of signed distances, tri-linear in their voxels: a kind of shapes (``sdfgrid.py``)."""

import functools

import warp as wp

from warp_psdr.kernels.lanes.grid_lanes import make_grid_lanes
from warp_psdr.kernels.primitive.affine import from_axes
from warp_psdr.kernels.primitive.kind import SLIDES, Kind
from warp_psdr.kernels.primitive.sdfgrid import boxed_position, grid_of, unpack, voxel_corner, voxel_number, voxel_of
from warp_psdr.kernels.primitive.sdfgrid_adjoint import bend_of, make_sdfgrid_sink, mixed_differences
from warp_psdr.kernels.primitive.sdfgrid_surface import held_point, make_sdfgrid_surface, sdfgrid_normal
from warp_psdr.kernels.primitive.sdfgrid_walk import make_sdfgrid_hit
from warp_psdr.kernels.primitive.sliding import make_sliding_jvp
from warp_psdr.kernels.primitive.turned_normal import turned_normal
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def linear_turn(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32, x_dot: wp.vec3) -> wp.vec3:
    """The rate of the unit normal as a point moves over a grid, in one voxel."""
    g = grid_of(scene, tri)
    at = held_point(scene, g, u, v)
    place = at.p - voxel_corner(at.i, at.j, at.k)
    bent = bend_of(mixed_differences(at.voxel, place), wp.cw_mul(g.cells, from_axes(tri, x_dot)))
    return turned_normal(tri, wp.cw_mul(g.cells, at.gradient), wp.cw_mul(g.cells, bent))


@wp.func
def linear_patch(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> wp.int32:
    """The voxel: the normal jumps to the next one."""
    g = grid_of(scene, tri)
    return voxel_number(g, voxel_of(g, wp.cw_mul(g.cells, unpack(u, v))), 0)


LINEAR_GRID = Kind(
    number=1,
    moves=SLIDES,
    make_hit=lambda _shadow: make_sdfgrid_hit(False),
    make_lanes=functools.partial(make_grid_lanes, cubic=False, network=False),
    make_surface=lambda _uv, tangent: make_sdfgrid_surface(tangent),
    position=boxed_position,
    normal=sdfgrid_normal,
    make_sink=lambda role, _uv, _tangent, _rays, _flow: make_sdfgrid_sink(role),
    make_velocity=lambda _uv, _tangent, _flow: make_sliding_jvp(make_sdfgrid_sink("forward"), False, False),
    make_turn=lambda: linear_turn,
    patch=linear_patch,
)
