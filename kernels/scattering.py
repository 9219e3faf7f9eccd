"""The parts of one path vertex: incident emission, the light drawn for it, and the direction in which the path goes on.

``path.py`` puts them together for one path, ``path_lanes.py`` for several side by side. There, each part is the body of
a loop over lanes that the compiler turns into SIMD. This needs few branches, none of them around a load and none that
ends in a vector; results that do not count are therefore computed and then not selected.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import has_smooth_lobes
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import (
    EMITTER_AREA,
    FAR,
    LOBE_DELTA_REFLECTION,
    LOBE_DELTA_TRANSMISSION,
    LOBE_NONE,
    LOBE_NULL,
    LOBE_SMOOTH,
)
from warp_psdr.kernels.distribution import find_interval
from warp_psdr.kernels.emitter.area import make_area, make_pdf_area, pdf_area
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.invalid import finite, inverse_pdf, vanishes
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.reading import emitter_at, shape_at, triangle_at
from warp_psdr.kernels.sampling import mis_weight
from warp_psdr.kernels.structs import BsdfSample, LightSample, Scene, Triangle
from warp_psdr.kernels.vertex import LightConfig, PathConfig, PathState, SurfaceConfig

#: Sample slots per path vertex: next-event estimation, scattering. Slot 0 is the camera's.
SLOTS_PER_VERTEX = 2
#: Largest and smallest survival probability of Russian roulette (Mitsuba's upper one). The lower bound applies to
#: differential passes only, where a path of zero throughput still carries derivatives.
ROULETTE_MAX = 0.95
ROULETTE_MIN = 0.05
#: Least probability of the lobe that glass transmits, in differential passes. Its transmittance T vanishes at grazing
#: and critical angles faster than its derivative: drawn with the probability T, a sample is T' / T, without a bound.
#: (``docs/theory/specular.md#the-lobe-of-glass``)
LEAST_TRANSMITTED = 0.25


@wp.struct
class EmissionHit:
    """What a ray brings: E_n."""

    direct: wp.vec3
    weight: wp.float32  # its MIS weight
    on_surface: wp.int32  # 1: there is a surface to go on from


@wp.struct
class NextEvent:
    """A next-event estimate D_n, as long as its shadow ray is free."""

    traces_shadow_ray: wp.int32  # 1: it is worth the ray
    value: wp.vec3
    o: wp.vec3
    d: wp.vec3
    t_max: wp.float32
    light: wp.int32  # emitter
    face: wp.int32
    u: wp.float32
    v: wp.float32
    wi: wp.vec3
    weight: wp.float32  # MIS weight / pdf


@wp.struct
class ScatterSample:
    """How a path goes on."""

    after: PathState
    lobe: wp.int32
    wo: wp.vec3
    inv_pdf: wp.float32
    beta: wp.vec3
    invalid: wp.int32  # 1: there is no such direction, as a NaN of the scene has it


def samples_lights(lights: LightConfig, bsdfs: tuple[str, ...]) -> bool:
    """Whether there is next-event estimation: it never finds a delta lobe."""
    return bool(lights.area or lights.others) and has_smooth_lobes(bsdfs)


@functools.cache
def make_sky_hit(lights: LightConfig):
    """Return ``sky_hit(scene, state) -> EmissionHit`` of a ray that leaves the scene."""
    others = make_lights(lights.others, None, ()) if lights.others else None
    environment_eval_pdf = others.environment_eval_pdf if others else None
    environment = environment_eval_pdf is not None

    @wp.func
    def sky_hit(scene: Scene, state: PathState) -> EmissionHit:
        emission = EmissionHit()
        if wp.static(environment):
            found, density = environment_eval_pdf(scene, state.d)
            density *= emitter_at(scene, scene.environment).probability
            weight = wp.where(state.pdf > 0.0, mis_weight(state.pdf, density), 1.0)
            if wp.static(lights.hide_emitters):
                weight = wp.where(state.depth > 0, weight, 0.0)
            emission.weight = weight
            emission.direct = weight * found
        # A ray of a camera without a pose, which meets nothing: not black, nor what an environment holds there.
        lost = not finite(state.o + state.d)
        emission.weight = wp.where(lost, 0.0, emission.weight)
        emission.direct = where3(lost, wp.vec3(wp.NAN, wp.NAN, wp.NAN), emission.direct)
        return emission

    return sky_hit


@functools.cache
def make_emission_hit(lights: LightConfig, through: bool):
    """Return ``emission_hit(scene, state, hit) -> EmissionHit``."""
    emitted = make_area(lights.area, lights.shining).emitted if lights.area else None
    pdf_of_any = make_pdf_area(lights.shining)
    sky_hit = make_sky_hit(lights)

    @wp.func
    def emission_hit(scene: Scene, state: PathState, hit: RayHit) -> EmissionHit:
        emission = EmissionHit()
        if hit.face < 0:
            return sky_hit(scene, state)
        emission.on_surface = 1
        if wp.static(bool(lights.area)):
            light = shape_at(scene, triangle_at(scene, hit.face).shape).emitter
            if light >= 0:
                emitter = emitter_at(scene, light)
                weight = wp.float32(1.0)
                if state.pdf > 0.0:
                    distance = hit.t
                    if wp.static(through):
                        distance += state.seen.t
                    if wp.static(len(lights.shining) > 0):
                        pdf_light = pdf_of_any(scene, emitter, hit.face, hit.u, hit.v, state.d, distance)
                    else:
                        pdf_light = pdf_area(scene, emitter, hit.face, state.d, distance)
                    pdf_light *= emitter.probability
                    weight = mis_weight(state.pdf, pdf_light)
                emission.weight = weight
                emission.direct = weight * emitted(scene, emitter, hit.face, hit.u, hit.v, state.d)
        return emission

    return emission_hit


@functools.cache
def make_light_draw(lights: LightConfig, left_out: tuple[int, ...] = ()):
    """Return ``pick`` and ``draw``, which choose a light, and a point on it as seen from x.

    ``pick(scene, u: vec2) -> (emitter, face)``, face -1: the light is no area light;
    ``draw(scene, emitter, face, tri, x, u: vec2) -> LightSample``, ``tri`` the face's record, or anything.
    ``left_out``: kinds of lights, other than area lights, of which ``draw`` returns anything.
    """
    area = make_area(lights.area, lights.shining) if lights.area else None
    kinds = tuple(kind for kind in lights.others if kind not in left_out)
    other = make_lights(kinds, None, ()).sample if kinds else None

    @wp.func
    def pick(scene: Scene, u: wp.vec2) -> tuple[wp.int32, wp.int32]:
        index = wp.int32(0)
        if wp.static(not lights.one_light):
            index = find_interval(scene.emitter_cdf, 0, scene.emitters.shape[0], u[0])
        face = wp.int32(-1)
        if wp.static(bool(lights.area)):
            emitter = emitter_at(scene, index)
            if wp.static(not lights.others) or emitter.kind == EMITTER_AREA:
                face = area.select_triangle(scene, emitter, u[1])
        return index, face

    @wp.func
    def draw(scene: Scene, index: wp.int32, face: wp.int32, tri: Triangle, x: wp.vec3, u: wp.vec2) -> LightSample:
        emitter = emitter_at(scene, wp.where(wp.static(lights.one_light), 0, index))
        if wp.static(bool(lights.area and other is not None)):
            ls = LightSample()
            if face >= 0:
                ls = area.sample_point(scene, emitter, face, tri, x, u)
            else:
                ls = other(scene, emitter, x, u)
                ls.face = -1
        elif wp.static(bool(lights.area)):
            ls = area.sample_point(scene, emitter, wp.max(face, 0), tri, x, u)  # anything, where there is no face
        else:
            ls = other(scene, emitter, x, u)
            ls.face = -1
        ls.probability = emitter.probability
        return ls

    return pick, draw


@functools.cache
def make_light_sampler(lights: LightConfig):
    """Return ``sample_light(scene, x, u4) -> (LightSample, emitter index, selection probability)``."""
    pick, draw = make_light_draw(lights)

    @wp.func
    def sample_light(scene: Scene, x: wp.vec3, u4: wp.vec4) -> tuple[LightSample, wp.int32, wp.float32]:
        index, face = pick(scene, wp.vec2(u4[0], u4[1]))
        tri = Triangle()
        if wp.static(bool(lights.area)):
            if face >= 0:
                tri = triangle_at(scene, face)
        ls = draw(scene, index, face, tri, x, wp.vec2(u4[2], u4[3]))
        return ls, index, ls.probability

    return sample_light


@wp.func
def shadow_ray(o: wp.vec3, ls: LightSample) -> tuple[wp.vec3, wp.float32]:
    """Direction and length of the ray from o to a light point, or to a little in front of an area light's surface."""
    r = ls.target - o
    length = wp.length(r)
    near = ls.face >= 0
    return where3(near, (1.0 / wp.where(near, length, 1.0)) * r, ls.wi), wp.where(near, length, ls.distance)


