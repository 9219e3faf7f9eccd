"""Secondary boundary: discontinuities of the visibility between two path vertices [ZMY*20], in the local form.

A sample is an edge point x_b and a direction omega through it. The ray along omega ends in x_2, where the path tracer
gives L_2; the ray along -omega ends in x_1, from which importance is carried to the camera (``detector.py``). Its
vertex k as counted from the camera is x_1 itself: k = 1 if the camera sees x_1 directly, then x_1 slides along its
pixel's ray and its velocity is that of the attached ray's hit; deeper ones are material points. x_2 is a material
point, the light itself, or at infinity, where tau = 0:

* environment: a fixed world direction;
* directional light: omega turns with the light, which moves the line at x_b by t_1 omega'.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import Walk, make_radiance, make_walk
from warp_psdr.kernels.boundary.direction import SAME_POINT, make_direction, pdf_wedge, wedge_at
from warp_psdr.kernels.boundary.local_form import (
    START_BEHIND,
    EdgePoint,
    Edges,
    edge_point,
    interior_side,
    make_edge_sink,
)
from warp_psdr.kernels.boundary.projection import make_splat
from warp_psdr.kernels.bvh.wide import RayHit, make_intersect
from warp_psdr.kernels.camera import make_camera_sink, make_lens
from warp_psdr.kernels.constants import EMITTER_DIRECTIONAL, EMITTER_POINT, FAR
from warp_psdr.kernels.emitter.directional import directional_dot
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.path import PathConfig
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.sink import make_sink, make_sink_vec3
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, make_vertex_sink

#: Sample slots of a segment (edge, direction, light), of the point of the lens that sees it, and of the walk, whose
#: vertices count from one.
SLOT_EDGE, SLOT_DIRECTION, SLOT_LIGHT, SLOT_LENS, SLOT_WALK = 0, 1, 2, 3, 3


@wp.struct
class Segment:
    """A boundary segment and its two ends."""

    valid: wp.int32
    x: wp.vec3  # x_b, moved off the occluder
    w: wp.vec3  # towards the source
    source: wp.vec3  # where the ray towards the source starts
    sweep: wp.vec3  # sin(phi) n
    t1: wp.float32
    tau: wp.float32
    scale: wp.float32  # 1 / (pdf_l pdf_sigma)
    face1: wp.int32
    u1: wp.float32
    v1: wp.float32
    face2: wp.int32  # -1: infinity or a point-like light
    u2: wp.float32
    v2: wp.float32
    light: wp.int32  # point-like light, else -1
    radiance: wp.vec3  # of the point-like light


@functools.cache
def make_segment(config: PathConfig):
    """Return ``segment(scene, edges, point, u4, v4, share) -> Segment``."""
    closest_hit, any_hit = make_intersect(config.ray_backend, config.ray_width)
    sample_direction, pdf_light = make_direction(config)

    @wp.func
    def segment(scene: Scene, edges: Edges, point: EdgePoint, u4: wp.vec4, v4: wp.vec4, share: wp.float32) -> Segment:
        r = Segment()
        r.face2 = -1
        r.light = -1
        wedge = wedge_at(scene, edges, point)
        direction = sample_direction(scene, wedge, point.x, share, u4, v4)
        if direction.valid == 0:
            return r
        r.w = direction.w
        m = wp.cross(wedge.t, r.w)
        side = interior_side(scene, edges, point, m)
        sine = wp.length(m)
        if side == 0.0 or sine <= 0.0:
            return r
        r.sweep = side * m
        r.x = point.x - (scene.ray_epsilon / sine) * r.sweep
        behind = START_BEHIND * scene.ray_epsilon
        r.source = r.x - behind * r.w
        # Towards the source, for all but point-like lights. A surface at the edge itself is a contact.
        hit2 = RayHit()
        start1 = behind
        if direction.light < 0:
            hit2 = closest_hit(scene.accel, r.source, r.w, FAR)
            if hit2.face >= 0 and hit2.t <= behind + scene.ray_epsilon:
                start1 = -behind
        # Towards the sensor: from beyond the edge, but not from beyond a contact, which counts as x_2 only.
        hit1 = closest_hit(scene.accel, r.x + start1 * r.w, -r.w, FAR)
        if hit1.face < 0:
            return r
        r.t1 = hit1.t - start1
        if r.t1 <= scene.ray_epsilon:
            return r
        r.face1 = hit1.face
        r.u1 = hit1.u
        r.v1 = hit1.v
        pdf = pdf_wedge(wedge)
        if direction.light >= 0:
            if any_hit(scene.accel, r.source, r.w, wp.min(direction.distance + behind, FAR)):
                return r
            r.light = direction.light
            r.radiance = direction.irradiance
            if direction.distance < 0.5 * FAR:
                r.tau = r.t1 / (r.t1 + direction.distance)
            pdf = 1.0 - share
        else:
            t2 = wp.max(hit2.t - behind, 0.0)
            if direction.aimed == 1:
                if direction.distance > 0.5 * FAR:
                    if hit2.face >= 0:
                        return r
                elif wp.abs(t2 - direction.distance) > SAME_POINT * direction.distance or hit2.face < 0:
                    return r
            pdf = share * pdf + (1.0 - share) * pdf_light(scene, hit2.face, r.w, t2)
            if hit2.face >= 0:
                r.tau = r.t1 / (r.t1 + t2)
                r.face2 = hit2.face
                r.u2 = hit2.u
                r.v2 = hit2.v
        # pdf_l is a density of the fraction s; dl = |p1 - p0| ds.
        r.scale = wp.length(point.p1 - point.p0) / (point.pdf * pdf)
        r.valid = 1
        return r

    return segment


@functools.cache
def make_segment_sink(role: str, light_pose: bool):
    """Return ``push_segment(scene, target, edges, point, segment, w) -> float`` for the edge and x_2, weighted by w.

    ``push_first(...)`` beside it is for x_1, on its pixel's ray or as a material point.
    """
    push_edge = make_edge_sink(role)
    push_vertex = make_vertex_sink(role, False, False, False, False, False, True)
    sink = make_sink(role)
    sink3 = make_sink_vec3(role)

    @wp.func
    def push_segment(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        edges: Edges,
        point: EdgePoint,
        segment: Segment,
        w: wp.float32,
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        g = w * segment.sweep
        total = push_edge(scene, target, edges, point, g)
        if segment.face2 >= 0:
            adjoint = VertexAdjoint()
            adjoint.x = -segment.tau * g
            pushed = push_vertex(
                scene, target, segment.face2, segment.u2, segment.v2, adjoint, False, segment.x, segment.w
            )
            total += pushed.dot
        if wp.static(light_pose):
            if segment.light >= 0:
                record = scene.emitters[segment.light]
                if record.kind == EMITTER_DIRECTIONAL:
                    axis = load_column(scene.values, record.to_world, 2)
                    d_axis, _a = wp.grad(directional_dot)(axis, -segment.t1 * g)
                    for i in range(3):
                        total += sink(target, record.to_world + 4 * i + 2, d_axis[i])
                elif record.kind == EMITTER_POINT:
                    total += sink3(target, record.to_world, -segment.tau * g)
                else:
                    for i in range(3):
                        total += sink(target, record.to_world + 4 * i + 3, -segment.tau * g[i])
        return total

    @wp.func
    def push_first(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        segment: Segment,
        w: wp.float32,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
    ) -> tuple[wp.vec3, wp.vec3, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        adjoint = VertexAdjoint()
        adjoint.x = ((segment.tau - 1.0) * w) * segment.sweep
        pushed = push_vertex(scene, target, segment.face1, segment.u1, segment.v1, adjoint, by_ray, o, d)
        return pushed.o, pushed.d, pushed.dot

    return push_segment, push_first


@functools.cache
def make_secondary_kernel(config: PathConfig, role: str, camera_moves: bool, light_pose: bool):
    """Return the kernel of the secondary boundary term: one thread a sample.

    Args:
        config: what the scene needs.
        role: "reverse" (``adjoint`` is read, ``target`` receives the gradient) or "forward" (``target`` holds the
            tangents, ``image_out`` receives the derivative image).
        camera_moves: a parameter of the camera is differentiated.
        light_pose: the position or direction of a point, spot or directional light is differentiated.
    """
    segment_at = make_segment(config)
    connect, extend = make_walk(config)
    radiance = make_radiance(config)
    push_segment, push_first = make_segment_sink(role, light_pose)
    push_camera = make_camera_sink(role, config.camera) if camera_moves else None
    splat, gather = make_splat()
    lens_point = make_lens(config.camera)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_2d = draw.sample_2d
    sample_4d = draw.sample_4d

    @wp.kernel(module="unique", enable_backward=False)
    def secondary(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        # In:
        first: wp.int32,
        samples: wp.int32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        share: wp.float32,
        adjoint: wp.array2d(dtype=wp.vec3),
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = first + wp.tid()
        sampler = Sampler()
        sampler.pixel = wp.uint32(number)
        sampler.seed = seed
        point = edge_point(scene, edges, number, samples, sample_1d(sampler, SLOT_EDGE))
        s = segment_at(scene, edges, point, sample_4d(sampler, SLOT_DIRECTION), sample_4d(sampler, SLOT_LIGHT), share)
        if s.valid == 0:
            return
        tri = scene.triangles[s.face1]
        walk = Walk()
        walk.alive = 1
        walk.face = s.face1
        walk.u = s.u1
        walk.v = s.v1
        walk.x = (1.0 - s.u1 - s.v1) * tri.p0 + s.u1 * tri.p1 + s.v1 * tri.p2
        walk.to = s.w
        walk.weight = wp.vec3(1.0, 1.0, 1.0)
        scale = s.scale / wp.float32(samples)
        lens = lens_point(sample_2d(sampler, SLOT_LENS))
        # Velocities for a unit weight (forward), or weights of the velocities (reverse).
        moved = wp.float32(0.0)
        known = wp.int32(0)
        weight = wp.float32(0.0)
        k = wp.int32(1)
        while walk.alive == 1:
            seen = connect(scene, camera, walk, lens)
            if wp.max(seen.weight) > 0.0:
                source = s.radiance
                if s.light < 0:
                    branch = Sampler()
                    branch.pixel = sampler.pixel
                    branch.index = wp.uint32(k)
                    branch.seed = seed
                    source = radiance(scene, branch, s.source, s.w, FAR, k, max_depth, rr_depth)
                value = scale * wp.cw_mul(seen.weight, source)
                if wp.max(value) > 0.0:
                    ray = (walk.x - seen.at.origin) / wp.length(walk.x - seen.at.origin)
                    if wp.static(role == "reverse"):
                        w = wp.dot(gather(camera, seen.at.pixel, adjoint), value)
                        if k == 1:
                            a_o, a_d, _d = push_first(scene, target, s, w, True, seen.at.origin, ray)
                            push_segment(scene, target, edges, point, s, w)
                            if wp.static(camera_moves):
                                push_camera(scene, target, camera, seen.at.sample, a_o, a_d)
                        else:
                            weight += w
                    else:
                        speed = wp.float32(0.0)
                        if k == 1:
                            a_o, a_d, speed_1 = push_first(scene, target, s, 1.0, True, seen.at.origin, ray)
                            speed = speed_1 + push_segment(scene, target, edges, point, s, 1.0)
                            if wp.static(camera_moves):
                                speed += push_camera(scene, target, camera, seen.at.sample, a_o, a_d)
                        else:
                            if known == 0:
                                _o, _d, speed_k = push_first(scene, target, s, 1.0, False, s.x, s.w)
                                moved = speed_k + push_segment(scene, target, edges, point, s, 1.0)
                                known = 1
                            speed = moved
                        splat(camera, seen.at.pixel, speed * value, image_out)
            # x_2 is vertex k + 1 of the path.
            if max_depth >= 0 and k + 2 > max_depth:
                walk.alive = 0
            else:
                u4 = sample_4d(sampler, SLOT_WALK + k)
                walk = extend(scene, walk, u4, FAR, k >= rr_depth)
            k += 1
        if wp.static(role == "reverse"):
            if weight != 0.0:
                push_first(scene, target, s, weight, False, s.x, s.w)
                push_segment(scene, target, edges, point, s, weight)

    return secondary
