"""Light paths: a ray that leaves a light meets surfaces, and each of them is joined to the camera.

With the direction l towards the light and w towards the camera, or the next vertex, f_s is the path tracer's for light
that comes from l and is seen from w. The flux of the next ray over that of the last is

    f_s(w, l) |n . l| |n_g . w| / |n_g . l|        (smooth lobes, over the density of w)
    R |n . l| |n_g . w| / (|n_g . l| |n . w|)      (mirrors, glass)

with n the shading and n_g the geometric normal [Vea97, section 5.3]; R holds no squared index of refraction. Sampling
passes delta lobes. If light paths supplement camera paths (``PathConfig.caustics``), they bring what these do not find:
light of no area whose first lobe, null lobes aside, is a delta lobe.

Derivation: ``docs/theory/light_tracing.md#transport-of-flux``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import CAMERA_IRRADIANCEMETER, FAR, LOBE_NULL, LOBE_SMOOTH, THIN_LENSES
from warp_psdr.kernels.emitter.dispatch import is_delta_light
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.invalid import finite, vanishes
from warp_psdr.kernels.jobs import PixelJob
from warp_psdr.kernels.light_ray import LightRay, make_light_ray
from warp_psdr.kernels.reading import emitter_at
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.scattering import ROULETTE_MAX, ROULETTE_MIN
from warp_psdr.kernels.sensor.camera import make_lens
from warp_psdr.kernels.sensor.projection import make_projection
from warp_psdr.kernels.step import step_beside
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Cosines below it count as zero where one is divided by: such a vertex is lit exactly edge-on.
LEAST_COSINE = 1.0e-6
#: Sample slots: the light and the point, the direction; then of every vertex the next direction and the lens.
SLOT_LIGHT, SLOT_DIRECTION, SLOT_FIRST, SLOTS_PER_LIGHT_VERTEX = 0, 1, 2, 2
#: Paths that one scrambled sequence serves: as many as there are different numbers.
SEQUENCE = 1 << 24


@wp.struct
class LightState:
    """What one vertex of a light path hands to the next."""

    alive: wp.int32
    depth: wp.int32  # surfaces that the path has met
    turned: wp.int32  # 1: a mirror or glass has turned it; kept where that matters
    o: wp.vec3
    d: wp.vec3
    throughput: wp.vec3  # flux over that of the ray which left the light


@wp.struct
class LightVertex:
    """A vertex of a light path; enough to recompute every factor without tracing a ray."""

    face: wp.int32  # -1: the ray left the scene
    u: wp.float32
    v: wp.float32
    d: wp.vec3  # of the ray that found it
    throughput: wp.vec3
    joined: wp.int32  # 1: the camera sees it
    pixel: wp.vec2  # where, in pixels of the crop window
    to_camera: wp.vec3
    join: wp.float32  # |n_g . w| (pixels an area) / |n_g . l|
    value: wp.vec3  # join times f
    lobe: wp.int32
    wo: wp.vec3
    factor: wp.float32  # what f, or the weight of a delta lobe, is multiplied by
    beta: wp.vec3
    invalid: wp.int32  # 1: something is not finite


@wp.func
def light_sampler(job: PixelJob, camera: Camera, number: wp.int32, i: wp.int32) -> Sampler:
    """The numbers of a light path: all paths of a pass are samples of one sequence."""
    count = wp.int64(camera.crop_width) * wp.int64(camera.crop_height)
    k = wp.int64(job.first_sample + i) * count + wp.int64(number)
    return sampler_at(wp.int32(k // wp.int64(SEQUENCE)), wp.int32(k % wp.int64(SEQUENCE)), job.seed)


@functools.cache
def make_join(config: PathConfig, differential: bool):
    """Return ``join(scene, camera, vertex, x, cosine, lens) -> LightVertex``: the vertex as the camera sees it.

    ``cosine``: |n_g . l|. Its members ``joined`` to ``value`` are set.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    bsdf = interaction.bsdf
    project = make_projection(config.camera)[0]

    @wp.func
    def join(
        scene: Scene, camera: Camera, vertex: LightVertex, x: wp.vec3, cosine: wp.float32, lens: wp.vec2
    ) -> LightVertex:
        r = vertex
        if wp.static(config.rays.hidden):
            if scene.shapes[scene.triangles[vertex.face].shape].emitter >= 0:
                return r
        at = project(scene, camera, x, lens)
        if at.valid == 0:
            return r
        w = wp.normalize(at.origin - x)
        here = interaction.at(scene, vertex.face, vertex.u, vertex.v, -w)
        if not bsdf.has_smooth(here.model):
            return r
        to_light = enter_frame(here.frame, -vertex.d)
        f = interaction.eval(here, to_light)
        if wp.static(differential):
            if interaction.pdf(here, to_light) <= 0.0:
                return r
        else:
            if vanishes(f):
                return r
        o = step_beside(x, here.ng, w, here.step)
        ray = at.origin - o
        length = wp.length(ray)
        if visibility.hidden_from_camera(scene, o, ray / length, length - at.near):
            return r
        r.joined = 1
        r.pixel = at.pixel
        r.to_camera = w
        r.join = wp.abs(wp.dot(here.ng, w)) * at.per_area / cosine
        r.value = r.join * f
        return r

    return join


