"""The motion of rays next to edges of meshes by rotations of whole kernels of directions [LHJ19] ([ZCZ25] 2.3.1).

An integral over directions is convolved with a von Mises-Fisher kernel k about mu. In each kernel all rays turn
together, V(w) = W(mu) x w, which preserves areas. A few auxiliary rays of the kernel choose the point that it turns
with: a point of the occluding surface, or of the edge between two surfaces. No W follows all edges in a kernel, and
rays miss some of them, so the derivative is biased by design. From k follows

    div V = kappa mu . (W x w).

``pairs`` of kernels that mirror each other about w have the same W where there is no edge, and cancel it there.

Derivation: ``docs/theory/reparameterisation.md#one-rotation-a-kernel``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.boundary.local_form import barycentrics_at
from warp_psdr.kernels.boundary.signed_distance.warp_field import WarpAdjoint
from warp_psdr.kernels.boundary.warped_area.auxiliary import AuxiliaryBundle
from warp_psdr.kernels.boundary.warped_area.warp_motion import WarpMotions
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import FAR, TWO_PI
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.rng import Sampler, Words, hashed, salted, unit_float
from warp_psdr.kernels.sink import make_sink_vec3
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import RayConfig
from warp_psdr.kernels.visibility import visibility_of

#: Height over a plane, over the distance from the rays' origin, up to which a point lies in it: float32 knows no more.
FLAT = 1.0e-5
#: Barycentric by which a point may miss a triangle whose edge it is on.
MISSES = 1.0e-3
#: In place of a triangle: no ray has met another surface than the first.
UNSEEN = -2
#: Tells the random numbers of these rays from those of paths.
ROTATION_SALT = wp.constant(wp.uint32(0x2C1B3C6D))


class RotationOptions(NamedTuple):
    """What of a method is compiled.

    Attributes:
        rays: auxiliary rays of a kernel.
        kappa: concentration of the kernels of rays from path vertices.
        film_sigma: standard deviation of those of the camera's rays [pixels].
        pairs: whether each ray has two kernels.
        fresh: whether the rays that choose are others than the one that turns.
    """

    rays: int = 4
    kappa: float = 1000.0
    film_sigma: float = 0.4
    pairs: bool = True
    fresh: bool = False


@wp.struct
class Rotation:
    """How a kernel turns: with a point of a triangle."""

    mu: wp.vec3  # the middle of the kernel
    control: wp.vec3  # another ray of it, whose divergence is subtracted; 0: there is none
    face: wp.int32  # -1: it rests
    x: wp.vec3  # the point


@wp.struct
class RotationMotion:
    """A ray, and what it turns with."""

    o: wp.vec3
    w: wp.vec3
    kappa: wp.float32
    first: Rotation
    second: Rotation  # of the kernel that mirrors the first


@wp.func
def about(axis: wp.vec3, kappa: wp.float32, h: Words) -> wp.vec3:
    """A direction with the density of a von Mises-Fisher kernel about a unit vector, kappa at least 10."""
    versine = -wp.log(1.0 - unit_float(h.x)) / kappa
    angle = TWO_PI * unit_float(h.y)
    s = any_tangent(axis)
    sine = wp.sqrt(versine * (2.0 - versine))
    return wp.normalize(
        sine * (wp.cos(angle) * s + wp.sin(angle) * wp.cross(axis, s)) + (1.0 - versine) * axis
    )  # fmt: skip


@wp.func
def is_on(tri: Triangle, x: wp.vec3) -> wp.bool:
    """Whether a point of a triangle's plane lies on the triangle."""
    b = barycentrics_at(tri, x)
    return b[0] > -MISSES and b[1] > -MISSES and b[0] + b[1] < 1.0 + MISSES


@wp.func
def is_beyond(n: wp.vec3, at: wp.vec3, y: wp.vec3, o: wp.vec3) -> wp.bool:
    """Whether a plane through ``at`` hides y from o."""
    return wp.dot(n, y - at) * wp.dot(n, o - at) < 0.0