@functools.cache
def make_estimate(surfaces: SurfaceConfig, lights: LightConfig, differential: bool):
    """Return ``estimate(at, ls, light, value, pdf) -> NextEvent``, ``at`` an interaction.

    ``value`` and ``pdf`` are those of its scattering functions towards the light. Arguments as ``make_path_step``'s.
    """
    interaction = make_interaction(surfaces, lights)
    record = interaction.record
    bsdf = interaction.bsdf

    @wp.func
    def estimate(at: record, ls: LightSample, light: wp.int32, value: wp.vec3, pdf: wp.float32) -> NextEvent:
        pdf_light = ls.pdf * ls.probability
        event = NextEvent()
        event.weight = inverse_pdf(pdf_light) * wp.where(ls.delta == 0, mis_weight(pdf_light, pdf), 1.0)
        event.value = event.weight * wp.cw_mul(value, ls.radiance)
        traces_shadow_ray = not (ls.pdf <= 0.0 or pdf <= 0.0 or not bsdf.has_smooth(at.model))
        if wp.static(not differential):
            traces_shadow_ray = traces_shadow_ray and not vanishes(event.value)
        event.traces_shadow_ray = wp.where(traces_shadow_ray, 1, 0)
        event.o = interaction.offset(at, ls.wi)
        d, t_max = shadow_ray(event.o, ls)
        event.d = d
        event.t_max = t_max
        event.light = light
        event.face = ls.face
        event.u = ls.u
        event.v = ls.v
        event.wi = ls.wi
        return event

    return estimate


