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
from warp_psdr.kernels.boundary.direction import SAME_POINT, make_direction, pdf_wedge, wedge_at
from warp_psdr.kernels.boundary.local_form import (
    START_BEHIND,
    EdgePoint,
    Edges,
    edge_point,
    interior_side,
    make_edge_sink,
)
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.bvh.wide import RayHit, make_intersect
from warp_psdr.kernels.constants import EMITTER_DIRECTIONAL, EMITTER_POINT, FAR
from warp_psdr.kernels.emitter.directional import directional_dot
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.path import PathConfig
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.sink import make_sink, make_sink_vec3
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, make_vertex_sink

#: Sample slots of a segment; those of the walk follow (``transport.py``).
SLOT_EDGE, SLOT_DIRECTION, SLOT_LIGHT = 0, 1, 2


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
            r.known = 1
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
    """Return ``push_segment(scene, target, edges, point, segment, w) -> float`` for the edge and x_2, weighted by w."""
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

    return push_segment


@functools.cache
def make_secondary_kernel(config: PathConfig, role: str, camera_moves: bool, light_pose: bool):
    """Return the kernel of the secondary boundary term: one thread a sample.

    Args:
        config: what the scene needs.
        role: "reverse" (``adjoint`` is read, ``target`` receives the gradient) or "forward" (``target`` holds the
            tangents, ``image_out`` receives the derivative image), or "samples" (as "reverse", but ``target`` receives
            what every sample is, see ``make_edge_sink``).
        camera_moves: a parameter of the camera is differentiated.
        light_pose: the position or direction of a point, spot or directional light is differentiated.
    """
    segment_at = make_segment(config)
    push_segment = make_segment_sink(role, light_pose)
    transport = make_transport(config, role, camera_moves, make_source(config))
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
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
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = push_segment(scene, target, edges, point, s, 1.0)
        scale = s.scale / wp.float32(samples)
        weight = transport(scene, camera, sampler, s, scale, rest, max_depth, rr_depth, adjoint, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                push_segment(scene, target, edges, point, s, weight)

    return secondary
