"""The points that volume vertices between an edge and the camera ride on, and the sinks of their adjoints.

A volume vertex keeps its fraction s of the ray from the next vertex towards the camera, or of the camera's ray. An
adjoint g of the vertex therefore adds s g to the surface behind it, as seen from there, and (1 - s) g to that next
vertex.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.path_space.media_walk import MediaWalk, Sight
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.medium.grid_span import SpanAdjoint, make_grid_span, span_length, span_of
from warp_psdr.kernels.medium.interface import make_interface, make_interface_sink
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink, make_position
from warp_psdr.kernels.reading import texture_record
from warp_psdr.kernels.sensor.camera import make_camera_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import RayAdjoint, VertexAdjoint, normalize_vjp
from warp_psdr.kernels.vertex import MediaConfig, PathConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_along(media: MediaConfig, role: str, grids_move: bool):
    """Return ``along(scene, target, medium, x, d, t, near, far, g) -> SpanAdjoint``.

    It takes the adjoint g of a volume vertex x in a medium, at the distance t of a ray along d. x keeps its fraction of
    the stretch from ``near`` to ``far``, or, in a grid, of its span in the grid's box.
    """
    assert media is not None
    grids = media.grids
    _point, _depth, accumulate_ends = make_grid_span(role, grids_move) if grids else (None, None, None)

    @wp.func
    def along(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        medium: wp.int32,
        x: wp.vec3,
        d: wp.vec3,
        t: wp.float32,
        near: wp.float32,
        far: wp.float32,
        g: wp.vec3,
    ) -> SpanAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = SpanAdjoint()
        r.o = g
        r.d = t * g
        r.near = wp.dot(d, g)
        if wp.static(grids):
            m = scene.media.records[medium]
            if m.sigma_t_channels == GRID:
                grid = texture_record(scene, m.sigma_t)
                o = x - t * d
                span = span_of(scene, grid, o, d, near, far)
                r.far = wp.clamp((t - span.near) / span_length(span), 0.0, 1.0) * r.near
                r.near -= r.far
                return accumulate_ends(scene, target, grid, span, o, d, r)
        if far < FAR:
            r.far = (t - near) / wp.max(far - near, t - near) * r.near
            r.near -= r.far
        return r

    return along


@functools.cache
def make_ride(config: PathConfig, role: str, grids_move: bool):
    """Return ``(ride, ride_sight)``, which take the adjoint g of a volume vertex.

    ``ride(scene, target, walk, after, g) -> (vec3, float32)``: it keeps its fraction of the ray from the vertex
    ``after`` it, whose adjoint is returned.
    ``ride_sight(scene, target, walk, sight, g) -> RayAdjoint``: of the camera's ray, whose adjoint is returned.
    """
    accumulate_crossing = make_interface_sink(role, config.surfaces.primitives)
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, False, config.surfaces.primitives)
    is_interface, behind = make_interface(config)
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    position, _cross_of = make_position(config.surfaces.primitives)
    along = make_along(config.media, role, grids_move)

    @wp.func
    def ride(
        scene: Scene, target: wp.array(dtype=wp.float32), walk: MediaWalk, after: MediaWalk, g: wp.vec3
    ) -> tuple[wp.vec3, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        d = after.to
        y = after.x
        t = wp.dot(walk.x - y, d)
        hit = visibility.closest(scene, walk.x, d, FAR)
        z = behind(scene, hit, d, FAR, 1)
        near = wp.float32(0.0)
        if after.near_face >= 0:
            near = t - after.near
        far = wp.float32(FAR)
        if hit.face >= 0:
            far = t + hit.t
        rides = along(scene, target, walk.medium, walk.x, d, t, near, far, g)
        a_y = rides.o
        a_w = rides.d
        a_near = rides.near
        a_far = rides.far
        total = rides.dot
        if hit.face >= 0:
            if is_interface(scene, hit.face):
                a = accumulate_crossing(scene, target, hit.face, hit.u, hit.v, d, far, a_far)
                a_y += a.o
                a_w += a.d
                total += a.dot
                a_far = 0.0
        if after.near_face >= 0:
            a = accumulate_crossing(scene, target, after.near_face, after.near_u, after.near_v, d, near, a_near)
            a_y += a.o
            a_w += a.d
            total += a.dot
        if z.face >= 0:
            length = wp.length(position(scene.triangles[z.face], z.u, z.v) - y)
            adjoint = VertexAdjoint()
            adjoint.x = a_far * d + normalize_vjp(d, length, a_w)
            a_y -= adjoint.x
            total += accumulate_vertex(scene, target, z.face, z.u, z.v, adjoint, False, d, d).dot
        return a_y, total

    @wp.func
    def ride_sight(
        scene: Scene, target: wp.array(dtype=wp.float32), walk: MediaWalk, s: Sight, g: wp.vec3
    ) -> RayAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = RayAdjoint()
        near = s.at.near + s.line.near
        hit = visibility.closest(scene, walk.x, s.d, FAR)
        far = wp.float32(FAR)
        if hit.face >= 0:
            far = s.t + hit.t
        rides = along(scene, target, walk.medium, walk.x, s.d, s.t, near, far, g)
        r.o = rides.o
        r.d = rides.d
        r.dot = rides.dot
        a_near = rides.near
        if hit.face >= 0:
            a = accumulate_crossing(scene, target, hit.face, hit.u, hit.v, s.d, far, rides.far)
            r.o += a.o
            r.d += a.d
            r.dot += a.dot
        if s.line.near_face >= 0:
            a = accumulate_crossing(scene, target, s.line.near_face, s.line.near_u, s.line.near_v, s.d, near, a_near)
            r.o += a.o
            r.d += a.d
            r.dot += a.dot
        return r

    return ride, ride_sight


@functools.cache
def make_media_ride(config: PathConfig, role: str, camera_moves: bool, grids_move: bool):
    """Return ``(by_camera, by_surface)``, which take the adjoint g of a vertex.

    ``by_camera(scene, camera, target, walk, seen, g) -> float32``: of one that the camera sees.
    ``by_surface(scene, target, walk, after, g) -> (vec3, float32)``: of one behind another, ``after``; with what is
    left for that one. The numbers are what the sinks return.
    """
    ride, ride_sight = make_ride(config, role, grids_move)
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, config.surfaces.primitives)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None

    @wp.func
    def by_camera(
        scene: Scene, camera: Camera, target: wp.array(dtype=wp.float32), walk: MediaWalk, seen: Sight, g: wp.vec3
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if walk.collides:
            a = ride_sight(scene, target, walk, seen, g)
        else:
            adjoint = VertexAdjoint()
            adjoint.x = g
            a = accumulate_vertex(scene, target, walk.face, walk.u, walk.v, adjoint, True, seen.at.origin, seen.d)
        total = a.dot
        if wp.static(camera_moves):
            total += accumulate_camera(scene, target, camera, seen.at.sample, a.o, a.d)
        return total

    @wp.func
    def by_surface(
        scene: Scene, target: wp.array(dtype=wp.float32), walk: MediaWalk, after: MediaWalk, g: wp.vec3
    ) -> tuple[wp.vec3, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if walk.collides:
            a_y, dot = ride(scene, target, walk, after, g)
            return a_y, dot
        adjoint = VertexAdjoint()
        adjoint.x = g
        done = accumulate_vertex(scene, target, walk.face, walk.u, walk.v, adjoint, False, walk.x, walk.to)
        return wp.vec3(0.0, 0.0, 0.0), done.dot

    return by_camera, by_surface
