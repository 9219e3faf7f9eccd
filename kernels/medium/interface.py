"""Interfaces of media (Mitsuba's ``null``) in motion: a ray's crossings, and the first real surface behind them.

A ray o + t d crosses an interface with the normal n at a point that rides on the interface with the velocity c', so
that t' = n . (c' - o' - t d') / (n . d).

Derivation: ``docs/theory/media.md#what-moves``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.medium.null_surface import make_null_surface
from warp_psdr.kernels.medium.passage import MOST_INTERFACES
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink, make_geometric_normal
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.surface import RayAdjoint, VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Least cosine at a crossing that is divided by: what is met exactly edge-on.
EDGE_ON = 1.0e-6


@functools.cache
def make_interface(config: PathConfig):
    """Return ``(is_interface, behind)``.

    ``is_interface`` is that of ``make_null_surface``.
    ``behind(scene, hit, d, t_max, depth) -> RayHit``: the first surface that is there, from what a ray along d has met
    on; ``depth``: path vertices in front of it.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    is_interface, past = make_null_surface(config.surfaces, config.lights)

    @wp.func
    def behind(scene: Scene, hit: RayHit, d: wp.vec3, t_max: wp.float32, depth: wp.int32) -> RayHit:
        r = hit
        count = wp.int32(0)
        while is_interface(scene, r.face) and count <= MOST_INTERFACES:
            r = visibility.seen(scene, past(scene, r.face, r.u, r.v, d).o, d, t_max, depth)
            count += 1
        return r

    return is_interface, behind


@functools.cache
def make_interface_sink(role: str, primitives: tuple[int, ...]):
    """Return ``accumulate_crossing(scene, target, face, u, v, d, t, w) -> RayAdjoint``.

    ``w`` is the adjoint of the distance t at which a ray along the unit vector d crosses a triangle, or an exact shape.
    """
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, False, primitives)
    normal_at = make_geometric_normal(primitives)

    @wp.func
    def accumulate_crossing(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        d: wp.vec3,
        t: wp.float32,
        w: wp.float32,
    ) -> RayAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = RayAdjoint()
        n = normal_at(scene, scene.triangles[face], u, v)
        cosine = wp.dot(n, d)
        if wp.abs(cosine) > EDGE_ON:
            adjoint = VertexAdjoint()
            adjoint.x = (w / cosine) * n
            r.dot = accumulate_vertex(scene, target, face, u, v, adjoint, False, d, d).dot
            r.o = -adjoint.x
            r.d = -t * adjoint.x
        return r

    return accumulate_crossing
