"""Auxiliary rays of warped-area sampling [BLD20]: directions about a ray, the points that they meet, and their weights.

A direction w_i has the weight 1 / (D + B)^2 over its density. D = exp(kappa (1 - w . w_i)) - 1 is the distance from the
ray, and B is kappa / 2 times the squared sine of the angle between w_i and the nearest edge of the triangle that it
meets. On the edge of a triangle this triangle alone counts. The density is even in the logarithm of 1 - w . w_i, so
that a ray next to an edge has neighbours at every scale.

Derivation: ``docs/theory/reparameterisation.md#weights``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import FAR, TWO_PI
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.rng import reverse_bits, scramble_reversed, sobol_reversed, unit_float
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import RayConfig
from warp_psdr.kernels.visibility import visibility_of

#: Least and largest of kappa (1 - cos) between which densities are even in its logarithm.
INNERMOST, OUTERMOST = 1.0e-5, 10.0
#: Of D + B, so that its third power is a float32.
LEAST_DISTANCE = 1.0e-9
#: Below this exp(r) - 1 is a polynomial of r: the difference would have lost its digits.
SMALL = 0.02


class WarpedOptions(NamedTuple):
    """What of a method is compiled.

    Attributes:
        rays: K, auxiliary rays of the first net.
        kappa: concentration of the weights.
        debias: whether nets are doubled at random, so that the mean is that of infinitely many rays.
    """

    rays: int = 16
    kappa: float = 1000.0
    debias: bool = True


@wp.struct
class AuxiliaryBundle:
    """A ray whose motion is asked for, and where its auxiliary rays start."""

    o: wp.vec3  # origin, which may move
    start: wp.vec3  # the same, a step off its surface
    n: wp.vec3  # normal of that surface: rays stay on the side of w; 0: there is none
    w: wp.vec3
    depth: wp.int32  # path vertices before it
    pixels: wp.float32  # a radian, of a ray of the camera; 0: of others


@wp.struct
class AuxiliaryRay:
    """One of them."""

    d: wp.vec3
    t: wp.float32  # from the bundle's origin to what it meets
    hit: RayHit  # its face is -1 where it meets nothing
    weight: wp.float32  # over the density, up to a constant
    slope: wp.vec3  # gradient of the weight by w, over the same


@wp.func
def net_point(index: wp.int32, seed_x: wp.uint32, seed_y: wp.uint32) -> wp.vec2:
    """Point number ``index`` of a scrambled Sobol net in [0, 1)^2."""
    j = wp.uint32(index)
    x = reverse_bits(scramble_reversed(j, seed_x))
    y = reverse_bits(scramble_reversed(sobol_reversed(j), seed_y))
    return wp.vec2(unit_float(x), unit_float(y))


@wp.func
def squared_sine(o: wp.vec3, d: wp.vec3, a: wp.vec3, b: wp.vec3) -> wp.float32:
    """Squared sine of the angle between a direction and the plane through o and the line from a to b."""
    m = wp.cross(a - o, b - o)
    q = wp.dot(m, d)
    return q * q / wp.max(wp.dot(m, m), 1.0e-30)


@wp.func
def nearest_edge(tri: Triangle, o: wp.vec3, d: wp.vec3) -> wp.float32:
    """The least of them over a triangle's edges."""
    found = wp.min(squared_sine(o, d, tri.p0, tri.p1), squared_sine(o, d, tri.p1, tri.p2))
    return wp.min(found, squared_sine(o, d, tri.p2, tri.p0))


@functools.cache
def make_auxiliary(rays: RayConfig, primitives: tuple[int, ...], options: WarpedOptions):
    """Return ``cast(scene, bundle, index, seed_x, seed_y) -> AuxiliaryRay``."""
    seen = visibility_of(rays, primitives).seen
    kappa = options.kappa

    @wp.func
    def cast_auxiliary(
        scene: Scene, bundle: AuxiliaryBundle, index: wp.int32, seed_x: wp.uint32, seed_y: wp.uint32
    ) -> AuxiliaryRay:
        u = net_point(index, seed_x, seed_y)
        r = INNERMOST * (wp.exp(u[0] * wp.log(1.0 + OUTERMOST / INNERMOST)) - 1.0)
        inverse_density = r + INNERMOST
        versine = r / wp.static(kappa)
        sine = wp.sqrt(versine * (2.0 - versine))
        s = any_tangent(bundle.w)
        across = sine * (wp.cos(TWO_PI * u[1]) * s + wp.sin(TWO_PI * u[1]) * wp.cross(bundle.w, s))
        ray = AuxiliaryRay()
        ray.d = wp.normalize(across + (1.0 - versine) * bundle.w)
        ray.hit.face = -1
        border = wp.float32(1.0)
        beside = wp.dot(bundle.n, ray.d) * wp.dot(bundle.n, bundle.w)
        if beside > 0.0 or wp.dot(bundle.n, bundle.n) == 0.0:
            ray.hit = seen(scene, bundle.start, ray.d, FAR, bundle.depth)
            if ray.hit.face >= 0:
                tri = scene.triangles[ray.hit.face]
                y = point_on(tri, ray.hit.u, ray.hit.v) - bundle.o
                ray.t = wp.length(y)
                ray.d = y / ray.t
                border = wp.static(0.5 * kappa) * nearest_edge(tri, bundle.o, ray.d)
        e = wp.exp(r)
        distance = e - 1.0
        if r < SMALL:
            distance = r * (1.0 + r * (0.5 + r * (1.0 / 6.0 + r / 24.0)))
        inverse = 1.0 / wp.max(distance + border, LEAST_DISTANCE)
        ray.weight = inverse_density * inverse * inverse
        ray.slope = (2.0 * wp.static(kappa) * e * inverse * ray.weight) * across
        return ray

    return cast_auxiliary
