"""Secondary boundary: discontinuities of the visibility between two path vertices [ZMY*20], in the local form.

A sample is an edge point x_b and a direction omega through it. The ray along omega ends in x_2, where the path tracer
gives L_2; the ray along -omega ends in x_1, from which importance is carried to the camera (``detector.py``). Samples
are stratified over the edges, or drawn from the cells of guiding.

Derivation: ``docs/theory/boundary.md#secondary-boundary``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.coincident import distance_to_plane, edge_share, make_screened
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.forwards import make_sees
from warp_psdr.kernels.boundary.guiding.techniques import Guide, make_techniques, octant_point
from warp_psdr.kernels.boundary.local_form import (
    EdgePoint,
    Edges,
    edge_behind,
    make_edge_sink,
)
from warp_psdr.kernels.boundary.path_space.direction import Direction, wedge_at
from warp_psdr.kernels.boundary.path_space.edge_segment import edge_segment, moves
from warp_psdr.kernels.boundary.path_space.sheet_shadows import make_sheet_segment, make_sheet_source
from warp_psdr.kernels.boundary.path_space.timed_secondary import make_timed_secondary_kernel
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.constants import EMITTER_DIRECTIONAL, EMITTER_POINT, FAR
from warp_psdr.kernels.emitter.area import make_area
from warp_psdr.kernels.emitter.directional import directional_dot
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_EDGE, make_note
from warp_psdr.kernels.primitive.affine import is_primitive_at
from warp_psdr.kernels.primitive.dispatch import has_slides, make_adjoint_sink, slides_on
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sink import make_sink, make_sink_vec3
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sample slots of a segment; those of the walk follow (``transport.py``).
SLOT_EDGE, SLOT_DIRECTION = 0, 1


@functools.cache
def make_segment(config: PathConfig):
    """Return ``segment(scene, edges, moving, point, direction, direct) -> Segment``, its scale without densities.

    What is cheap is tested first: most edges are no silhouette for most directions, and a segment between resting
    things contributes nothing. ``direct``: only what x_2 itself emits counts.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    screened = make_screened(config.rays, config.surfaces.primitives)
    sees = make_sees(config.rays, config.surfaces.primitives)
    emitted = make_area(config.lights.area, config.lights.shining).emitted if config.lights.area else None
    lights = make_lights(config.lights.others, None, ()) if config.lights.others else None
    environment_eval = lights.environment_eval if lights else None
    has_environment = environment_eval is not None

    @wp.func
    def segment(
        scene: Scene,
        edges: Edges,
        moving: wp.array(dtype=wp.int32),
        point: EdgePoint,
        direction: Direction,
        direct: wp.bool,
    ) -> Segment:
        along = wp.normalize(point.p1 - point.p0)
        r, side, any_moves = edge_segment(scene, edges, moving, point, along, direction.w)
        if side == 0.0:
            return r
        step = r.step
        behind = edge_behind(scene, step)
        r.source = r.x - behind * r.w
        start1 = behind
        # Towards the source. A surface at the edge itself hides what was aimed at, otherwise it is a contact.
        if direction.light >= 0:
            if visibility.occluded(scene, r.source, r.w, wp.min(direction.distance + behind, FAR)):
                return r
            r.light = direction.light
            r.known = 1
            r.radiance = direction.irradiance
        elif direction.aimed == 1 and (
            wp.static(not config.lights.shining) or not is_primitive_at(scene, direction.face)
        ):
            reach = wp.float32(FAR)
            if direction.distance < 0.5 * FAR:
                # The ray runs a step beside the line to the light point and meets the light's plane earlier or later:
                # it stops a little in front of that plane, so that neither the light nor its roundings hide it.
                plane = scene.triangles[direction.face].normal
                shift = wp.dot(plane, point.x - r.x) / wp.dot(plane, r.w)
                margin = (step + leaving_step(scene, direction.face)) / wp.abs(wp.dot(plane, r.w))
                reach = wp.max(direction.distance + shift - margin, 0.0) + behind
            if visibility.occluded(scene, r.source, r.w, reach):
                return r
            r.face2 = direction.face
            r.u2 = direction.u
            r.v2 = direction.v
            r.t2 = direction.distance
        else:
            hit2 = visibility.closest(scene, r.source, r.w, FAR)
            if wp.static(bool(config.lights.shining)):
                # Of a round light the ray meets another point than the line, but no other that faces it.
                if direction.aimed == 1 and hit2.face != direction.face:
                    return r
            r.face2 = hit2.face
            r.u2 = hit2.u
            r.v2 = hit2.v
            r.t2 = wp.max(hit2.t - behind, 0.0)
            if hit2.face >= 0 and hit2.t <= behind + step:
                start1 = -behind
        if r.light < 0:
            if r.face2 >= 0:
                any_moves += moves(scene, moving, r.face2)
                if wp.static(bool(config.lights.area)):
                    emitter = scene.shapes[scene.triangles[r.face2].shape].emitter
                    if emitter >= 0:
                        r.radiance = emitted(scene, scene.emitters[emitter], r.face2, r.u2, r.v2, r.w)
            else:
                if wp.static(has_environment):
                    r.radiance = environment_eval(scene, r.w)
            if (direct or r.face2 < 0) and vanishes(r.radiance):
                return r
        # Towards the sensor: from beyond the edge, but not from beyond a contact, which counts as x_2 only.
        hit1 = visibility.closest(scene, r.x + start1 * r.w, -r.w, FAR)
        if hit1.face < 0:
            return r
        if any_moves + moves(scene, moving, hit1.face) == 0:
            return r
        r.t1 = hit1.t - start1
        if r.t1 <= step or not sees(scene, r.x, r.w, r.t1):
            return r
        r.face1 = hit1.face
        r.u1 = hit1.u
        r.v1 = hit1.v
        if r.light >= 0:
            inside = point.x + (step / wp.length(r.boundary_normal)) * r.boundary_normal
            way = r.t1 - behind - step
            if wp.static(not config.surfaces.primitives) or not is_primitive_at(scene, r.face1):
                way = distance_to_plane(scene, r.face1, inside, r.w, behind)
            if screened(scene, scene.accel, edges, point, inside, r.w, way, r.face1, behind):
                return r
            if direction.distance < 0.5 * FAR:
                r.tau = r.t1 / (r.t1 + direction.distance)
        elif r.face2 >= 0:
            r.tau = r.t1 / (r.t1 + r.t2)
        r.scale = edge_share(scene, edges, point, along, r.w, side)
        r.valid = 1
        return r

    return segment


