"""Connections of bidirectional paths: vertices of a camera path joined to those of a light path, and their image.

Let the flux Phi arrive at z from the direction l, and let A be the throughput of the camera path at x. The connection
contributes

    A f(x, w) [ |n_g . w| / (|n_g . l| r^2) ] f(z, l) Phi,

with w the direction from x to z, r their distance, cosines at z, and f the path tracer's scattering functions with
their cosines.

Derivation: ``docs/theory/light_tracing.md#inner-connections``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bidirectional_path import make_camera_walk, make_light_walk, make_walk_from
from warp_psdr.kernels.bidirectional_weights import LEAST_COSINE, Cuts, cuts_of
from warp_psdr.kernels.camera_rays import make_bundled_starts, rays_together
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import PixelJob, pixel_of
from warp_psdr.kernels.light_path import LightVertex, light_sampler
from warp_psdr.kernels.light_ray import LightRay
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample
from warp_psdr.kernels.sensor.projection import make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex
from warp_psdr.kernels.visibility import visibility_of

#: Tells the camera's random numbers from the light path's.
CAMERA_STREAM = 0x63616D65


@wp.struct
class Joint:
    """What joins two vertices."""

    joined: wp.int32
    w: wp.vec3  # from the camera's vertex to the light's, unit
    factor: wp.float32  # the bracket, times the weight
    near: wp.vec3  # f(x, w)
    far: wp.vec3  # f(z, l)


@functools.cache
def make_connect(config: PathConfig, differential: bool):
    """Return ``connect(scene, vertex, cuts, other, other_cuts) -> Joint``.

    ``differential``: keep what is exactly zero, since its derivative may not be.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    bsdf = interaction.bsdf

    @wp.func
    def connect(scene: Scene, vertex: PathVertex, cuts: Cuts, other: LightVertex, other_cuts: Cuts) -> Joint:
        r = Joint()
        at = interaction.at(scene, vertex.face, vertex.u, vertex.v, vertex.d)
        z = point_on(triangle_at(scene, other.face), other.u, other.v)
        segment = z - at.x
        squared = wp.length_sq(segment)
        if squared <= 0.0 or not bsdf.has_smooth(at.model):
            return r
        w = segment / wp.sqrt(squared)
        here = interaction.at(scene, other.face, other.u, other.v, w)
        if not bsdf.has_smooth(here.model):
            return r
        wo = enter_frame(at.frame, w)
        to_light = enter_frame(here.frame, -other.d)
        r.near = interaction.eval(at, wo)
        r.far = interaction.eval(here, to_light)
        pdf = interaction.pdf(at, wo)
        pdf_on = interaction.pdf(here, to_light)
        if pdf <= 0.0 or pdf_on <= 0.0:
            return r
        if wp.static(not differential):
            if vanishes(wp.cw_mul(r.near, r.far)):
                return r
        cosine = wp.abs(wp.dot(here.ng, w))
        leaving = wp.abs(wp.dot(at.ng, w))
        arriving = wp.max(wp.abs(wp.dot(here.ng, other.d)), LEAST_COSINE)
        turned = at
        turned.wi = wo
        back = interaction.pdf(turned, at.wi)
        turned = here
        turned.wi = to_light
        back_on = interaction.pdf(turned, here.wi)
        in_front = cuts_of(cuts, back, leaving) * back_on
        behind = cuts_of(other_cuts, pdf_on, cosine) * pdf
        r.w = w
        r.factor = cosine / (arriving * (squared + in_front + behind))
        if not r.factor > 0.0:
            return r
        o = interaction.offset(at, w)
        ray = interaction.offset(here, -w) - o
        length = wp.length(ray)
        if visibility.occluded(scene, o, ray / length, length):
            return r
        r.joined = 1
        return r

    return connect


