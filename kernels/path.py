"""The one path loop: camera ray, emission, next-event estimation, scattering, Russian roulette.

Unidirectional path tracing with multiple importance sampling [Vea97]. A path is a sequence of vertices x_1, x_2, ...
behind the camera. At every vertex

    L_n = E_n + D_n + beta_n L_{n+1},

E_n the emission that the incoming ray hits (weighted against next-event estimation at the vertex before), D_n the
next-event estimate, beta_n = f_s / (p q) the scattering value over its pdf p and survival probability q. ``path_step``
computes one vertex and the state from which the next one follows; the primal pass sums throughput times (E_n + D_n),
the differential passes keep the vertices and sweep them backwards (``interior/replay.py``). Sampling decisions, pdfs,
MIS weights and roulette are detached everywhere.

Depth counts as in Mitsuba's ``path``: ``max_depth`` vertices at most (1: emission only; -1: unbounded).
"""

import functools
from dataclasses import dataclass

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import make_bsdf
from warp_psdr.kernels.bvh.wide import RayHit, make_intersect
from warp_psdr.kernels.camera import CameraSample, make_camera_ray, make_lens
from warp_psdr.kernels.constants import CAMERA_PERSPECTIVE, FAR, LOBE_NONE, LOBE_SMOOTH, RFILTER_BOX
from warp_psdr.kernels.distribution import find_interval
from warp_psdr.kernels.emitter.area import make_area, pdf_area
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.film import make_filter
from warp_psdr.kernels.invalid import finite, inverse_pdf, vanishes
from warp_psdr.kernels.math import aligned_tangent, any_tangent, to_local, to_world
from warp_psdr.kernels.notes import NOTE_VERTEX, note
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.sampling import mis_weight
from warp_psdr.kernels.sight import make_accel_at
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Bsdf, Camera, LightSample, Material, Scene
from warp_psdr.kernels.surface import make_surface, point_on
from warp_psdr.kernels.texture import make_texture

#: Sample slots per path vertex: next-event estimation, scattering. Slot 0 is the camera's.
SLOTS_PER_VERTEX = 2
#: Largest and smallest survival probability of Russian roulette (Mitsuba's upper one). The lower bound applies to
#: differential passes only, where a path of zero throughput still carries derivatives.
ROULETTE_MAX = 0.95
ROULETTE_MIN = 0.05


@dataclass(frozen=True)
class PathConfig:
    """What a scene needs compiled; frozen and hashable, one kernel per value."""

    bsdfs: tuple[int, ...]
    #: Texture kinds in use per material slot c0, c1, c2, s0, s1; empty: the slot is unused.
    slots: tuple[tuple[int, ...], ...]
    two_sided: bool
    smooth: bool
    flat: bool
    uv: bool
    tangent: bool
    #: Texture kinds of area lights; empty: there are none.
    area: tuple[int, ...]
    #: Other light sources.
    lights: tuple[int, ...]
    #: False: ``max_depth`` is 1 and only directly visible light is computed.
    scatter: bool
    hide_emitters: bool
    sampler: str
    filter: int
    ray_backend: str
    ray_width: int
    #: Kind of the camera.
    camera: int = CAMERA_PERSPECTIVE
    #: True: what a sample meets is written down (``notes.py``).
    noted: bool = False
    #: True: there are area lights, which the camera does not see (``sight.py``).
    hidden: bool = False


@wp.struct
class PathState:
    """What one vertex hands to the next."""

    alive: wp.int32
    depth: wp.int32
    o: wp.vec3
    d: wp.vec3
    t_max: wp.float32
    throughput: wp.vec3
    pdf: wp.float32  # solid angle, of d; 0: no next-event estimate could have found what d hits
    eta: wp.float32  # product of relative refractive indices
    left: wp.int32  # face that d left by a smooth lobe, from one; 0: none
    met: wp.int32  # more than 0: the path has met a shape that matters
    seen: RayHit  # what the camera's ray meets, where ``camera_rays.py`` has traced it


