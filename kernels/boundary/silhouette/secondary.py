"""Secondary boundary at smooth silhouettes and rims: segments between two path vertices that touch a shape.

The local form (``local_form.py``) at a point x_b of a smooth surface, with a tangent direction at the angle theta, has
the measure kappa_n dA dtheta in place of sin(phi) dl dsigma, kappa_n the normal curvature along the segment. Two
techniques are joined by the balance heuristic: uniform in area and theta, and a point of a light with the silhouette
that it sees, for which kappa_n dA dtheta = |dx/du x w| du dsigma. Of point, spot and directional lights the direction
is given, and the silhouette alone is drawn. At rims the measure is |dx/du x w| du dsigma for any direction w, which is
uniform, or leads to a light.

Derivation: ``docs/theory/implicit.md#secondary-silhouettes``, ``#rims``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.path_space.direction import make_pdf_light
from warp_psdr.kernels.boundary.path_space.secondary import make_source_sink, moves
from warp_psdr.kernels.boundary.silhouette.dispatch import (
    choose_outline,
    make_coordinates,
    make_silhouette_sink,
    make_silhouettes,
)
from warp_psdr.kernels.boundary.silhouette.point import SilhouettePoint
from warp_psdr.kernels.boundary.silhouette.rim import make_rims
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.constants import EMITTER_DIRECTIONAL, EMITTER_POINT, FAR, INV_FOUR_PI, INV_TWO_PI, TWO_PI
from warp_psdr.kernels.emitter.area import make_area
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_delta_sample, make_lights
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.dispatch import make_position
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_sphere, square_to_triangle
from warp_psdr.kernels.scattering import make_light_draw
from warp_psdr.kernels.structs import Camera, Scene, Triangle
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sample slots of a segment; those of the walk follow (``transport.py``).
SLOT_SILHOUETTE, SLOT_DIRECTION = 0, 1
#: How far from the point of a light that a segment was aimed at it may meet the light: over the distance, and in steps.
NEAR_LIGHT, STEPS = 1.0e-3, 20.0


@wp.struct
class TangentAim:
    """Where a segment that touches a shape leads to."""

    valid: wp.int32
    w: wp.vec3
    light: wp.int32  # emitter that it was aimed at, -1: none
    eye: wp.vec3  # its point, or the direction towards it
    distant: wp.bool
    u: wp.float32  # fraction of the way around the silhouette


@functools.cache
def make_light_aim(config: PathConfig):
    """Return ``aim(scene, x, u4) -> TangentAim``: a point of a light, or its direction; x is where the shape is."""
    pick, draw = make_light_draw(config)
    area = bool(config.area)
    deltas = make_delta_sample(config.lights) is not None

    @wp.func
    def light_aim(scene: Scene, x: wp.vec3, u4: wp.vec4) -> TangentAim:
        r = TangentAim()
        index, face = pick(scene, wp.vec2(u4[0], u4[1]))
        r.light = index
        r.valid = 1
        if wp.static(area):
            if face >= 0:
                uv = square_to_triangle(wp.vec2(u4[2], u4[3]))
                r.eye = point_on(scene.triangles[face], uv[0], uv[1])
                return r
        emitter = scene.emitters[index]
        if wp.static(deltas):
            if is_delta_light(emitter.kind):
                if emitter.kind == EMITTER_DIRECTIONAL:
                    r.eye = -wp.normalize(load_column(scene.values, emitter.to_world, 2))
                    r.distant = True
                elif emitter.kind == EMITTER_POINT:
                    r.eye = load_vec3(scene.values, emitter.to_world)
                else:
                    r.eye = load_column(scene.values, emitter.to_world, 3)
                return r
        ls = draw(scene, index, -1, Triangle(), x, wp.vec2(u4[2], u4[3]))
        r.eye = ls.wi
        r.distant = True
        r.valid = wp.where(ls.pdf > 0.0, 1, 0)
        return r

    return light_aim


@functools.cache
def make_silhouette_segment(config: PathConfig):
    """Return ``segment(scene, moving, tri, point, rim, aim, share, direct) -> Segment``.

    ``aim.light`` is -1 where its direction is drawn uniformly, as of the fraction ``share`` of the segments; ``direct``
    as in ``path_space/secondary.py``. Its scale is one over the density of what was drawn, in the measure above.
    """
    visibility = visibility_of(config)
    silhouettes = make_silhouettes(config.primitives)
    rims = make_rims(config.primitives)
    pdf_light = make_pdf_light(config)
    position, _cross_of = make_position(config.primitives)
    emitted = make_area(config.area).emitted if config.area else None
    lights = make_lights(config.lights, None, ()) if config.lights else None
    environment_eval = lights.environment_eval if lights else None
    has_environment = environment_eval is not None
    delta_sample = make_delta_sample(config.lights)

    @wp.func
    def around(tri: Triangle, rim: wp.bool, eye: wp.vec3, distant: wp.bool, q: wp.vec3, w: wp.vec3) -> wp.float32:
        """|dx/du x w| of the silhouette from an eye, or of a rim."""
        rate = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(rims is not None):
            if rim:
                rate = rims.rate(tri, q)
        if wp.static(silhouettes is not None):
            if not rim:
                rate = silhouettes.rate(tri, eye, distant, q)
        return wp.length(wp.cross(rate, w))

    @wp.func
    def uniform_density(share: wp.float32, tri: Triangle, rim: wp.bool, q: wp.vec3, w: wp.vec3) -> wp.float32:
        """Density of what is uniform, in area and theta, or in u and the direction, times the share of it."""
        if wp.static(rims is not None):
            if rim:
                return share * INV_FOUR_PI / wp.length(wp.cross(rims.rate(tri, q), w))
        if wp.static(silhouettes is not None):
            return share * INV_TWO_PI * silhouettes.density(tri, q) / silhouettes.curvature(tri, q, w)
        return 0.0

    @wp.func
    def segment(
        scene: Scene,
        moving: wp.array(dtype=wp.int32),
        tri: Triangle,
        point: SilhouettePoint,
        rim: wp.bool,
        aim: TangentAim,
        share: wp.float32,
        direct: wp.bool,
    ) -> Segment:
        r = Segment()
        r.face2 = -1
        r.light = -1
        r.w = aim.w
        r.boundary_normal = -point.out
        r.step = step_off_primitive(scene, tri)
        r.x = point.x + r.step * point.out
        r.source = r.x
        any_moves = moves(scene, moving, point.face)
        # ---- Towards the source ----
        to_eye = wp.length(aim.eye - r.x)
        density = wp.float32(0.0)
        delta = wp.bool(False)
        if wp.static(delta_sample is not None):
            if aim.light >= 0:
                emitter = scene.emitters[aim.light]
                if is_delta_light(emitter.kind):
                    delta = True
                    ls = delta_sample(scene, emitter, point.x, wp.vec2(0.0, 0.0))
                    if ls.pdf <= 0.0 or vanishes(ls.radiance):
                        return r
                    reach = wp.where(aim.distant, FAR, to_eye)
                    if visibility.occluded(scene, r.source, r.w, reach):
                        return r
                    r.light = aim.light
                    r.known = 1
                    r.radiance = ls.radiance / emitter.probability
                    density = (1.0 - share) / around(tri, rim, aim.eye, aim.distant, point.q, r.w)
        if not delta:
            hit2 = visibility.closest(scene, r.source, r.w, FAR)
            r.face2 = hit2.face
            r.u2 = hit2.u
            r.v2 = hit2.v
            r.t2 = hit2.t
            if aim.light >= 0:
                # A segment that something cuts off from its light is not one that was aimed at what is in the way.
                if aim.distant != (hit2.face < 0):
                    return r
                if hit2.face >= 0:
                    if scene.shapes[scene.triangles[hit2.face].shape].emitter != aim.light:
                        return r
                    if wp.abs(hit2.t - to_eye) > NEAR_LIGHT * to_eye + STEPS * r.step:
                        return r
            y = r.w
            if r.face2 >= 0:
                any_moves += moves(scene, moving, r.face2)
                y = position(scene.triangles[r.face2], r.u2, r.v2)
                if wp.static(bool(config.area)):
                    own = scene.shapes[scene.triangles[r.face2].shape].emitter
                    if own >= 0:
                        r.radiance = emitted(scene, scene.emitters[own], r.face2, r.u2, r.v2, r.w)
            else:
                if wp.static(has_environment):
                    r.radiance = environment_eval(scene, r.w)
            if (direct or r.face2 < 0) and vanishes(r.radiance):
                return r
            density = uniform_density(share, tri, rim, point.q, r.w)
            if share < 1.0:
                towards = pdf_light(scene, r.face2, r.w, r.t2)
                if aim.light >= 0 and not towards > 0.0:
                    return r
                if towards > 0.0:
                    density += (1.0 - share) * towards / around(tri, rim, y, r.face2 < 0, point.q, r.w)
        # ---- Towards the sensor ----
        hit1 = visibility.closest(scene, r.x, -r.w, FAR)
        if hit1.face < 0 or density <= 0.0:
            return r
        if any_moves + moves(scene, moving, hit1.face) == 0:
            return r
        r.t1 = hit1.t
        if r.t1 <= r.step:
            return r
        r.face1 = hit1.face
        r.u1 = hit1.u
        r.v1 = hit1.v
        if delta:
            if not aim.distant:
                r.tau = r.t1 / (r.t1 + to_eye)
        elif r.face2 >= 0:
            r.tau = r.t1 / (r.t1 + r.t2)
        r.scale = 1.0 / density
        r.valid = 1
        return r

    return segment


@functools.cache
def make_secondary_silhouette_kernel(
    config: PathConfig, role: str, camera_moves: bool, light_pose: bool, indirect: bool = False
):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    silhouettes = make_silhouettes(config.primitives)
    rims = make_rims(config.primitives)
    coordinates = make_coordinates(config.primitives)
    light_aim = make_light_aim(config) if config.area or config.lights else None
    segment_at = make_silhouette_segment(config)
    accumulate_silhouette = make_silhouette_sink(role)
    accumulate_source = make_source_sink(role, light_pose, config.primitives)
    source = make_source(config, True)
    source = make_indirect(source) if indirect else source
    transport = make_transport(config, role, camera_moves, source)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    @wp.func
    def accumulate(
        scene: Scene, target: wp.array(dtype=wp.float32), point: SilhouettePoint, s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_silhouette(scene, target, point, w * s.boundary_normal)
        return accumulate_source(scene, target, s, w, total)

    @wp.kernel(module="unique", enable_backward=False)
    def secondary_silhouette(
        # Scene:
        scene: Scene,
        camera: Camera,
        outlines: wp.array(dtype=wp.int32),
        moving: wp.array(dtype=wp.int32),
        # In:
        share: wp.float32,
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u4 = sample_4d(sampler, SLOT_DIRECTION)
        jitter = sample_1d(sampler, SLOT_SILHOUETTE)
        u = (wp.float64(number) + wp.float64(jitter)) / wp.float64(job.samples)
        uniform = u < wp.float64(share)
        if uniform:
            u = u / wp.float64(share)
        else:
            u = (u - wp.float64(share)) / wp.float64(1.0 - share)
        face, along = choose_outline(outlines, u)
        rim = face < 0
        face = wp.where(rim, -1 - face, face)
        tri = scene.triangles[face]
        aim = TangentAim()
        aim.light = -1
        point = SilhouettePoint()
        if uniform:
            if wp.static(rims is not None):
                if rim:
                    aim.w = square_to_sphere(wp.vec2(u4[0], u4[1]))
                    point = rims.seen(tri, face, along, aim.w, True)
            if wp.static(silhouettes is not None):
                if not rim:
                    point = silhouettes.place(tri, face, wp.vec2(along, u4[0]))
                    s_axis = any_tangent(point.out)
                    t_axis = wp.cross(point.out, s_axis)
                    theta = TWO_PI * u4[1]
                    aim.w = wp.cos(theta) * s_axis + wp.sin(theta) * t_axis
        else:
            if wp.static(light_aim is not None):
                aim = light_aim(scene, tri.normal, u4)
                if aim.valid == 0:
                    return
                if wp.static(rims is not None):
                    if rim:
                        point = rims.seen(tri, face, along, aim.eye, aim.distant)
                if wp.static(silhouettes is not None):
                    if not rim:
                        point = silhouettes.seen(tri, face, aim.eye, aim.distant, along)
                aim.w = aim.eye
                if not aim.distant:
                    aim.w = wp.normalize(aim.eye - point.x)
        if point.valid == 0:
            return
        s = segment_at(scene, moving, tri, point, rim, aim, share, job.max_depth == 2)
        if s.valid == 0:
            return
        uv = coordinates(tri, point.q)
        note_place(scene, NOTE_POINT, face, uv[0], uv[1], point.x, s.w, s.radiance)
        s.scale *= wp.float32(outlines.shape[0]) / wp.float32(job.samples)
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate(scene, target, point, s, 1.0)
        weight = transport(scene, camera, sampler, s, s.scale, rest, job, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                if accumulate(scene, target, point, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return secondary_silhouette