@functools.cache
def make_subpaths(config: PathConfig, differential: bool):
    """Return ``(light_path, connections)``.

    ``light_path(scene, camera, job, sphere, number, i, vertices_out, cuts_out) -> (LightRay, count)`` keeps a light
    path; ``connections(scene, job, vertex, cuts, n, ray, count, vertices, all_cuts, found_out) -> vec3`` joins the n-th
    vertex of the camera's path to all of it: what they bring, and a ``Joint`` each.
    """
    _record, start, step = make_light_walk(config, differential)
    connect = make_connect(config, differential)
    most = config.most_vertices

    @wp.func
    def light_path(
        scene: Scene,
        camera: Camera,
        job: PixelJob,
        sphere: wp.vec4,
        number: wp.int32,
        i: wp.int32,
        vertices_out: wp.array(dtype=LightVertex),
        cuts_out: wp.array(dtype=Cuts),
    ) -> tuple[LightRay, wp.int32]:
        sampler = light_sampler(job, camera, number, i)
        ray, walk = start(scene, sphere, sampler)
        count = wp.int32(0)
        while walk.alive == 1 and count < wp.static(most):
            vertex, walk = step(scene, camera, sampler, walk, job.max_depth, job.rr_depth)
            if vertex.invalid == 1:
                count_invalid(scene, sampler)
            if vertex.face >= 0:
                vertices_out[count] = vertex
                cuts_out[count] = walk.cuts
                count += 1
        return ray, count

    @wp.func
    def connections(
        scene: Scene,
        max_depth: wp.int32,
        vertex: PathVertex,
        cuts: Cuts,
        n: wp.int32,
        ray: LightRay,
        count: wp.int32,
        vertices: wp.array(dtype=LightVertex),
        all_cuts: wp.array(dtype=Cuts),
        found_out: wp.array(dtype=Joint),
    ) -> wp.vec3:
        total = wp.vec3(0.0, 0.0, 0.0)
        for j in range(count):
            found = Joint()
            # n + 1 and j + 1 surfaces, and the light.
            if n + j + 3 <= max_depth:
                found = connect(scene, vertex, cuts, vertices[j], all_cuts[j])
            if found.joined == 1:
                flux = wp.cw_mul(ray.flux, vertices[j].throughput)
                total += found.factor * wp.cw_mul(wp.cw_mul(found.near, found.far), flux)
            found_out[n * wp.static(most) + j] = found
        return total

    return light_path, connections


@functools.cache
def make_connected_image_kernel(config: PathConfig):
    """Return the kernel of the whole image: camera paths count in their pixel, joined light paths are splatted."""
    most = config.most_vertices
    light_path, connections = make_subpaths(config, False)
    lanes = rays_together(config.rays, config.surfaces.primitives)
    starts = make_bundled_starts(config)
    camera_walk = make_camera_walk(config, False, lanes > 1)
    walk_from = make_walk_from(config.camera)
    splat, _gather = make_splat()

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def connected_image(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        sphere: wp.vec4,
        # Out:
        film_out: wp.array2d(dtype=wp.vec3),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        lights = wp.zeros(shape=(wp.static(most),), dtype=LightVertex)
        light_cuts = wp.zeros(shape=(wp.static(most),), dtype=Cuts)
        found = wp.zeros(shape=(wp.static(most * most),), dtype=Joint)
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        pixels = wp.float32(camera.crop_width) * wp.float32(camera.crop_height)
        for i in range(job.samples):
            ray, count = light_path(scene, camera, job, sphere, pixel.number, i, lights, light_cuts)
            of_light = light_sampler(job, camera, pixel.number, i)
            for j in range(count):
                if lights[j].joined == 1:
                    value = wp.cw_mul(ray.flux, wp.cw_mul(lights[j].throughput, lights[j].value))
                    splat(scene, of_light, camera, lights[j].pixel, job.scale * value, film_out)
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed ^ wp.uint32(CAMERA_STREAM))
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            walk = walk_from(state, sample)
            radiance = wp.vec3(0.0, 0.0, 0.0)
            n = wp.int32(0)
            while walk.path.alive == 1 and n < wp.static(most):
                vertex, walk = camera_walk(scene, camera, sampler, walk, job.max_depth, job.rr_depth)
                direct = vertex.direct
                if vertex.face >= 0:
                    direct += connections(
                        scene, job.max_depth, vertex, walk.cuts, n, ray, count, lights, light_cuts, found
                    )
                radiance += wp.cw_mul(vertex.throughput, direct)
                n += 1
            if finite(radiance):
                wp.atomic_add(film_out, pixel.py, pixel.px, (job.scale * pixels) * radiance)
            else:
                count_invalid(scene, sampler)

    return connected_image