@wp.func
def path_from(o: wp.vec3, d: wp.vec3, t_max: wp.float32, depth: wp.int32) -> PathState:
    """A path that starts with a ray, behind ``depth`` vertices."""
    state = PathState()
    state.alive = 1
    state.depth = depth
    state.o = o
    state.d = d
    state.t_max = t_max
    state.throughput = wp.vec3(1.0, 1.0, 1.0)
    state.eta = 1.0
    return state


@wp.struct
class PathVertex:
    """A path vertex and what was sampled there; enough to recompute every factor without tracing a ray."""

    face: wp.int32  # -1: the ray left the scene
    u: wp.float32
    v: wp.float32
    before: wp.int32  # face that the ray which found it left by a smooth lobe, -1: none
    o: wp.vec3  # where that ray started
    d: wp.vec3  # and its direction
    throughput: wp.vec3  # product of the beta before this vertex
    direct: wp.vec3  # E_n + D_n
    beta: wp.vec3
    e_weight: wp.float32  # MIS weight of the emission hit
    light: wp.int32  # emitter found by next-event estimation, -1: none, or occluded
    light_face: wp.int32
    light_u: wp.float32
    light_v: wp.float32
    light_wi: wp.vec3
    light_weight: wp.float32  # MIS weight / pdf
    lobe: wp.int32
    wo: wp.vec3
    inv_pdf: wp.float32  # 1 / (pdf q)


@wp.struct
class Frame:
    """Shading frame on the side of the incoming ray, and the scattering record of that side."""

    n: wp.vec3
    s: wp.vec3
    t: wp.vec3
    side: wp.float32  # +1, or -1 on the back of a two-sided material
    bsdf: wp.int32


@wp.func
def film_position(camera: Camera, px: wp.int32, py: wp.int32, offset: wp.vec2) -> wp.vec2:
    """Film coordinates in [0, 1]^2 of a point near the centre of a pixel of the crop window."""
    return wp.vec2(
        (wp.float32(px + camera.crop_x) + 0.5 + offset[0]) / wp.float32(camera.width),
        (wp.float32(py + camera.crop_y) + 0.5 + offset[1]) / wp.float32(camera.height),
    )


@functools.cache
def make_frame(two_sided: bool, tangent: bool):
    """Return ``frame_at(scene, bsdf, n, tangent, wi) -> Frame``."""

    @wp.func
    def frame_at(scene: Scene, bsdf: wp.int32, n: wp.vec3, dpdu: wp.vec3, wi: wp.vec3) -> Frame:
        f = Frame()
        f.side = 1.0
        f.bsdf = bsdf
        if wp.static(two_sided):
            if wp.dot(n, wi) < 0.0 and scene.bsdfs[bsdf].two_sided == 1:
                f.side = -1.0
                f.bsdf = scene.bsdfs[bsdf].back
        f.n = f.side * n
        if wp.static(tangent):
            f.s = aligned_tangent(f.n, dpdu)
        else:
            f.s = any_tangent(f.n)
        f.t = wp.cross(f.n, f.s)
        return f

    return frame_at


@functools.cache
def make_material(slots: tuple[tuple[int, ...], ...]):
    """Return ``material_at(scene, bsdf, face, u, v, uv) -> Material``; unused slots stay 0 and cost nothing."""
    c0, c1, c2, s0, s1 = (make_texture(kinds) if kinds else None for kinds in slots)
    has = tuple(bool(kinds) for kinds in slots)

    @wp.func
    def material_at(scene: Scene, b: Bsdf, face: wp.int32, u: wp.float32, v: wp.float32, uv: wp.vec2) -> Material:
        m = Material()
        if wp.static(has[0]):
            m.c0 = c0(scene, b.c0, face, u, v, uv)
        if wp.static(has[1]):
            if b.c1 >= 0:
                m.c1 = c1(scene, b.c1, face, u, v, uv)
        if wp.static(has[2]):
            if b.c2 >= 0:
                m.c2 = c2(scene, b.c2, face, u, v, uv)
        if wp.static(has[3]):
            if b.s0 >= 0:
                m.s0 = s0(scene, b.s0, face, u, v, uv)[0]
        if wp.static(has[4]):
            if b.s1 >= 0:
                m.s1 = s1(scene, b.s1, face, u, v, uv)[0]
        return m

    return material_at