@functools.cache
def make_next_event(surfaces: SurfaceConfig, lights: LightConfig, differential: bool):
    """Return ``next_event(at, ls, light) -> NextEvent``, ``at`` an interaction; arguments as ``make_path_step``'s."""
    interaction = make_interaction(surfaces, lights)
    record = interaction.record
    estimate = make_estimate(surfaces, lights, differential)

    @wp.func
    def next_event(at: record, ls: LightSample, light: wp.int32) -> NextEvent:
        wo = enter_frame(at.frame, ls.wi)
        return estimate(at, ls, light, interaction.eval(at, wo), interaction.pdf(at, wo))

    return next_event


@functools.cache
def make_through_event(surfaces: SurfaceConfig, lights: LightConfig):
    """Return ``through_event(at, ls, event, probability, transmittance) -> NextEvent``: one that crosses surfaces.

    ``probability``: of the null lobes of all that its shadow ray crosses.
    """
    interaction = make_interaction(surfaces, lights)
    record = interaction.record

    @wp.func
    def through_event(
        at: record, ls: LightSample, event: NextEvent, probability: wp.float32, transmittance: wp.vec3
    ) -> NextEvent:
        r = event
        wo = enter_frame(at.frame, ls.wi)
        pdf_light = ls.pdf * ls.probability
        weight = mis_weight(pdf_light, probability * interaction.pdf(at, wo))
        r.weight = inverse_pdf(pdf_light) * wp.where(ls.delta == 0, weight, 1.0)
        r.value = r.weight * wp.cw_mul(wp.cw_mul(interaction.eval(at, wo), ls.radiance), transmittance)
        return r

    return through_event


