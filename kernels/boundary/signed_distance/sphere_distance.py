"""The distance from a sphere: phi = |x - b| - r, known one diameter off the surface.

Derivation: ``docs/theory/signed_distances.md#the-motion-of-rays``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.signed_distance.distance import Distance, Field, KnownRange, similar_scale
from warp_psdr.kernels.primitive.affine import from_axes, make_pose_sink
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def sphere_size(tri: Triangle) -> wp.float32:
    """The diameter."""
    return 2.0 * similar_scale(tri)


@wp.func
def sphere_known(scene: Scene, tri: Triangle, o: wp.vec3, w: wp.vec3) -> KnownRange:
    """From the start on, up to where a ray leaves what is known."""
    r = KnownRange()
    reach = 3.0 * similar_scale(tri)
    middle = wp.dot(tri.normal - o, w)
    beside = tri.normal - o - middle * w
    squared = reach * reach - wp.dot(beside, beside)
    if squared > 0.0:
        r.last = middle + wp.sqrt(squared)
    return r


@wp.func
def sphere_distance(scene: Scene, tri: Triangle, o: wp.vec3, w: wp.vec3, t: wp.float64) -> Distance:
    p = Distance()
    r = wp.vec3d(o) - wp.vec3d(tri.normal) + t * wp.vec3d(w)
    length = wp.length(r)
    scale = similar_scale(tri)
    p.phi = wp.float32(length - wp.float64(scale))
    d = wp.max(wp.float32(length), 1.0e-6 * scale)
    n = wp.vec3(r) / d
    p.gradient = n
    sign = wp.where(p.phi < 0.0, -1.0, 1.0)
    p.step = sign * p.phi
    p.step_gradient = sign * n
    p.hessian = (wp.identity(n=3, dtype=wp.float32) - wp.outer(n, n)) / d
    p.inside = wp.max(1.0 - wp.abs(p.phi) / sphere_size(tri), 0.0)
    p.inside_gradient = (-sign / sphere_size(tri)) * n
    return p


@functools.cache
def make_sphere_distance_pull(role: str):
    """Return ``pull``: phi_pi = -n . (A' q + b'), q = A^-1 (x - b)."""
    accumulate_pose = make_pose_sink(role)

    @wp.func
    def pull_sphere_distance(
        scene: Scene, target: wp.array(dtype=wp.float32), tri: Triangle, x: wp.vec3, a_phi: wp.float32, a_g: wp.vec3
    ) -> wp.float32:
        at = sphere_distance(scene, tri, x, x, wp.float64(0.0))
        q = from_axes(tri, x - tri.normal)
        p = from_axes(tri, a_g)
        k = -(a_phi * at.gradient + at.hessian * a_g)
        n = at.gradient
        return accumulate_pose(target, tri, q[0] * k - p[0] * n, q[1] * k - p[1] * n, q[2] * k - p[2] * n, k)

    return pull_sphere_distance


SPHERE = Field(sphere_size, sphere_known, sphere_distance, make_sphere_distance_pull, convex=True)