@functools.cache
def make_light_sampler(config: PathConfig):
    """Return ``sample_light(scene, x, u4) -> (LightSample, emitter index, selection probability)``."""
    area = make_area(config.area)[1] if config.area else None
    other = make_lights(config.lights, None, ()).sample if config.lights else None

    @wp.func
    def sample_light(scene: Scene, x: wp.vec3, u4: wp.vec4) -> tuple[LightSample, wp.int32, wp.float32]:
        index = wp.int32(0)
        count = scene.emitters.shape[0]
        if count > 1:
            index = find_interval(scene.emitter_cdf, 0, count, u4[0])
        emitter = scene.emitters[index]
        if wp.static(bool(config.area and config.lights)):
            if emitter.kind == 0:
                ls = area(scene, emitter, x, wp.vec3(u4[1], u4[2], u4[3]))
            else:
                ls = other(scene, emitter, x, wp.vec2(u4[2], u4[3]))
                ls.face = -1
            return ls, index, emitter.probability
        elif wp.static(bool(config.area)):
            return area(scene, emitter, x, wp.vec3(u4[1], u4[2], u4[3])), index, emitter.probability
        else:
            sampled = other(scene, emitter, x, wp.vec2(u4[2], u4[3]))
            sampled.face = -1
            return sampled, index, emitter.probability

    return sample_light


@wp.func
def shadow_ray(scene: Scene, o: wp.vec3, ls: LightSample) -> tuple[wp.vec3, wp.float32]:
    """Direction and length of the ray from o to a light point, or to a little in front of an area light's surface."""
    r = ls.wi
    t_max = ls.distance
    if ls.face >= 0:
        tri = scene.triangles[ls.face]
        y = point_on(tri, ls.u, ls.v)
        r = y + leaving_step(scene, ls.face) * tri.normal - o
        t_max = wp.length(r)
        r = r / t_max
    return r, t_max


