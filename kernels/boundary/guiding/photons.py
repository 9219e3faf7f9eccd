"""Photons and importons: where light and importance arrive, as points on surfaces [ZMY*20, section 6.3; Jen96].

A photon is a vertex of a light path with the flux [W] that it scatters. An importon is a vertex of a camera path with
its throughput. The sum over the k nearest ones, over pi times the area of the disk that holds them, is the radiance or
the importance that leaves a diffuse surface there.

Derivation: ``docs/theory/guiding.md#photons-and-importons``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import EMITTER_POINT, FAR, LOBE_SMOOTH, PI
from warp_psdr.kernels.emitter.area import area_density, make_area
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.interaction import leave_frame, make_interaction
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.math import any_tangent, to_world
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start, make_path_step
from warp_psdr.kernels.primitive.affine import is_primitive
from warp_psdr.kernels.primitive.dispatch import make_leaving
from warp_psdr.kernels.primitive.shining import make_shining
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere, square_to_disk, square_to_sphere
from warp_psdr.kernels.scattering import make_light_sampler
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import LightConfig, PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sample slots of a light path: source, position or direction, then one per vertex.
SLOT_SOURCE, SLOT_START, SLOT_VERTEX = 0, 1, 2


@wp.struct
class Emission:
    """A ray that light leaves a source along, and the flux that it carries."""

    o: wp.vec3
    d: wp.vec3
    flux: wp.vec3


@functools.cache
def make_photon_emission(lights: LightConfig, primitives: tuple[int, ...]):
    """Return ``emit(scene, center, radius, u4, u2) -> Emission``; the sphere holds the scene."""
    sample_light = make_light_sampler(lights)
    exact = make_shining(lights.shining)
    emitted = make_area(lights.area, lights.shining).emitted if lights.area else None
    step_off = make_leaving(primitives)

    @wp.func
    def emit(scene: Scene, center: wp.vec3, radius: wp.float32, u4: wp.vec4, u2: wp.vec2) -> Emission:
        r = Emission()
        ls, index, probability = sample_light(scene, center, u4)
        record = scene.emitters[index]
        if ls.face >= 0:
            tri = scene.triangles[ls.face]
            y = point_on(tri, ls.u, ls.v)
            n = tri.normal
            radiance = ls.radiance
            density = area_density(scene, record, ls.face)
            if wp.static(exact is not None):
                if is_primitive(tri):
                    q = exact.draw_uniform(tri, wp.vec2(u4[2], u4[3]))
                    y = exact.position(tri, q[0], q[1])
                    n = wp.normalize(exact.cross(tri, q[0], q[1]))
                    radiance = emitted(scene, record, ls.face, q[0], q[1], -n)
                    density = exact.pdf_uniform(tri, q[0], q[1], -n, 1.0)
            s = any_tangent(n)
            local = square_to_cosine_hemisphere(u2)
            r.d = to_world(s, wp.cross(n, s), n, local)
            r.o = y + step_off(scene, tri) * n
            r.flux = (PI / (density * probability)) * radiance
        elif ls.distance < 0.5 * FAR:
            position = load_column(scene.values, record.to_world, 3)
            if record.kind == EMITTER_POINT:
                position = load_vec3(scene.values, record.to_world)
            r.o = position
            r.d = square_to_sphere(u2)
            seen, _i, _p = sample_light(scene, position + r.d, u4)
            r.flux = (4.0 * PI / probability) * seen.radiance
        elif ls.pdf > 0.0:
            s = any_tangent(ls.wi)
            disk = square_to_disk(u2)
            r.o = center + radius * (ls.wi + disk[0] * s + disk[1] * wp.cross(ls.wi, s))
            r.d = -ls.wi
            r.flux = (PI * radius * radius / (ls.pdf * probability)) * ls.radiance
        return r

    return emit


@functools.cache
def make_photons_kernel(config: PathConfig):
    """Return the kernel: one thread a light path; it writes up to ``x_out.shape[1]`` photons, the others stay 0."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    emit = make_photon_emission(config.lights, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    draw = make_sampler(config.sampler)
    sample_2d = draw.sample_2d
    sample_4d = draw.sample_4d

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def photons(
        # Scene:
        scene: Scene,
        # In:
        center: wp.vec3,
        radius: wp.float32,
        seed: wp.uint32,
        first: wp.int32,
        # Out:
        x_out: wp.array2d(dtype=wp.vec3),
        weight_out: wp.array2d(dtype=wp.float32),
    ):
        number = first + wp.tid()
        sampler = sampler_at(number, 0, seed)
        ray = emit(scene, center, radius, sample_4d(sampler, SLOT_SOURCE), sample_2d(sampler, SLOT_START))
        o = ray.o
        d = ray.d
        flux = ray.flux
        vertex = wp.int32(0)
        while vertex < x_out.shape[1] and not vanishes(flux):
            hit = visibility.closest(scene, o, d, FAR)
            if hit.face < 0:
                return
            at = interaction.at(scene, hit.face, hit.u, hit.v, d)
            u4 = sample_4d(sampler, SLOT_VERTEX + vertex)
            bs = interaction.sample(at, u4[0], wp.vec2(u4[2], u4[3]))
            if bs.pdf <= 0.0:
                return
            flux = wp.cw_mul(flux, bs.value / bs.pdf)
            if bs.lobe == LOBE_SMOOTH:
                x_out[number, vertex] = at.x
                weight_out[number, vertex] = flux[0] + flux[1] + flux[2]
            d = leave_frame(at.frame, bs.wo)
            o = interaction.offset(at, d)
            vertex += 1

    return photons


@functools.cache
def make_importons_kernel(config: PathConfig):
    """Return the kernel: one thread a camera path, its pixel at random; outputs as those of the photons."""
    path_step = make_path_step(config, False)
    start = make_camera_start(config)
    sample_2d = make_sampler(config.sampler).sample_2d

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def importons(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        seed: wp.uint32,
        first: wp.int32,
        # Out:
        x_out: wp.array2d(dtype=wp.vec3),
        weight_out: wp.array2d(dtype=wp.float32),
    ):
        number = first + wp.tid()
        sampler = sampler_at(0, number, seed)
        count = x_out.shape[1]
        # The pixel's numbers lie behind those of the path.
        u = sample_2d(sampler, wp.static(1 << 20))
        px = wp.min(wp.int32(u[0] * wp.float32(camera.crop_width)), camera.crop_width - 1)
        py = wp.min(wp.int32(u[1] * wp.float32(camera.crop_height)), camera.crop_height - 1)
        state, _film = start(scene, camera, px, py, sampler)
        vertex = wp.int32(0)
        while state.alive == 1 and vertex < count:
            # One vertex more than is kept: path_step does not scatter at the last.
            here, state = path_step(scene, sampler, state, count + 1, count + 1)
            if state.alive == 1 and here.lobe == LOBE_SMOOTH:
                x_out[number, vertex] = state.o
                weight_out[number, vertex] = wp.max(state.throughput)
            vertex += 1

    return importons