@functools.cache
def make_source_sink(role: str, light_pose: bool, primitives: tuple[int, ...] = ()):
    """Return ``accumulate_source(scene, target, segment, w, before) -> float`` for x_2 or its light.

    On grids and curves x_2 slides along the segment, and across it moves as what that is tied to at x_1 (form S).
    """
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, primitives)
    has_sliding = has_slides(primitives)
    sink = make_sink(role)
    sink3 = make_sink_vec3(role)

    @wp.func
    def accumulate_source(
        scene: Scene, target: wp.array(dtype=wp.float32), segment: Segment, w: wp.float32, before: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        g = w * segment.boundary_normal
        total = wp.float32(before)
        if segment.face2 >= 0:
            adjoint = VertexAdjoint()
            adjoint.x = -segment.tau * g
            face = segment.face2
            u = segment.u2
            v = segment.v2
            if wp.static(has_sliding):
                if slides_on(scene.triangles[face]):
                    face = segment.face1
                    u = segment.u1
                    v = segment.v1
            accumulated = accumulate_vertex(scene, target, face, u, v, adjoint, False, segment.x, segment.w)
            total += accumulated.dot
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

    return accumulate_source


@functools.cache
def make_segment_sink(role: str, light_pose: bool, primitives: tuple[int, ...] = ()):
    """Return ``accumulate_segment(scene, target, edges, point, segment, w) -> float`` for the edge and x_2."""
    accumulate_edge = make_edge_sink(role)
    accumulate_source = make_source_sink(role, light_pose, primitives)

    @wp.func
    def accumulate_segment(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        edges: Edges,
        point: EdgePoint,
        segment: Segment,
        w: wp.float32,
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_edge(scene, target, edges, point, w * segment.boundary_normal)
        return accumulate_source(scene, target, segment, w, total)

    return accumulate_segment


@functools.cache
def make_secondary_kernel(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    light_pose: bool,
    guided: bool = False,
    indirect: bool = False,
):
    """Return the kernel of the secondary boundary term: one thread a sample.

    Before a transient film it is that of ``timed_secondary.py``.

    Args:
        config: what the scene needs.
        role: "reverse" (``adjoint`` is read, ``target`` receives the gradient), "forward" (``target`` holds the
            tangents, ``image_out`` receives the derivative image), "samples" (as "reverse", but ``target`` receives
            what every sample is, see ``make_edge_sink``), or "target" (``target`` receives the integrand that guiding
            follows, at points of the cube that ``guide`` gives, see ``techniques.py``).
        camera_moves: a parameter of the camera is differentiated.
        light_pose: the position or direction of a point, spot or directional light is differentiated.
        guided: segments are drawn from the cells in ``guide``.
        indirect: paths of two vertices are left out (``depth.py``).
    """
    evaluates = role == "target"
    segment_at = make_segment(config)
    accumulate_segment = None if evaluates else make_segment_sink(role, light_pose, config.surfaces.primitives)
    if config.pulse:
        slots = SLOT_EDGE, SLOT_DIRECTION
        return make_timed_secondary_kernel(config, role, camera_moves, slots, segment_at, accumulate_segment)
    source = make_source(config, True)
    sheet_segment = make_sheet_segment(config) if config.points_pass else None
    source = make_sheet_source(config, source) if config.points_pass else source
    source = make_indirect(source) if indirect else source
    transport = make_transport(config, role, camera_moves, source)
    sample_aim, density, place = make_techniques(config.lights, guided)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def secondary(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        moving: wp.array(dtype=wp.int32),
        guide: Guide,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        direct = job.max_depth == 2
        u4 = sample_4d(sampler, SLOT_DIRECTION)
        if wp.static(evaluates):
            if guide.points.shape[0] > 0:
                aim = place(scene, edges, guide.points[number], guide.technique)
            else:
                box = number // job.samples
                u = octant_point(guide.low[box], guide.high[box], (number - box * job.samples) % 8, u4)
                aim = place(scene, edges, u, guide.technique)
        else:
            jitter = u4[0]
            if wp.static(not guided):
                jitter = sample_1d(sampler, SLOT_EDGE)
            u = (wp.float64(number) + wp.float64(jitter)) / wp.float64(job.samples)
            aim = sample_aim(scene, edges, guide, u, u4)
        point = aim.point
        point.sample = number
        direction = aim.direction
        if direction.valid == 0:
            return
        s = Segment()
        if wp.static(sheet_segment is None):
            s = segment_at(scene, edges, moving, point, direction, direct)
        else:
            if direction.light >= 0:
                s = sheet_segment(scene, edges, moving, point, direction, sampler)
            else:
                s = segment_at(scene, edges, moving, point, direction, direct)
        if s.valid == 0:
            return
        note_place(scene, NOTE_EDGE, point.edge, point.s, 0.0, point.x, direction.w, s.radiance)
        wedge = wedge_at(scene, edges, point)
        pdf = density(scene, edges, guide, wedge, aim, s.face2, s.u2, s.v2, s.t2)
        # pdf_l is a density of the fraction s; dl = |p1 - p0| ds.
        s.scale *= wp.length(point.p1 - point.p0) / (point.pdf * pdf)
        rest = wp.float32(0.0)
        scale = s.scale
        if wp.static(role == "forward"):
            rest = accumulate_segment(scene, target, edges, point, s, 1.0)
        if wp.static(evaluates):
            scale *= wp.length(s.boundary_normal)
        else:
            scale /= wp.float32(job.samples)
        weight = transport(scene, camera, sampler, s, scale, rest, job, target, image_out)
        if wp.static(evaluates):
            target[number] = weight
        elif wp.static(role != "forward"):
            if weight != 0.0:
                if accumulate_segment(scene, target, edges, point, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return secondary