@functools.cache
def make_light_path(config: PathConfig, differential: bool):
    """Return ``(start, step)``.

    ``start(scene, sphere, sampler) -> (LightRay, LightState)``;
    ``step(scene, camera, sampler, state, max_depth, rr_depth) -> (LightVertex, LightState)``: the next vertex. A path
    of k surfaces that is joined to the camera has k + 1 vertices, the light's included.

    ``differential``: keep going where a factor is exactly zero, since its derivative may not be.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    join = make_join(config, differential)
    light_ray = make_light_ray(config.lights)
    lens_point = make_lens(config.camera)
    draw = make_sampler(config.sampler)
    sample_2d, sample_4d = draw.sample_2d, draw.sample_4d

    @wp.func
    def start_light(scene: Scene, sphere: wp.vec4, sampler: Sampler) -> tuple[LightRay, LightState]:
        ray = light_ray(scene, sphere, sample_4d(sampler, SLOT_LIGHT), sample_2d(sampler, SLOT_DIRECTION))
        state = LightState()
        state.o = ray.o
        state.d = ray.d
        state.throughput = wp.vec3(1.0, 1.0, 1.0)
        state.alive = 1
        if wp.static(not differential):
            state.alive = wp.where(vanishes(ray.flux), 0, 1)
        if wp.static(config.caustics):
            if not is_delta_light(emitter_at(scene, ray.emitter).kind):
                state.alive = 0
        return ray, state

    @wp.func
    def step_light(
        scene: Scene, camera: Camera, sampler: Sampler, state: LightState, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[LightVertex, LightState]:
        after = LightState()
        vertex = LightVertex()
        vertex.face = -1
        hit = visibility.closest(scene, state.o, state.d, FAR)
        if hit.face < 0:
            return vertex, after
        vertex.d = state.d
        vertex.throughput = state.throughput
        at = interaction.at(scene, hit.face, hit.u, hit.v, state.d)
        cosine = wp.abs(wp.dot(at.ng, state.d))
        if cosine < LEAST_COSINE:
            return vertex, after
        vertex.face = hit.face
        vertex.u = hit.u
        vertex.v = hit.v
        slot = SLOT_FIRST + SLOTS_PER_LIGHT_VERTEX * state.depth
        lens = wp.vec2(0.0, 0.0)
        if wp.static(config.camera in THIN_LENSES or config.camera == CAMERA_IRRADIANCEMETER):
            lens = lens_point(sample_2d(sampler, slot + 1))
        if wp.static(config.caustics):
            if state.turned == 1:
                vertex = join(scene, camera, vertex, at.x, cosine, lens)
        else:
            vertex = join(scene, camera, vertex, at.x, cosine, lens)
        if max_depth >= 0 and state.depth + 3 > max_depth:
            return vertex, after

        u4 = sample_4d(sampler, slot)
        bs = interaction.sample(at, u4[0], wp.vec2(u4[2], u4[3]))
        if bs.pdf <= 0.0:
            return vertex, after
        if wp.static(config.caustics):
            after.turned = state.turned
            if state.turned == 0 and bs.lobe != LOBE_NULL:
                if bs.lobe == LOBE_SMOOTH:
                    return vertex, after
                after.turned = 1
        w = leave_frame(at.frame, bs.wo)
        to_light = at.wi
        leaving = wp.abs(wp.dot(at.ng, w))
        factor = leaving / (cosine * bs.pdf)
        f = bs.value
        if bs.lobe == LOBE_SMOOTH:
            # Seen from the new direction.
            at.wi = bs.wo
            if wp.static(interaction.eval is not None):
                f = interaction.eval(at, to_light)
        else:
            if wp.abs(bs.wo[2]) < LEAST_COSINE:
                return vertex, after
            # Flux has no squared index of refraction.
            factor *= bs.eta * bs.eta * wp.abs(to_light[2]) / wp.abs(bs.wo[2])
        throughput = factor * wp.cw_mul(state.throughput, f)
        if not finite(throughput + w):
            vertex.invalid = 1
            return vertex, after
        survival = wp.min(wp.max(throughput), ROULETTE_MAX)
        if wp.static(differential):
            survival = wp.max(survival, ROULETTE_MIN)
        elif vanishes(throughput):
            return vertex, after
        if state.depth + 1 >= rr_depth:
            if u4[1] >= survival:
                return vertex, after
            factor /= survival
            throughput /= survival
        vertex.lobe = bs.lobe
        vertex.wo = w
        vertex.factor = factor
        vertex.beta = factor * f
        after.alive = 1
        after.depth = state.depth + 1
        after.o = interaction.offset(at, w)
        after.d = w
        after.throughput = throughput
        return vertex, after

    return start_light, step_light
