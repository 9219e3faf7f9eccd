"""The signed distance of a network (``primitive/network.py``): phi over its slope at the surface, in units of its box.

A network is not a distance. Bounds of its weights say that its slope is at most L where |phi| is at most a level c. No
zero is therefore nearer than min(|phi|, c) / L, and steps of (c / L) S(|phi| / c), with S(u) <= min(u, 1), pass over no
zero. The divisor is at rest, and the motion of rays does not depend on it.

Derivation: ``docs/theory/signed_distances.md#networks``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.signed_distance.box import inside_box, known_in_box
from warp_psdr.kernels.boundary.signed_distance.distance import Distance, Field, similar_scale
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes, make_pose_sink
from warp_psdr.kernels.primitive.network import LEVEL, LEVEL_WORD, SLOPE_WORD, make_network_sink, network_of
from warp_psdr.kernels.primitive.network_expansion import network_expansion
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def distance_unit(scene: Scene, tri: Triangle) -> wp.float32:
    """World units over phi: the scale of the pose over the slope at the surface."""
    level = load_float(scene.values, network_of(scene, tri).first + wp.static(LEVEL_WORD))
    return similar_scale(tri) * wp.static(LEVEL) / level


@wp.func
def saturated(size: wp.float32) -> wp.vec2:
    """(S, its derivative) at u >= 0: u up to 1/2, and 1 - 1 / (4 u) beyond."""
    if size <= 0.5:
        return wp.vec2(size, 1.0)
    return wp.vec2(1.0 - 0.25 / size, 0.25 / (size * size))


@wp.func
def network_distance(scene: Scene, tri: Triangle, o: wp.vec3, w: wp.vec3, t: wp.float64) -> Distance:
    r = Distance()
    q = wp.vec3d(from_axes(tri, o - tri.normal)) + t * wp.vec3d(from_axes(tri, w))
    head = network_of(scene, tri).first
    e = network_expansion(scene.values, head, q)
    unit = distance_unit(scene, tri)
    g = (1.0 / determinant(tri)) * cofactor(tri, wp.vec3(e[1], e[2], e[3]))
    r.phi = unit * e[0]
    r.gradient = unit * g
    # The Hessian is A^-T H A^-1, A^-T = A / s^2.
    h = wp.mat33(e[4], e[9], e[8], e[9], e[5], e[7], e[8], e[7], e[6])
    scale = similar_scale(tri)
    turn = wp.matrix_from_cols(tri.p0, tri.p1, tri.p2) * (1.0 / (scale * scale))
    r.hessian = unit * (turn * h * wp.transpose(turn))
    # ---- Steps ----
    level = load_float(scene.values, head + wp.static(LEVEL_WORD))
    over = scale / load_float(scene.values, head + wp.static(SLOPE_WORD))
    s = saturated(wp.abs(e[0]) / level)
    r.step = over * level * s[0]
    r.step_gradient = wp.where(e[0] < 0.0, -1.0, 1.0) * over * s[1] * g
    share = inside_box(tri, wp.vec3(q))
    r.inside = share[3]
    r.inside_gradient = wp.vec3(share[0], share[1], share[2])
    return r


@functools.cache
def make_network_distance_pull(role: str):
    """Return ``pull``: phi_pi = unit phi_pi(q) - grad phi . (A' q + b'), q = A^-1 (x - b)."""
    accumulate_pose = make_pose_sink(role)
    accumulate_network = make_network_sink(role)

    @wp.func
    def pull_network_distance(
        scene: Scene, target: wp.array(dtype=wp.float32), tri: Triangle, x: wp.vec3, a_phi: wp.float32, a_g: wp.vec3
    ) -> wp.float32:
        at = network_distance(scene, tri, x, x, wp.float64(0.0))
        q = from_axes(tri, x - tri.normal)
        p = from_axes(tri, a_g)
        unit = distance_unit(scene, tri)
        total = accumulate_network(scene.values, target, network_of(scene, tri).first, q, unit * a_phi, unit * p)
        pulled = -(a_phi * at.gradient + at.hessian * a_g)
        n = at.gradient
        total += accumulate_pose(
            target, tri, q[0] * pulled - p[0] * n, q[1] * pulled - p[1] * n, q[2] * pulled - p[2] * n, pulled
        )
        return total

    return pull_network_distance


NETWORK = Field(similar_scale, known_in_box, network_distance, make_network_distance_pull, convex=False)