@functools.cache
def make_path_step(config: PathConfig, differential: bool, sparse: bool = False, traced: bool = False):
    """Return ``path_step(scene, sampler, state, max_depth, rr_depth) -> (PathVertex, PathState)``.

    ``differential``: keep going where a factor is exactly zero, since its derivative may not be. ``sparse``: leave out
    next-event estimates before the path meets a shape that matters (``interior/replay.py``). ``traced``: the camera's
    ray has been, ``state.seen`` is what it meets.
    """
    closest_hit, any_hit = make_intersect(config.ray_backend, config.ray_width)
    accel_at = make_accel_at(config.hidden)
    surface_at = make_surface(config.smooth, config.flat, config.uv, config.tangent)
    frame_at = make_frame(config.two_sided, config.tangent)
    material_at = make_material(config.slots)
    bsdf = make_bsdf(config.bsdfs)
    emitted = make_area(config.area)[0] if config.area else None
    lights = make_lights(config.lights, None, ()) if config.lights else None
    environment_eval = lights.environment_eval if lights else None
    environment_eval_pdf = lights.environment_eval_pdf if lights else None
    environment = environment_eval is not None
    # A delta lobe is never found by next-event estimation.
    has_lights = bool(config.area or config.lights) and bsdf.eval is not None
    sample_light = make_light_sampler(config) if has_lights else None
    draw = make_sampler(config.sampler)
    sample_4d = draw.sample_4d

    @wp.func
    def path_step(
        scene: Scene, sampler: Sampler, state: PathState, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[PathVertex, PathState]:
        vertex = PathVertex()
        vertex.face = -1
        vertex.light = -1
        vertex.lobe = LOBE_NONE
        vertex.before = state.left - 1
        vertex.o = state.o
        vertex.d = state.d
        vertex.throughput = state.throughput
        after = PathState()
        # Drawn before the ray is traced: a CPU that executes out of order does both at once.
        if wp.static(config.scatter):
            if wp.static(has_lights):
                u4 = sample_4d(sampler, 1 + SLOTS_PER_VERTEX * state.depth)
            r4 = sample_4d(sampler, 2 + SLOTS_PER_VERTEX * state.depth)
        if wp.static(traced):
            hit = state.seen
            if state.depth > 0:
                hit = closest_hit(scene.accel, state.o, state.d, state.t_max)
        else:
            hit = closest_hit(accel_at(scene, state.depth), state.o, state.d, state.t_max)
        if hit.face < 0:
            if not finite(state.o + state.d):
                # A ray of a camera without a pose, which meets nothing: not black, nor what an environment holds there.
                vertex.direct = wp.vec3(wp.NAN, wp.NAN, wp.NAN)
                return vertex, after
            if wp.static(environment):
                if wp.static(not config.hide_emitters) or state.depth > 0:
                    weight = wp.float32(1.0)
                    if state.pdf > 0.0:
                        found, density = environment_eval_pdf(scene, state.d)
                        weight = mis_weight(state.pdf, density * scene.emitters[scene.environment].probability)
                        vertex.direct = weight * found
                    else:
                        vertex.direct = environment_eval(scene, state.d)
                    vertex.e_weight = weight
            return vertex, after

        vertex.face = hit.face
        vertex.u = hit.u
        vertex.v = hit.v
        surface = surface_at(scene, hit.face, hit.u, hit.v)
        shape = scene.shapes[surface.shape]
        if wp.static(bool(config.area)):
            if shape.emitter >= 0:
                emitter = scene.emitters[shape.emitter]
                weight = wp.float32(1.0)
                if state.pdf > 0.0:
                    pdf_light = pdf_area(scene, emitter, hit.face, state.d, hit.t) * emitter.probability
                    weight = mis_weight(state.pdf, pdf_light)
                vertex.e_weight = weight
                vertex.direct = weight * emitted(scene, emitter, hit.face, hit.u, hit.v, state.d)
        if wp.static(config.scatter):
            if max_depth >= 0 and state.depth + 1 >= max_depth:
                return vertex, after

            frame = frame_at(scene, shape.bsdf, surface.n, surface.tangent, -state.d)
            b = scene.bsdfs[frame.bsdf]
            material = material_at(scene, b, hit.face, hit.u, hit.v, surface.uv)
            wi = to_local(frame.s, frame.t, frame.n, -state.d)
            away = leaving_step(scene, hit.face)

            # The new direction is drawn before the shadow ray is traced: again the two overlap, and what depends on the
            # light's visibility, which is guessed badly, is short.
            bs = bsdf.sample(b.model, material, wi, r4[0], wp.vec2(r4[2], r4[3]))
            wo_world = to_world(frame.s, frame.t, frame.n, bs.wo)

            # Next-event estimation.
            wanted = wp.bool(True)
            if wp.static(sparse):
                after.met = state.met + scene.matters[surface.shape]
                wanted = after.met > 0
            if wp.static(has_lights):
                if wanted and not bsdf.is_delta(b.model):
                    ls, index, probability = sample_light(scene, surface.x, u4)
                    if not ls.pdf <= 0.0:
                        wo = to_local(frame.s, frame.t, frame.n, ls.wi)
                        pdf_bsdf = bsdf.pdf(b.model, material, wi, wo)
                        if not pdf_bsdf <= 0.0:
                            pdf_light = ls.pdf * probability
                            light_weight = inverse_pdf(pdf_light)
                            if ls.delta == 0:
                                light_weight *= mis_weight(pdf_light, pdf_bsdf)
                            value = light_weight * wp.cw_mul(bsdf.eval(b.model, material, wi, wo), ls.radiance)
                            if wp.static(differential) or not vanishes(value):
                                turn = wp.where(wp.dot(surface.ng, ls.wi) >= 0.0, away, -away)
                                o = surface.x + turn * surface.ng
                                r, t_max = shadow_ray(scene, o, ls)
                                if not any_hit(scene.accel, o, r, t_max):
                                    vertex.direct += value
                                    vertex.light = index
                                    vertex.light_face = ls.face
                                    vertex.light_u = ls.u
                                    vertex.light_v = ls.v
                                    vertex.light_wi = ls.wi
                                    vertex.light_weight = light_weight

            # Scattering.
            if bs.pdf <= 0.0:
                return vertex, after
            after.eta = state.eta * bs.eta
            after.depth = state.depth + 1
            inv_pdf = 1.0 / bs.pdf
            throughput = wp.cw_mul(state.throughput, inv_pdf * bs.value)
            if not finite(throughput + bs.pdf * wo_world):
                # Said here, for nothing behind would tell: rays without a direction meet nothing.
                vertex.beta = inv_pdf * bs.value
                vertex.direct = wp.vec3(wp.NAN, wp.NAN, wp.NAN)
                return vertex, after
            survival = wp.max(throughput)
            if wp.static(not differential):
                if survival <= 0.0:
                    return vertex, after
            if after.depth >= rr_depth:
                survival = wp.min(survival * after.eta * after.eta, ROULETTE_MAX)
                if wp.static(differential):
                    survival = wp.max(survival, ROULETTE_MIN)
                if r4[1] >= survival:
                    return vertex, after
                inv_pdf /= survival
                throughput /= survival
            vertex.lobe = bs.lobe
            vertex.wo = wo_world
            vertex.inv_pdf = inv_pdf
            vertex.beta = inv_pdf * bs.value
            turn = wp.where(wp.dot(surface.ng, wo_world) >= 0.0, away, -away)
            after.alive = 1
            after.left = wp.where(bs.lobe == LOBE_SMOOTH, hit.face + 1, 0)
            after.o = surface.x + turn * surface.ng
            after.d = wo_world
            after.t_max = FAR
            after.throughput = throughput
            after.pdf = wp.where(bs.lobe == LOBE_SMOOTH, bs.pdf, 0.0)
        return vertex, after

    if not config.noted:
        return path_step

    @wp.func
    def noted_step(
        scene: Scene, sampler: Sampler, state: PathState, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[PathVertex, PathState]:
        r, after = path_step(scene, sampler, state, max_depth, rr_depth)
        note(scene, NOTE_VERTEX, r.face, r.u, r.v, r.o, r.d, r.throughput, r.direct, r.beta)
        return r, after

    return noted_step


@functools.cache
def make_camera_start(config: PathConfig, filter_kind: int | None = None):
    """Return ``start(scene, camera, px, py, sampler) -> (PathState, CameraSample)``.

    ``filter_kind``: RFILTER_BOX draws positions uniformly in the pixel; None draws from the film's own filter.
    """
    draw = make_sampler(config.sampler)
    sample_4d = draw.sample_4d
    box = filter_kind == RFILTER_BOX
    filter_sample = make_filter(RFILTER_BOX if box else config.filter)
    camera_ray, _camera_origin = make_camera_ray(config.camera)
    lens_point = make_lens(config.camera)

    @wp.func
    def start(
        scene: Scene, camera: Camera, px: wp.int32, py: wp.int32, sampler: Sampler
    ) -> tuple[PathState, CameraSample]:
        u4 = sample_4d(sampler, 0)
        radius = camera.filter_radius
        if wp.static(box):
            radius = wp.float32(0.5)
        offset = filter_sample(wp.vec2(u4[0], u4[1]), radius, camera.filter_stddev)
        sample = CameraSample()
        sample.film = film_position(camera, px, py, offset)
        sample.lens = lens_point(wp.vec2(u4[2], u4[3]))
        ray = camera_ray(scene, camera, sample)
        state = path_from(ray.o + ray.t_min * ray.d, ray.d, ray.t_max - ray.t_min, 0)
        return state, sample

    return start
