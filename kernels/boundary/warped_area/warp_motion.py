"""The motion of rays next to edges of meshes, by auxiliary rays, and its divergence [BLD20].

V(w) = P sum_i q_i v_i / sum_i q_i, P = 1 - w w^T, is the weighted mean of the velocities v_i = P_i (z_i' - o') / t_i
that auxiliary rays see. Its divergence follows from the gradients of the weights q_i. The adjoint of L div V + a . V is
linear in the v_i, so each ray is looked up and pulled back alone. A quotient of sums over K rays is biased. ``debias``
adds at random the difference between a net of twice as many rays and the mean of its halves, over the probability.

Derivation: ``docs/theory/reparameterisation.md``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.boundary.signed_distance.warp_field import WarpAdjoint
from warp_psdr.kernels.boundary.warped_area.auxiliary import AuxiliaryBundle, WarpedOptions, make_auxiliary
from warp_psdr.kernels.rng import Sampler, hashed, salted, unit_float
from warp_psdr.kernels.sink import make_sink_vec3
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import RayConfig

#: Probability that a net is doubled at all, and that one is doubled once more: 2^-1.5, so that neither the mean number
#: of rays nor the variance grows with the levels.
DOUBLES, AGAIN = 0.3, 0.35355339
#: Most doublings: with 16 rays, 32768 of them.
MOST_DOUBLINGS = 11
#: Tells the random numbers of auxiliary rays from those of paths.
AUXILIARY_SALT = wp.constant(wp.uint32(0x51ED270B))


@wp.struct
class NetSums:
    """Sums of a net's weights and of their gradients by the ray's direction."""

    z: wp.float32
    z_w: wp.vec3


@wp.struct
class WarpMotion:
    """A ray, the nets about it, and their sums: what is needed to pull its motion back."""

    bundle: AuxiliaryBundle
    x: wp.uint32  # scrambles of the first net
    y: wp.uint32
    first: NetSums
    rays: wp.int32  # of each half of the doubled net; 0: there is none
    share: wp.float32  # 1 / probability of that level
    far_x: wp.uint32
    far_y: wp.uint32
    lower: NetSums
    upper: NetSums


class WarpMotions(NamedTuple):
    """Functions of rays next to edges.

    Attributes:
        trace: ``(scene, sampler, number, bundle) -> WarpMotion``; ``number`` tells the rays of a sample apart.
        pull: ``(scene, target, motion, value, a_w) -> WarpAdjoint``: scatters the adjoint of ``value . div V + a_w .
            V`` to the triangles' corners, and returns that of the ray's origin.
    """

    trace: wp.Function
    pull: wp.Function


@functools.cache
def make_warp_motion(rays: RayConfig, primitives: tuple[int, ...], options: WarpedOptions, role: str) -> WarpMotions:
    """Return the functions of a scene of meshes."""
    cast = make_auxiliary(rays, primitives, options)
    sink3 = make_sink_vec3(role)
    rays_per_net = options.rays

    @wp.func
    def sum_net(
        scene: Scene, bundle: AuxiliaryBundle, x: wp.uint32, y: wp.uint32, begin: wp.int32, end: wp.int32
    ) -> NetSums:
        r = NetSums()
        i = wp.int32(begin)
        while i < end:
            ray = cast(scene, bundle, i, x, y)
            r.z += ray.weight
            r.z_w += ray.slope
            i += 1
        return r

    @wp.func
    def trace(scene: Scene, sampler: Sampler, number: wp.int32, bundle: AuxiliaryBundle) -> WarpMotion:
        own = salted(sampler, AUXILIARY_SALT, number)
        h = hashed(own, 0)
        m = WarpMotion()
        m.bundle = bundle
        m.x = h.x
        m.y = h.y
        m.first = sum_net(scene, bundle, h.x, h.y, 0, wp.static(rays_per_net))
        if wp.static(options.debias):
            if unit_float(h.z) < DOUBLES:
                m.rays = wp.static(rays_per_net)
                rest = wp.float32(1.0)  # probability of this level or a higher one
                u = unit_float(h.w)
                level = wp.int32(1)
                while level < MOST_DOUBLINGS and u < rest * AGAIN:
                    rest *= AGAIN
                    m.rays *= 2
                    level += 1
                if level < MOST_DOUBLINGS:
                    rest *= 1.0 - AGAIN
                m.share = 1.0 / (DOUBLES * rest)
                g = hashed(own, 1)
                m.far_x = g.x
                m.far_y = g.y
                m.lower = sum_net(scene, bundle, g.x, g.y, 0, m.rays)
                m.upper = sum_net(scene, bundle, g.x, g.y, m.rays, 2 * m.rays)
        return m

    @wp.func
    def of_ray(sums: NetSums, weight: wp.float32, slope: wp.vec3, value: wp.float32, across: wp.vec3) -> wp.vec3:
        """Adjoint of v_i: of V = P sum q v / z, and of div V = (sum q_w . v - z_w . V) / z - 2 w . V."""
        q = weight / sums.z
        return q * across + (value / sums.z) * (slope - q * sums.z_w)

    @wp.func
    def pull_net(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        bundle: AuxiliaryBundle,
        x: wp.uint32,
        y: wp.uint32,
        begin: wp.int32,
        end: wp.int32,
        sums: NetSums,
        share: wp.float32,
        whole: NetSums,
        value: wp.float32,
        across: wp.vec3,
    ) -> WarpAdjoint:
        """The rays of a net: ``share`` times what they are in the whole, and half less in the net itself."""
        r = WarpAdjoint()
        i = wp.int32(begin)
        while i < end:
            ray = cast(scene, bundle, i, x, y)
            if ray.hit.face >= 0:
                a_v = of_ray(whole, ray.weight, ray.slope, value, across)
                if sums.z > 0.0:
                    a_v -= 0.5 * of_ray(sums, ray.weight, ray.slope, value, across)
                a_z = (share / ray.t) * (a_v - wp.dot(ray.d, a_v) * ray.d)
                tri = scene.triangles[ray.hit.face]
                r.dot += sink3(target, scene.positions + 3 * tri.i0, (1.0 - ray.hit.u - ray.hit.v) * a_z)
                r.dot += sink3(target, scene.positions + 3 * tri.i1, ray.hit.u * a_z)
                r.dot += sink3(target, scene.positions + 3 * tri.i2, ray.hit.v * a_z)
                r.o -= a_z
            i += 1
        return r

    @wp.func
    def pull(
        scene: Scene, target: wp.array(dtype=wp.float32), m: WarpMotion, value: wp.float32, a_w: wp.vec3
    ) -> WarpAdjoint:
        w = m.bundle.w
        across = a_w - (wp.dot(w, a_w) + 2.0 * value) * w
        none = NetSums()
        r = pull_net(
            scene, target, m.bundle, m.x, m.y, 0, wp.static(rays_per_net), none, 1.0, m.first, value, across
        )  # fmt: skip
        if wp.static(options.debias):
            if m.rays > 0:
                both = NetSums()
                both.z = m.lower.z + m.upper.z
                both.z_w = m.lower.z_w + m.upper.z_w
                half = wp.int32(0)
                while half < 2:
                    sums = m.lower
                    if half == 1:
                        sums = m.upper
                    found = pull_net(
                        scene, target, m.bundle, m.far_x, m.far_y, half * m.rays, (half + 1) * m.rays, sums, m.share,
                        both, value, across,
                    )  # fmt: skip
                    r.o += found.o
                    r.dot += found.dot
                    half += 1
        return r

    return WarpMotions(trace, pull)