@functools.cache
def make_onward(config: PathConfig, differential: bool):
    """Return ``onward(at, bs, state, face, u, rr_depth) -> ScatterSample``; arguments as ``make_path_step``'s.

    ``bs`` is what was drawn from the scattering functions of ``at``, ``u`` a random number for Russian roulette.
    """
    interaction = make_interaction(config.surfaces, config.lights)
    record = interaction.record

    @wp.func
    def onward(
        at: record, bs: BsdfSample, state: PathState, face: wp.int32, u: wp.float32, rr_depth: wp.int32
    ) -> ScatterSample:
        scatter_sample = ScatterSample()
        scatter_sample.wo = leave_frame(at.frame, bs.wo)
        inv_pdf = 1.0 / bs.pdf
        beta = inv_pdf * bs.value
        throughput = wp.cw_mul(state.throughput, beta)
        alive = not bs.pdf <= 0.0
        # Said here, for nothing behind would tell: rays without a direction meet nothing.
        invalid = alive and not finite(throughput + bs.pdf * scatter_sample.wo)
        alive = alive and not invalid
        survival = wp.max(throughput)
        if wp.static(not differential):
            alive = alive and not survival <= 0.0
        eta = state.eta * bs.eta
        survival = wp.min(survival * eta * eta, ROULETTE_MAX)
        if wp.static(differential):
            survival = wp.max(survival, ROULETTE_MIN)
        late = state.depth + 1 >= rr_depth
        alive = alive and not (late and u >= survival)
        inv_q = wp.where(late, 1.0 / survival, 1.0)
        inv_pdf = wp.where(invalid, inv_pdf, inv_pdf * inv_q)
        scatter_sample.invalid = wp.where(invalid, 1, 0)
        scatter_sample.lobe = wp.where(alive, bs.lobe, LOBE_NONE)
        scatter_sample.inv_pdf = inv_pdf
        scatter_sample.beta = where3(alive or invalid, inv_pdf * bs.value, wp.vec3(0.0, 0.0, 0.0))
        smooth = bs.lobe == LOBE_SMOOTH
        scatter_sample.after.alive = wp.where(alive, 1, 0)
        scatter_sample.after.depth = state.depth + 1
        scatter_sample.after.left_face = wp.where(smooth, face + 1, 0)
        scatter_sample.after.o = interaction.offset(at, scatter_sample.wo)
        scatter_sample.after.d = scatter_sample.wo
        scatter_sample.after.t_max = FAR
        scatter_sample.after.throughput = inv_q * throughput
        scatter_sample.after.pdf = wp.where(smooth, bs.pdf, 0.0)
        scatter_sample.after.eta = eta
        if wp.static(config.through):
            # The direction was drawn before, and next-event estimation there finds what it hits.
            passes = bs.lobe == LOBE_NULL
            before = wp.where(passes, state.seen.t + wp.length(at.x - state.o), 0.0)
            scatter_sample.after.pdf = wp.where(passes, state.pdf * bs.pdf, scatter_sample.after.pdf)
            scatter_sample.after.seen.t = before
        return scatter_sample

    return onward


@functools.cache
def make_transmitted_more(surfaces: SurfaceConfig, lights: LightConfig):
    """Return ``(at, bs, u) -> BsdfSample``: ``bs``, for derivatives, of glass that lets little light pass; or None.

    Such glass is near its critical angle, where the transmittance rises steeply: it is drawn as often as
    ``LEAST_TRANSMITTED`` says. ``u`` is the random number that chose the lobe. None: the scene has no glass.
    """
    interaction = make_interaction(surfaces, lights)
    record, bsdf = interaction.record, interaction.bsdf
    if bsdf.relative_eta is None or bsdf.scatter is None:
        return None

    @wp.func
    def transmitted_more(at: record, bs: BsdfSample, u: wp.float32) -> BsdfSample:
        drawn = bs
        # Glass, with its two delta lobes alone.
        two = bs.lobe > LOBE_SMOOTH and bsdf.transmits(at.model) and bsdf.mirrors(at.model)
        if two and not bsdf.has_smooth(at.model) and not bsdf.has_null(at.model):
            passed = bsdf.probability(at.model, at.material, at.wi, LOBE_DELTA_TRANSMISSION)
            if passed > 0.0 and passed < LEAST_TRANSMITTED:
                reflects = u < 1.0 - LEAST_TRANSMITTED
                drawn.lobe = wp.where(reflects, LOBE_DELTA_REFLECTION, LOBE_DELTA_TRANSMISSION)
                drawn.pdf = wp.where(reflects, 1.0 - LEAST_TRANSMITTED, LEAST_TRANSMITTED)
                drawn.eta = wp.where(reflects, 1.0, bsdf.relative_eta(at.model, at.material, at.wi))
                scattered = interaction.scatter(at, drawn.lobe)
                drawn.wo = scattered.wo
                drawn.value = scattered.value
        return drawn

    return transmitted_more


@functools.cache
def make_scatter(config: PathConfig, differential: bool):
    """Return ``scatter(at, state, face, r4, rr_depth) -> ScatterSample``; arguments as ``make_path_step``'s."""
    interaction = make_interaction(config.surfaces, config.lights)
    record = interaction.record
    onward = make_onward(config, differential)
    transmitted_more = make_transmitted_more(config.surfaces, config.lights) if differential else None

    @wp.func
    def scatter(at: record, state: PathState, face: wp.int32, r4: wp.vec4, rr_depth: wp.int32) -> ScatterSample:
        bs = interaction.sample(at, r4[0], wp.vec2(r4[2], r4[3]))
        if wp.static(transmitted_more is not None):
            bs = transmitted_more(at, bs, r4[0])
        return onward(at, bs, state, face, r4[1], rr_depth)

    return scatter
