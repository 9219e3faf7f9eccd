"""Networks of signed distances: a kind of shapes (``network.py``)."""

import functools

import warp as wp

from warp_psdr.kernels.lanes.grid_lanes import make_grid_lanes
from warp_psdr.kernels.primitive.affine import from_axes
from warp_psdr.kernels.primitive.kind import FLOWS, Kind
from warp_psdr.kernels.primitive.network import clear_of_network, network_of, step_off_network
from warp_psdr.kernels.primitive.network_surface import (
    make_network_surface,
    network_bend,
    network_normal,
    network_point,
)
from warp_psdr.kernels.primitive.sdfgrid import PATCH, boxed_position, unpack, voxel_number, voxel_of
from warp_psdr.kernels.primitive.sdfgrid_adjoint import make_sdfgrid_sink
from warp_psdr.kernels.primitive.sdfgrid_walk import make_sdfgrid_hit
from warp_psdr.kernels.primitive.sliding import make_sliding_jvp
from warp_psdr.kernels.primitive.turned_normal import turned_normal
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def network_turn(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32, x_dot: wp.vec3) -> wp.vec3:
    """The rate of the unit normal as a point moves over the surface, by the Hessian."""
    n = network_of(scene, tri)
    at = network_point(scene, n, u, v)
    bent = network_bend(scene, n, at.p, wp.cw_mul(n.cells, from_axes(tri, x_dot)))
    return turned_normal(tri, wp.cw_mul(n.cells, at.gradient), wp.cw_mul(n.cells, bent))


@wp.func
def network_patch(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> wp.int32:
    """A block of cells."""
    n = network_of(scene, tri)
    return voxel_number(n, voxel_of(n, wp.cw_mul(n.cells, unpack(u, v))), PATCH)


def _sink(role: str, _uv: bool, _tangent: bool, _rays: bool, flow: bool) -> wp.Function:
    return make_sdfgrid_sink(role, False, True, flow)


NETWORK = Kind(
    number=7,
    moves=FLOWS,
    make_hit=lambda _shadow: make_sdfgrid_hit(False, True),
    make_lanes=functools.partial(make_grid_lanes, cubic=False, network=True),
    make_surface=lambda _uv, tangent: make_network_surface(tangent),
    position=boxed_position,
    normal=network_normal,
    step=step_off_network,
    clear=clear_of_network,
    make_sink=_sink,
    make_velocity=lambda uv, tangent, flow: make_sliding_jvp(
        _sink("forward", uv, tangent, True, flow), False, False, flow
    ),
    make_turn=lambda: network_turn,
    patch=network_patch,
)
