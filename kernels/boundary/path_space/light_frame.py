"""The frame of a projected image, and its texels' borders: lines through a pinhole in which light jumps.

A line of the image spans a plane with the pinhole o, and where that plane cuts a surface irradiance jumps. At distance
1 it is a straight line of points x_b = o + M (X, Y, 1), the edge of a hard shadow: with J the jump of the irradiance at
x_b and x_1 the first point behind it, dI = W_1 . J n . ( x_b' - (1 - tau) x_1' - tau o' ) sin(phi) dl, 1 - tau = |x_b -
o| / |x_1 - o|.

Derivation: ``docs/theory/boundary.md#frames-of-projected-images``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import Incident, constant
from warp_psdr.kernels.boundary.transport import Segment, make_transport
from warp_psdr.kernels.constants import FAR, PI
from warp_psdr.kernels.distribution import find_interval_64
from warp_psdr.kernels.emitter.projector import KINDS, image_aspect
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import half_width
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Camera, Emitter, Scene
from warp_psdr.kernels.texture.texture import make_texture
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@wp.struct
class FrameLines:
    """Lines of projected images across which light jumps (``topology/light_frames.py``)."""

    cdf: wp.array(dtype=wp.float32)  # cumulative selection probabilities, n + 1
    emitter: wp.array(dtype=wp.int32)
    ends: wp.array(dtype=wp.vec4)  # where a line starts and ends: (u, v, u, v)
    across: wp.array(dtype=wp.vec2)  # from the line to where the image is read beside it


@wp.func
def on_screen(place: wp.vec2, width: wp.float32, aspect: wp.float32) -> wp.vec2:
    """(X, Y) of a place of the image, in the projector's frame at distance 1."""
    return wp.vec2(width * (1.0 - 2.0 * place[0]), width * (1.0 - 2.0 * place[1]) / aspect)


@wp.func
def known(scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32) -> Incident:
    return constant(s.radiance, k)


@functools.cache
def make_frame_sink(role: str):
    """Return ``accumulate_frame(scene, target, light, place, tau, g) -> float``: the adjoint g of x_b, and o's."""
    sink = make_sink(role)

    @wp.func
    def accumulate_frame(
        scene: Scene, target: wp.array(dtype=wp.float32), light: Emitter, place: wp.vec2, tau: wp.float32, g: wp.vec3
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        values = scene.values
        fov = values[light.cutoff]
        width = half_width(fov)
        at = on_screen(place, width, image_aspect(scene, light))
        m = light.to_world
        total = wp.float32(0.0)
        for i in range(3):
            total += sink(target, m + 4 * i, at[0] * g[i]) + sink(target, m + 4 * i + 1, at[1] * g[i])
            total += sink(target, m + 4 * i + 2, g[i]) + sink(target, m + 4 * i + 3, (1.0 - tau) * g[i])
        aside = at[0] * load_column(values, m, 0) + at[1] * load_column(values, m, 1)
        opening = wp.grad(half_width)(fov)
        return total + sink(target, light.cutoff, wp.dot(g, aside) * opening / width)

    return accumulate_frame


@functools.cache
def make_light_frame_kernel(config: PathConfig, role: str, camera_moves: bool, light_pose: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    transport = make_transport(config, role, camera_moves, known)
    accumulate_frame = make_frame_sink(role)
    texture_at = make_texture(KINDS)
    sample_1d = make_sampler(config.sampler).sample_1d

    @wp.func
    def image_at(scene: Scene, light: Emitter, place: wp.vec2) -> wp.vec3:
        if wp.min(place) < 0.0 or wp.max(place) > 1.0:
            return wp.vec3(0.0, 0.0, 0.0)
        return texture_at(scene, light.texture, 0, 0.0, 0.0, place)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def light_frame(
        # Scene:
        scene: Scene,
        camera: Camera,
        lines: FrameLines,
        moving: wp.array(dtype=wp.int32),
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u = (wp.float64(number) + wp.float64(sample_1d(sampler, 0))) / wp.float64(job.samples)
        line = find_interval_64(lines.cdf, 0, lines.cdf.shape[0] - 1, u)
        probability = lines.cdf[line + 1] - lines.cdf[line]
        along = wp.clamp(wp.float32((u - wp.float64(lines.cdf[line])) / wp.float64(probability)), 0.0, 1.0)
        light = scene.emitters[lines.emitter[line]]
        ends = lines.ends[line]
        across = lines.across[line]
        first = wp.vec2(ends[0], ends[1])
        last = wp.vec2(ends[2], ends[3])
        place = (1.0 - along) * first + along * last
        jump = image_at(scene, light, place - across) - image_at(scene, light, place + across)
        if vanishes(jump):
            return
        values = scene.values
        o = load_column(values, light.to_world, 3)
        x_axis = load_column(values, light.to_world, 0)
        y_axis = load_column(values, light.to_world, 1)
        z_axis = load_column(values, light.to_world, 2)
        width = half_width(values[light.cutoff])
        aspect = image_aspect(scene, light)
        at = on_screen(place, width, aspect)
        d = at[0] * x_axis + at[1] * y_axis + z_axis
        distance = wp.length(d)
        hit = visibility.closest(scene, o, d / distance, FAR)
        if hit.face < 0 or not hit.t > 0.0:
            return
        if moving[scene.triangles[hit.face].shape] == 0:
            return
        step = on_screen(last, width, aspect) - on_screen(first, width, aspect)
        edge = step[0] * x_axis + step[1] * y_axis
        aside = on_screen(place + across, width, aspect) - at
        s = Segment()
        s.light = -1  # no occluder stands at the edge, in whose place the camera could look past it
        s.face2 = -1
        s.x = o + d
        s.w = -d / distance
        s.t1 = hit.t - distance
        s.tau = 1.0 - distance / hit.t
        s.face1 = hit.face
        s.u1 = hit.u
        s.v1 = hit.v
        m = wp.cross(wp.normalize(edge), s.w)
        s.boundary_normal = wp.where(wp.dot(m, aside[0] * x_axis + aside[1] * y_axis) < 0.0, -m, m)
        z = wp.length(z_axis)
        s.radiance = (wp.static(PI) * values[light.scale] * (distance / z) / (z * z)) * jump
        scale = wp.length(edge) / (probability * wp.float32(job.samples))
        rest = wp.float32(0.0)
        if wp.static(light_pose and role == "forward"):
            rest = accumulate_frame(scene, target, light, place, s.tau, s.boundary_normal)
        weight = transport(scene, camera, sampler, s, scale, rest, job, target, image_out)
        if wp.static(light_pose and role == "reverse"):
            if weight != 0.0:
                if accumulate_frame(scene, target, light, place, s.tau, weight * s.boundary_normal) != 0.0:
                    count_invalid(scene, sampler)

    return light_frame