@functools.cache
def make_rotation_motion(
    rays: RayConfig, primitives: tuple[int, ...], options: RotationOptions, role: str
) -> WarpMotions:
    """Return the functions of a scene of meshes, as ``make_warp_motion`` does."""
    seen = visibility_of(rays, primitives).seen
    sink3 = make_sink_vec3(role)
    pairs, fresh = options.pairs, options.fresh

    @wp.func
    def chosen(scene: Scene, first: Rotation, o: wp.vec3, face: wp.int32, z: wp.vec3) -> Rotation:
        """Turn with one of two points of different planes, or with that of the edge between them."""
        r = first
        y = first.x
        tri = scene.triangles[first.face]
        other = scene.triangles[face]
        hides = is_beyond(tri.normal, y, z, o)
        hidden = is_beyond(other.normal, z, y, o)
        nearer = wp.length(z - o) < wp.length(y - o)
        if (hidden and not hides) or (hides == hidden and nearer):
            r.face = face
            r.x = z
        if hides == hidden:
            # The point o + a (y - o) + b (z - o) of both planes [LHJ19], if both triangles reach it.
            p = wp.dot(tri.normal, y - o)
            q = wp.dot(other.normal, z - o)
            det = p * q - wp.dot(tri.normal, z - o) * wp.dot(other.normal, y - o)
            a = q * wp.dot(tri.normal, y - z) / det
            b = p * wp.dot(other.normal, z - y) / det
            x = o + a * (y - o) + b * (z - o)
            if is_on(tri, x) and is_on(other, x):
                r.face = face
                r.x = x
        return r

    @wp.func
    def choose(
        scene: Scene,
        bundle: AuxiliaryBundle,
        own: Sampler,
        kappa: wp.float32,
        mu: wp.vec3,
        place: wp.int32,
        mirrored: wp.bool,
    ) -> Rotation:
        """Look around mu, the ray itself being the one in a place, or everything mirrored about the ray."""
        w = bundle.w
        r = Rotation()
        r.mu = wp.where(mirrored, 2.0 * wp.dot(mu, w) * w - mu, mu)
        r.face = -1
        shape = wp.int32(-1)
        other = wp.int32(UNSEEN)
        other_x = wp.vec3(0.0, 0.0, 0.0)
        differs = wp.bool(False)
        i = wp.int32(0)
        while i < wp.static(options.rays) and not differs:
            d = about(mu, kappa, hashed(own, 1 + i))
            if wp.static(not fresh):
                if i == place:
                    d = w
            if mirrored:
                d = 2.0 * wp.dot(d, w) * w - d
            hit = RayHit()
            hit.face = -1
            if wp.dot(bundle.n, bundle.n) == 0.0 or wp.dot(bundle.n, d) * wp.dot(bundle.n, w) > 0.0:
                hit = seen(scene, bundle.start, d, FAR, bundle.depth)
            x = wp.vec3(0.0, 0.0, 0.0)
            met = wp.int32(-1)
            crease = wp.bool(False)
            if hit.face >= 0:
                tri = scene.triangles[hit.face]
                x = point_on(tri, hit.u, hit.v)
                met = tri.shape
                if met == shape and other == UNSEEN:
                    near = FLAT * wp.length(x - bundle.o)
                    crease = wp.abs(wp.dot(tri.normal, x - r.x)) > near
                    crease = crease or wp.abs(wp.dot(scene.triangles[r.face].normal, x - r.x)) > near
            if i == 0:
                shape = met
                r.face = hit.face
                r.x = x
            elif met != shape or crease:
                differs = met != shape
                other = hit.face
                other_x = x
            i += 1
        if other >= 0:
            if r.face >= 0:
                r = chosen(scene, r, bundle.o, other, other_x)
            else:  # what is met hides what is not
                r.face = other
                r.x = other_x
        if wp.static(pairs and not fresh):
            d = about(mu, kappa, hashed(own, 2 - place))
            r.control = wp.where(mirrored, 2.0 * wp.dot(d, w) * w - d, d)
        return r

    @wp.func
    def trace(scene: Scene, sampler: Sampler, number: wp.int32, bundle: AuxiliaryBundle) -> RotationMotion:
        own = salted(sampler, ROTATION_SALT, number)
        h = hashed(own, 0)
        kappa = wp.float32(wp.static(options.kappa))
        if bundle.pixels > 0.0:
            kappa = bundle.pixels * bundle.pixels * wp.static(options.film_sigma**-2.0)
        mu = about(bundle.w, kappa, h)
        place = wp.int32(h.z & wp.uint32(1))
        m = RotationMotion()
        m.o = bundle.o
        m.w = bundle.w
        m.kappa = kappa
        k = wp.int32(0)
        while k < wp.static(1 + int(pairs)):  # one copy of what is called, which takes minutes to compile for CUDA
            found = choose(scene, bundle, own, kappa, mu, place, k == 1)
            if k == 0:
                m.first = found
            else:
                m.second = found
            k += 1
        return m

    @wp.func
    def pull(
        scene: Scene, target: wp.array(dtype=wp.float32), m: RotationMotion, value: wp.float32, a_w: wp.vec3
    ) -> WarpAdjoint:
        r = WarpAdjoint()
        k = wp.int32(0)
        while k < wp.static(1 + int(pairs)):
            turn = m.first
            if k == 1:
                turn = m.second
            if turn.face >= 0:
                # W = d x v, d towards the point and v its motion, (x' - o') / t across d.
                a_turn = value * m.kappa * wp.cross(m.w - turn.control, turn.mu) + wp.cross(m.w, a_w)
                t = wp.length(turn.x - m.o)
                a_x = wp.static(0.5 if pairs else 1.0) / (t * t) * wp.cross(a_turn, turn.x - m.o)
                tri = scene.triangles[turn.face]
                b = barycentrics_at(tri, turn.x)
                r.dot += sink3(target, scene.positions + 3 * tri.i0, (1.0 - b[0] - b[1]) * a_x)
                r.dot += sink3(target, scene.positions + 3 * tri.i1, b[0] * a_x)
                r.dot += sink3(target, scene.positions + 3 * tri.i2, b[1] * a_x)
                r.o -= a_x
            k += 1
        return r

    return WarpMotions(trace, pull)
