"""Derivatives whose rays move with the silhouettes of a signed distance: interior and boundary term as one integral.

Paths have at most two vertices behind the camera. If rays move as the silhouettes do, they see no moving discontinuity
[VSJ22]. The integral of h L over the directions w of the camera's rays then has the derivative d(h L), with the ray
attached to w' = V, plus h L div V. Record and sweep has the adjoint of that ray (``interior/factors/sweep.py``). Light
that a vertex finds moves its rays in the same way, from that vertex.

Derivation: ``docs/theory/signed_distances.md#moving-integrals``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.signed_distance.beyond import light_beyond
from warp_psdr.kernels.boundary.signed_distance.fields import FIELDS
from warp_psdr.kernels.boundary.signed_distance.warp_field import (
    Beyond,
    WarpAdjoint,
    WarpOptions,
    make_warp_field,
)
from warp_psdr.kernels.constants import EMITTER_AREA, LOBE_SMOOTH, RFILTER_BOX
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sinks import make_light_sink
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.interior.film_antithetic import make_filter_slope, make_spread_offset, spread_density
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_path_step
from warp_psdr.kernels.primitive.affine import is_primitive_at
from warp_psdr.kernels.primitive.dispatch import make_position
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.scattering import samples_lights
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.sensor.film import filter_share, uniform_offset
from warp_psdr.kernels.sensor.projection import camera_block, filter_1d, make_projection
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathVertex, film_position, path_from


@wp.struct
class FilmWeight:
    """The pixel filter at a sample over the density of the sample, and its gradient over the same [1 / pixel]."""

    h: wp.float32
    slope: wp.vec2


@functools.cache
def make_film_point(kind: int):
    """Return ``(draw, weigh)`` of a film's filter: offsets from a pixel's centre, and what they count.

    ``draw(camera, px, py, u: vec4) -> vec2``; ``weigh(camera, px, py, offset) -> FilmWeight``. Of a box the gradient is
    at the border of the pixel, which is ``film_border.py``'s.
    """
    box = kind == RFILTER_BOX
    spread = None if box else make_spread_offset(kind)
    slope = None if box else make_filter_slope(kind)

    @wp.func
    def draw(camera: Camera, px: wp.int32, py: wp.int32, u: wp.vec4) -> wp.vec2:
        if wp.static(box):
            return uniform_offset(camera, px, py, wp.vec2(u[0], u[1]))
        else:
            return spread(camera, u)

    @wp.func
    def weigh(camera: Camera, px: wp.int32, py: wp.int32, offset: wp.vec2) -> FilmWeight:
        r = FilmWeight()
        if wp.static(box):
            r.h = 1.0
            return r
        else:
            x = wp.float32(px) + 0.5 + offset[0]
            y = wp.float32(py) + 0.5 + offset[1]
            beside = x < 0.0 or y < 0.0 or x > wp.float32(camera.crop_width) or y > wp.float32(camera.crop_height)
            if beside and camera.sample_border == 0:
                return r
            over_x = 1.0 / (spread_density(camera, offset[0]) * filter_share(camera, px, camera.crop_width))
            over_y = 1.0 / (spread_density(camera, offset[1]) * filter_share(camera, py, camera.crop_height))
            h_x = over_x * filter_1d(camera, offset[0])
            h_y = over_y * filter_1d(camera, offset[1])
            r.h = h_x * h_y
            r.slope = wp.vec2(h_y * over_x * slope(camera, offset[0]), h_x * over_y * slope(camera, offset[1]))
            return r

    return draw, weigh


@functools.cache
def make_film_turn(kind: int):
    """Return ``turn(scene, camera, o, w, h, slope) -> vec3``: gradient by w of h ln(du / dw) + slope . u(w).

    u is the film point of the camera's ray o + t w, in pixels, and du / dw the area of film per solid angle.
    """
    project, film_gradient, _velocity = make_projection(kind)

    @wp.func
    def turn(scene: Scene, camera: Camera, o: wp.vec3, w: wp.vec3, h: wp.float32, slope: wp.vec2) -> wp.vec3:
        axis = wp.transpose(wp.inverse(camera_block(scene, camera))) * wp.vec3(0.0, 0.0, 1.0)
        at = project(scene, camera, o + w, wp.vec2(0.0, 0.0))
        return film_gradient(scene, camera, at, slope) - (3.0 * h / wp.dot(axis, w)) * axis

    return turn


@functools.cache
def make_reparametrised_kernel(
    config: PathConfig, wanted: GradientRequest, role: str, options: WarpOptions
) -> wp.Kernel:
    """Return the kernel, one thread a pixel; other arguments as of ``make_replay_kernel``."""
    path_step = make_path_step(config, True)
    camera_ray, camera_origin = make_camera_ray(config.camera)
    sweep, _finish, finish_vertex = make_sweep(config, wanted, role)
    moved = make_warp_field(config.surfaces.primitives[0], options, role)
    draw_point, weigh_point = make_film_point(config.filter)
    turn = make_film_turn(config.camera)
    interaction = make_interaction(config.surfaces, config.lights)
    has_lights = config.scatter and samples_lights(config.lights, config.surfaces.bsdfs)
    radiance_of = make_light_sink(config.surfaces, config.lights, wanted, role)[0] if has_lights else None
    lights = make_lights(config.lights.others, role, ()) if config.lights.others else None
    environment_vjp = lights.environment_vjp if lights else None
    position, _cross = make_position(config.surfaces.primitives)
    sample_4d = make_sampler(config.sampler).sample_4d
    sample_weight = make_sample_weight(role)
    forward = role == "forward"
    channels = 3 if forward else 1

    @wp.func
    def pull_light(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        first: PathVertex,
        w: wp.vec3,
        scale: wp.vec3,
        light: wp.vec3,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
    ) -> WarpAdjoint:
        """What the motion of w changes of f(w) L(w), weighted by a scale; ``light`` is L, from the face ``face``."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        surface = interaction.surface(scene, first.face, first.u, first.v)
        at = interaction.on(scene, surface, first.face, first.u, first.v, first.d)
        r = WarpAdjoint()
        if wp.static(FIELDS[config.surfaces.primitives[0]].convex):
            if is_primitive_at(scene, first.face):
                return r
        warp = moved.trace(scene, at.x, w)
        if warp.moves == 0:
            return r
        beyond = Beyond()
        a_w = wp.vec3(0.0, 0.0, 0.0)
        wo = enter_frame(at.frame, w)
        f = interaction.eval(at, wo)
        if face >= 0:
            if wp.static(bool(config.lights.area)):
                tri = scene.triangles[face]
                emitter = scene.emitters[scene.shapes[tri.shape].emitter]
                beyond = light_beyond(scene, emitter, position(tri, u, v), at.x, w)
        else:
            if wp.static(environment_vjp is not None):
                a_w = environment_vjp(scene, target, w, wp.cw_mul(scale, f)).x
        of_light = wp.cw_mul(scale, light)
        fa = interaction.eval_vjp(at, wo, of_light)
        a_w += leave_frame(at.frame, fa.wo)
        return moved.pull(scene, target, at.x, w, warp, beyond, wp.dot(of_light, f), a_w)

    @wp.func
    def pull_vertex(
        scene: Scene, target: wp.array(dtype=wp.float32), weight: wp.vec3, first: PathVertex, second: PathVertex
    ) -> WarpAdjoint:
        """The rays behind the first vertex: to what next-event estimation found, and to what the path met."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = WarpAdjoint()
        technique = wp.int32(0)
        while technique < 2:  # one copy of what is called, which takes minutes to compile for CUDA
            w = first.wo
            scale = first.inv_pdf * weight
            light = second.direct
            face = second.face
            u = second.u
            v = second.v
            found_light = first.lobe == LOBE_SMOOTH and not vanishes(light)
            if technique == 0:
                found_light = first.light >= 0
                if found_light:
                    surface = interaction.surface(scene, first.face, first.u, first.v)
                    w = first.light_wi
                    scale = first.light_weight * weight
                    light = radiance_of(scene, first, surface.x)
                    face = wp.where(scene.emitters[first.light].kind == EMITTER_AREA, first.light_face, -1)
                    u = first.light_u
                    v = first.light_v
            if found_light:
                found = pull_light(scene, target, first, w, scale, light, face, u, v)
                r.o += found.o
                r.dot += found.dot
            technique += 1
        return r

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def reparametrised(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        delta = sample_weight(job, pixel)
        if vanishes(delta):
            return
        derivative = wp.vec3d()  # in double precision, as the image
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            offset = draw_point(camera, pixel.px, pixel.py, sample_4d(sampler, 0))
            film = weigh_point(camera, pixel.px, pixel.py, offset)
            sample = CameraSample()
            sample.film = film_position(camera, pixel.px, pixel.py, offset)
            ray = camera_ray(scene, camera, sample)
            origin = camera_origin(scene, camera, sample)
            state = path_from(ray.o + ray.t_min * ray.d, ray.d, ray.t_max - ray.t_min, 0)
            first, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
            first.o = origin
            second = PathVertex()
            two = state.alive == 1
            if two:
                second, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
            seen = moved.trace(scene, origin, ray.d)
            turned = turn(scene, camera, origin, ray.d, film.h, film.slope)
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            channel = wp.int32(0)
            while channel < wp.static(channels):  # not unrolled, for the same reason
                weight = delta
                if wp.static(forward):
                    weight = delta[channel] * axis_vec3(channel)
                carry = Carry()
                carry.face = -2
                if two:
                    carry = sweep(scene, target, second, film.h * weight, carry)
                carry = sweep(scene, target, first, film.h * weight, carry)
                total = wp.float32(0.0)
                if wp.static(has_lights):
                    if first.face >= 0:
                        behind = pull_vertex(scene, target, film.h * weight, first, second)
                        carry.adjoint.x = carry.adjoint.x + behind.o
                        total += behind.dot
                radiance = wp.dot(weight, carry.radiance)
                done = finish_vertex(scene, target, carry, True)
                a_w = done.a_d + radiance * turned
                moves = moved.pull(
                    scene, target, origin, ray.d, seen, Beyond(), film.h * radiance, a_w
                )  # fmt: skip
                total += done.dot + moves.dot
                of_sample += total * axis_vec3(channel)
                channel += 1
            valid = finite(of_sample)
            if wp.static(not forward):
                valid = valid and vanishes(of_sample)
            if not valid:
                count_invalid(scene, sampler)
            elif wp.static(forward):
                derivative += wp.vec3d(of_sample)
        if wp.static(forward):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return reparametrised
