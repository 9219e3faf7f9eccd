"""Secondary boundary in homogeneous media, of paths of two vertices [ZYZ21], in the local form.

As ``secondary.py``. x_1 is drawn along the ray from the edge point: a surface, or a volume vertex by free flight, which
keeps its fraction of the camera's ray; so W_1 has sigma_s f_p in place of f_s, no cosine, and the measure dt_1 more.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.coincident import pass_together
from warp_psdr.kernels.boundary.detector import MIN_COSINE
from warp_psdr.kernels.boundary.guiding.techniques import Guide, make_techniques
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, edge_behind, edge_step, facing_side
from warp_psdr.kernels.boundary.path_space.direction import Direction, wedge_at
from warp_psdr.kernels.boundary.path_space.secondary import SLOT_DIRECTION, SLOT_EDGE, make_segment_sink, moves
from warp_psdr.kernels.boundary.transport import SLOT_LENS, SLOT_WALK, Segment, make_first_sink
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.emitter.area import make_area
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.coefficients import coefficients_of, exp_minus
from warp_psdr.kernels.medium.flight import make_flight
from warp_psdr.kernels.medium.interface import make_crossing_sink, make_interface
from warp_psdr.kernels.medium.line import ClearLine, make_line
from warp_psdr.kernels.medium.passage import MOST_INTERFACES, is_lost, medium_towards
from warp_psdr.kernels.phase.dispatch import make_phase
from warp_psdr.kernels.primitive.dispatch import make_position
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_sink, make_lens
from warp_psdr.kernels.sensor.projection import FilmPoint, make_projection, make_splat
from warp_psdr.kernels.step import leaving_step, step_beside
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import RayAdjoint
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@wp.struct
class FirstVertex:
    """x_1, a surface point or a volume vertex, and what it was drawn with."""

    valid: wp.int32
    collides: wp.bool
    x: wp.vec3
    medium: wp.int32  # that the segment arrives through
    weight: wp.vec3  # T up to x_1 over the density; of a volume vertex sigma_s, too
    face: wp.int32  # of a surface
    u: wp.float32
    v: wp.float32


@wp.struct
class Sight:
    """x_1 as the camera sees it."""

    weight: wp.vec3  # 0: not seen
    at: FilmPoint
    d: wp.vec3  # from the camera
    t: wp.float32  # distance
    line: ClearLine  # up to x_1, from the near plane on
    far_face: wp.int32  # of a volume vertex: what ends the stretch that it is on; -1: nothing
    far_u: wp.float32
    far_v: wp.float32


@functools.cache
def make_first_vertex(config: PathConfig):
    """Return ``(first_vertex, sight)``.

    ``first_vertex(scene, sampler, o, d, medium) -> FirstVertex``: drawn along a ray from an edge.
    ``sight(scene, camera, first, w, lens) -> Sight``: its weight if it is lit from w.
    """
    assert config.media is not None
    visibility = visibility_of(config)
    interaction = make_interaction(config)
    is_interface, _behind = make_interface(config)
    line, _medium_at = make_line(config)
    flight = make_flight(config.media, True)
    phase = make_phase(config.media.phases)
    sample_4d = make_sampler(config.sampler).sample_4d
    project = make_projection(config.camera)[0]
    position, _cross_of = make_position(config.primitives)

    @wp.func
    def first_vertex(scene: Scene, sampler: Sampler, o: wp.vec3, d: wp.vec3, medium: wp.int32) -> FirstVertex:
        r = FirstVertex()
        r.medium = medium
        r.weight = wp.vec3(1.0, 1.0, 1.0)
        start = o
        crossings = wp.int32(0)
        while crossings <= MOST_INTERFACES:
            hit = visibility.closest(scene, start, d, FAR)
            length = wp.where(hit.face >= 0, hit.t, FAR)
            if r.medium >= 0:
                m = scene.media.records[r.medium]
                u4 = sample_4d(sampler, SLOT_WALK + crossings)
                f = flight(scene, m, length, length, hit.face < 0, u4, crossings, True)
                if f.collides:
                    c = coefficients_of(scene, m)
                    scattered = wp.cw_mul(wp.cw_mul(c.albedo, c.sigma_t), exp_minus(c.sigma_t, f.t))
                    r.weight = f.inv_p * wp.cw_mul(r.weight, scattered)
                    r.x = start + f.t * d
                    r.collides = True
                    r.valid = 1
                    return r
                r.weight = wp.cw_mul(r.weight, f.weight)
            if hit.face < 0:
                return r
            crossings += 1
            if is_interface(scene, hit.face):
                at = interaction.at(scene, hit.face, hit.u, hit.v, d)
                if is_lost(scene, at.shape, at.ng, d, r.medium):
                    return r
                r.medium = medium_towards(scene, at.shape, at.ng, d, d, r.medium)
                start = interaction.offset(at, d)
            else:
                r.face = hit.face
                r.u = hit.u
                r.v = hit.v
                r.x = position(scene.triangles[hit.face], hit.u, hit.v)
                r.valid = 1
                return r
        return r

    @wp.func
    def sight(scene: Scene, camera: Camera, first: FirstVertex, w: wp.vec3, lens: wp.vec2) -> Sight:
        r = Sight()
        r.at = project(scene, camera, first.x, lens)
        r.far_face = -1
        if r.at.valid == 0:
            return r
        r.t = wp.length(first.x - r.at.origin)
        r.d = (first.x - r.at.origin) / r.t
        end = first.x
        value = wp.vec3(0.0, 0.0, 0.0)
        if first.collides:
            m = scene.media.records[first.medium]
            value = wp.vec3(1.0, 1.0, 1.0) * phase.eval(scene, m, r.d, w)
        else:
            if wp.static(interaction.eval is not None):
                here = interaction.at(scene, first.face, first.u, first.v, r.d)
                cosine = wp.abs(wp.dot(here.ng, w))
                if cosine >= MIN_COSINE:
                    f = interaction.eval(here, enter_frame(here.frame, w))
                    value = (wp.abs(wp.dot(here.ng, r.d)) / cosine) * f
                end = step_beside(first.x, here.ng, -r.d, here.step)
        if vanishes(value):
            return r
        ray = end - r.at.origin
        length = wp.length(ray)
        ray = ray / length
        r.line = line(scene, r.at.origin + r.at.near * ray, ray, length - r.at.near, camera.medium, 0)
        if r.line.face >= 0 or r.line.lost or (first.collides and r.line.medium != first.medium):
            return r
        if first.collides:
            hit = visibility.closest(scene, first.x, r.d, FAR)
            r.far_face = hit.face
            r.far_u = hit.u
            r.far_v = hit.v
        r.weight = r.at.per_area * wp.cw_mul(r.line.transmittance, wp.cw_mul(value, first.weight))
        return r

    return first_vertex, sight


@functools.cache
def make_sight_sink(role: str):
    """Return ``accumulate_sight(scene, target, sight, g) -> RayAdjoint``: ``g`` is the adjoint of a volume vertex.

    It keeps its fraction of the stretch of the camera's ray, whose adjoint is returned.
    """
    accumulate_crossing = make_crossing_sink(role)

    @wp.func
    def accumulate_sight(scene: Scene, target: wp.array(dtype=wp.float32), s: Sight, g: wp.vec3) -> RayAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = RayAdjoint()
        r.o = g
        r.d = s.t * g
        near = s.at.near + s.line.near
        a_near = wp.dot(s.d, g)
        if s.far_face >= 0:
            tri = scene.triangles[s.far_face]
            x = (1.0 - s.far_u - s.far_v) * tri.p0 + s.far_u * tri.p1 + s.far_v * tri.p2
            far = wp.dot(x - s.at.origin, s.d)
            a_far = (s.t - near) / wp.max(far - near, s.t - near) * a_near
            a_near -= a_far
            a = accumulate_crossing(scene, target, s.far_face, s.far_u, s.far_v, s.d, far, a_far)
            r.o += a.o
            r.d += a.d
            r.dot += a.dot
        if s.line.near_face >= 0:
            a = accumulate_crossing(scene, target, s.line.near_face, s.line.near_u, s.line.near_v, s.d, near, a_near)
            r.o += a.o
            r.d += a.d
            r.dot += a.dot
        return r

    return accumulate_sight


@functools.cache
def make_media_segment(config: PathConfig):
    """Return ``segment(scene, camera, edges, moving, point, direction) -> (Segment, ClearLine)`` but for its x_1.

    The line is that from the edge towards the source, its medium that at the edge. ``t1`` of the result is how far
    beyond the edge the ray to x_1 starts, ``known`` is not 0 if what the segment joins moves.
    """
    line, medium_at = make_line(config)
    emitted = make_area(config.area).emitted if config.area else None
    lights = make_lights(config.lights, None, ()) if config.lights else None
    environment_eval = lights.environment_eval if lights else None

    @wp.func
    def segment(
        scene: Scene,
        camera: Camera,
        edges: Edges,
        moving: wp.array(dtype=wp.int32),
        point: EdgePoint,
        direction: Direction,
    ) -> tuple[Segment, ClearLine]:
        r = Segment()
        r.face2 = -1
        r.light = -1
        r.w = direction.w
        ahead = ClearLine()
        along = wp.normalize(point.p1 - point.p0)
        m = wp.cross(along, r.w)
        side = facing_side(scene, edges, point, along, r.w)
        sine = wp.length(m)
        if side == 0.0 or sine <= 0.0:
            return r, ahead
        r.boundary_normal = side * m
        r.step = edge_step(scene, edges, point.edge)
        r.x = point.x - (r.step / sine) * r.boundary_normal
        behind = edge_behind(scene, r.step)
        for i in range(edges.first[point.edge], edges.first[point.edge + 1]):
            r.known += moves(scene, moving, edges.faces[i])
        r.source = r.x - behind * r.w
        r.t1 = behind
        eye = wp.vec3(
            scene.values[camera.to_world + 3], scene.values[camera.to_world + 7], scene.values[camera.to_world + 11]
        )
        medium = medium_at(scene, eye, r.x, camera.medium)
        # Towards the source, as in ``secondary.py``.
        reach = wp.float32(FAR)
        if direction.light >= 0:
            reach = wp.min(direction.distance + behind, FAR)
        elif direction.aimed == 1 and direction.distance < 0.5 * FAR:
            plane = scene.triangles[direction.face].normal
            shift = wp.dot(plane, point.x - r.x) / wp.dot(plane, r.w)
            margin = (r.step + leaving_step(scene, direction.face)) / wp.abs(wp.dot(plane, r.w))
            reach = wp.max(direction.distance + shift - margin, 0.0) + behind
        ahead = line(scene, r.source, r.w, reach, medium, 1)
        if ahead.lost:
            return r, ahead
        if direction.light >= 0 or direction.aimed == 1:
            if ahead.face >= 0:
                return r, ahead
            r.light = direction.light
            r.face2 = direction.face
            r.u2 = direction.u
            r.v2 = direction.v
            r.t2 = direction.distance
            if direction.light >= 0:
                r.face2 = -1
                r.radiance = direction.irradiance
        else:
            r.face2 = ahead.face
            r.u2 = ahead.u
            r.v2 = ahead.v
            r.t2 = wp.max(ahead.t - behind, 0.0)
            if ahead.face >= 0 and ahead.t <= behind + r.step:
                r.t1 = -behind
        if r.light < 0:
            if r.face2 >= 0:
                r.known += moves(scene, moving, r.face2)
                if wp.static(bool(config.area)):
                    emitter = scene.shapes[scene.triangles[r.face2].shape].emitter
                    if emitter >= 0:
                        r.radiance = emitted(scene, scene.emitters[emitter], r.face2, r.u2, r.v2, r.w)
            else:
                if wp.static(environment_eval is not None):
                    r.radiance = environment_eval(scene, r.w)
        ahead.medium = medium  # that at the edge
        if not vanishes(r.radiance):
            r.valid = 1
        return r, ahead

    return segment


@functools.cache
def make_media_secondary_kernel(config: PathConfig, role: str, camera_moves: bool, light_pose: bool):
    """Return the kernel: one thread a sample (arguments as in ``secondary.py``, "reverse" or "forward")."""
    segment_at = make_media_segment(config)
    first_vertex, sight_of = make_first_vertex(config)
    accumulate_segment = make_segment_sink(role, light_pose)
    accumulate_first = make_first_sink(role)
    accumulate_sight = make_sight_sink(role)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    splat, gather = make_splat()
    lens_point = make_lens(config.camera)
    sample_aim, density, _place = make_techniques(config, False)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_2d = draw.sample_2d
    sample_4d = draw.sample_4d

    @wp.func
    def pull(
        scene: Scene,
        camera: Camera,
        target: wp.array(dtype=wp.float32),
        edges: Edges,
        point: EdgePoint,
        s: Segment,
        first: FirstVertex,
        seen: Sight,
        w: wp.float32,
    ) -> wp.float32:
        """Scatter the adjoints of the edge, of x_2, of x_1 and of the camera."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_segment(scene, target, edges, point, s, w)
        a = RayAdjoint()
        if first.collides:
            a = accumulate_sight(scene, target, seen, ((s.tau - 1.0) * w) * s.boundary_normal)
        else:
            a_o, a_d, dot = accumulate_first(scene, target, s, w, True, seen.at.origin, seen.d)
            a.o = a_o
            a.d = a_d
            a.dot = dot
        total += a.dot
        if wp.static(camera_moves):
            total += accumulate_camera(scene, target, camera, seen.at.sample, a.o, a.d)
        return total

    @wp.kernel(module="unique", enable_backward=False)
    def media_secondary(
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
        u4 = sample_4d(sampler, SLOT_DIRECTION)
        u = (wp.float64(number) + wp.float64(sample_1d(sampler, SLOT_EDGE))) / wp.float64(job.samples)
        aim = sample_aim(scene, edges, guide, u, u4)
        point = aim.point
        point.sample = number
        if aim.direction.valid == 0:
            return
        s, ahead = segment_at(scene, camera, edges, moving, point, aim.direction)
        if s.valid == 0:
            return
        pdf = density(scene, edges, guide, wedge_at(scene, edges, point), aim, s.face2, s.u2, s.v2, s.t2)
        first = first_vertex(scene, sampler, s.x + s.t1 * s.w, -s.w, ahead.medium)
        if first.valid == 0:
            return
        s.t1 = wp.dot(s.x - first.x, s.w)
        if s.t1 <= s.step:
            return
        seen = sight_of(scene, camera, first, s.w, lens_point(sample_2d(sampler, SLOT_LENS)))
        value = wp.cw_mul(seen.weight, wp.cw_mul(ahead.transmittance, s.radiance))
        if vanishes(value):
            return
        if s.light >= 0 and pass_together(seen.at.origin - first.x, s.w, s.t1, s.step):
            return
        face = first.face
        if first.collides:
            face = seen.far_face
            if seen.line.near_face >= 0:
                s.known += moves(scene, moving, seen.line.near_face)
        if face >= 0:
            s.known += moves(scene, moving, face)
        if s.known == 0:
            return
        if not first.collides:
            s.face1 = first.face
            s.u1 = first.u
            s.v1 = first.v
        distance = s.t2
        if s.face2 >= 0 or (s.light >= 0 and distance < 0.5 * FAR):
            s.tau = s.t1 / (s.t1 + distance)
        value *= wp.length(point.p1 - point.p0) / (point.pdf * pdf * wp.float32(job.samples))
        if wp.static(role == "forward"):
            speed = pull(scene, camera, target, edges, point, s, first, seen, 1.0)
            splat(scene, sampler, camera, seen.at.pixel, speed * value, image_out)
        else:
            w = wp.dot(gather(camera, seen.at.pixel, job.image_adjoint), value)
            if w != 0.0:
                if pull(scene, camera, target, edges, point, s, first, seen, w) != 0.0:
                    count_invalid(scene, sampler)

    return media_secondary
