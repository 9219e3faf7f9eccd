"""Antithetic pairs: derivatives by what turns the normals of glossy surfaces [ZDDZ21].

Turning a normal shifts a glossy lobe aside. The derivative is odd in the half vector h, and almost all of the noise of
its estimate is the sign. Directions therefore come in pairs whose half vectors mirror each other about the normal, both
traced as paths of the image with the same random numbers:

    (g(h) + g(h')) / (p(h) + p(h')),    g = df_s L J,  p = p_b J,  J = dw / dh.

One glossy vertex of a path branches (``branch_point.py``); a light point is drawn there, without a partner. Record and
sweep differentiates everything else. ``interior.Resampled`` has the same driver: it draws both directions, and two
light points, from candidates by their derivatives by the normal (``opposite.py``).

Derivation: ``docs/theory/interior.md#antithetic-pairs``, ``docs/theory/interior.md#resampled-tilts``.
"""

import functools
from dataclasses import replace

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.camera_rays import make_camera_paths
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.interior.factors.branch_point import (
    CHOICE_SLOT,
    DIRECTION_SLOT,
    LIGHT_SLOT,
    NO_ROULETTE,
    SALT,
    BranchPoint,
    make_branch_point,
)
from warp_psdr.kernels.interior.factors.contact import make_contact_weights
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.half_vectors import mirrored
from warp_psdr.kernels.interior.factors.opposite import make_opposite
from warp_psdr.kernels.interior.factors.pullback import make_frame_vjp
from warp_psdr.kernels.interior.factors.sinks import make_material_sink
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.interior.factors.tilts import make_tilts, tilts
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.invalid import count_invalid, finite, inverse_pdf, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_path_step
from warp_psdr.kernels.reading import bsdf_at, shape_at
from warp_psdr.kernels.rng import Sampler, make_sampler, salted, sampler_at
from warp_psdr.kernels.scattering import make_light_sampler, make_next_event, make_scatter, samples_lights
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import Surface, VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex
from warp_psdr.kernels.visibility import visibility_of


@wp.struct
class Seen:
    """A direction and what it finds."""

    wo: wp.vec3  # world
    light: wp.vec3  # radiance, with the weight of the estimate
    chi: wp.float32  # weight of the turn of what the direction is between, see ``contact.py``


@wp.struct
class Drawn:
    """What a branch draws: two directions and two light points."""

    one: Seen
    other: Seen
    light: Seen
    other_light: Seen


@wp.func
def seen_of(drawn: Drawn, number: wp.int32) -> Seen:
    """One of the four."""
    seen = drawn.one
    if number == 1:
        seen = drawn.other
    elif number == 2:
        seen = drawn.light
    elif number == 3:
        seen = drawn.other_light
    return seen


@functools.cache
def make_pair_kernel(config: PathConfig, wanted: GradientRequest, role: str, candidates: int = 0):
    """Return the kernel of ``interior.Antithetic``: the derivative by the normals of glossy vertices, complete.

    ``wanted`` holds, of material values, those that turn normals alone. Arguments as ``make_replay_kernel``'s.
    ``candidates``: draw both from so many, a square, as ``interior.Resampled`` does; 0: mirror one.
    """
    # Light behind null lobes is found by paths, not by shadow rays: one of the two complete ways.
    config = replace(config, through=False)
    lanes, starts, walk_step = make_camera_paths(config.unlit(), False)
    path_step = make_path_step(config, False)
    interaction = make_interaction(config.surfaces, config.lights)
    record, bsdf = interaction.record, interaction.bsdf
    material_record, add_materials = bsdf.record, bsdf.algebra.add
    glossy, normal, has_normal = bsdf.glossy, bsdf.normal, bsdf.normal is not None
    eval_vjp, relative_eta = interaction.eval_vjp, bsdf.relative_eta
    scatter = make_scatter(config, True)
    has_lights = samples_lights(config.lights, config.surfaces.bsdfs)
    sample_light = make_light_sampler(config.lights) if has_lights else None
    next_event = make_next_event(config.surfaces, config.lights, True) if has_lights else None
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    turning = tuple(
        slot if tilts(slot, config.surfaces.bsdfs) else slot._replace(kinds=()) for slot in config.surfaces.material
    )
    accumulate_material = make_material_sink(replace(config.surfaces, material=turning), wanted, role)
    only = make_tilts(config.surfaces).only
    frame_vjp = make_frame_vjp(config.surfaces.tangent)
    _sweep, finish, finish_vertex = make_sweep(config, wanted, role)
    weight_before, weight_of_light = make_contact_weights(
        config.rays.backend, config.rays.width, config.surfaces.primitives
    )
    sample_4d = make_sampler(config.sampler).sample_4d
    sample_weight = make_sample_weight(role)
    geometry = wanted.geometry
    forward = role == "forward"
    resamples = candidates > 0
    numbers, choose_directions, choose_lights = make_opposite(config, candidates) if resamples else (None, None, None)

    @wp.func
    def branches_on(scene: Scene, shape: wp.int32) -> wp.bool:
        """Whether a material of a shape is glossy."""
        front = bsdf_at(scene, shape_at(scene, shape).bsdf)
        found = glossy(front.model)
        if wp.static(config.surfaces.two_sided):
            if front.two_sided == 1:
                found = found or glossy(bsdf_at(scene, front.back).model)
        return found

    branch_point = make_branch_point(walk_step, branches_on)

    @wp.func
    def follow(
        scene: Scene,
        branch: Sampler,
        at: record,
        drawn: PathState,
        wo: wp.vec3,
        weight: wp.float32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> Seen:
        """What a path of the image finds that goes on along ``wo`` (local); ``drawn``: another one that does."""
        state = drawn
        state.d = leave_frame(at.frame, wo)
        state.o = interaction.offset(at, state.d)
        state.pdf = interaction.pdf(at, wo)
        state.throughput = wp.vec3(1.0, 1.0, 1.0)
        seen = Seen()
        seen.wo = state.d
        seen.chi = 1.0
        radiance = wp.vec3(0.0, 0.0, 0.0)
        first = wp.bool(True)
        while state.alive == 1:
            vertex, state = path_step(scene, branch, state, max_depth, rr_depth)
            radiance += wp.cw_mul(vertex.throughput, vertex.direct)
            if wp.static(geometry):
                if first:
                    seen.chi = weight_before(scene, vertex)
                first = False
        seen.light = weight * radiance
        return seen

    @wp.func
    def mirrored_pair(
        scene: Scene, branch: Sampler, at: record, point: BranchPoint, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[Seen, Seen]:
        one = Seen()
        other = Seen()
        goes_on = scatter(at, point.state, point.face, sample_4d(branch, DIRECTION_SLOT), NO_ROULETTE)
        if goes_on.lobe == LOBE_SMOOTH:
            wo = enter_frame(at.frame, goes_on.wo)
            m = wp.vec3(0.0, 0.0, 1.0)
            if wp.static(has_normal):
                m = normal(at.model, at.material, at.wi)
            eta = wp.float32(1.0)
            if wp.static(relative_eta is not None):
                eta = relative_eta(at.model, at.material, at.wi)
            partner = mirrored(at.wi, wo, m, eta)
            density = partner.own * interaction.pdf(at, wo)
            of_partner = wp.float32(0.0)
            if partner.other > 0.0:
                of_partner = partner.other * interaction.pdf(at, partner.wo)
            # [ZDDZ21, section 4]: both over the sum of their densities.
            over = inverse_pdf(density + of_partner)
            one = follow(scene, branch, at, goes_on.after, wo, partner.own * over, max_depth, rr_depth)
            if of_partner > 0.0:
                other = follow(scene, branch, at, goes_on.after, partner.wo, partner.other * over, max_depth, rr_depth)
        return one, other

    @wp.func
    def light_seen(scene: Scene, at: record, point: BranchPoint, r4: wp.vec4, weight: wp.float32) -> Seen:
        seen = Seen()
        if wp.static(has_lights):
            ls, light, _probability = sample_light(scene, at.x, r4)
            event = next_event(at, ls, light)
            if event.traces_shadow_ray == 1:
                if not visibility.occluded(scene, event.o, event.d, event.t_max):
                    seen.wo = event.wi
                    seen.light = (weight * event.weight) * ls.radiance
                    seen.chi = 1.0
                    if wp.static(geometry):
                        vertex = PathVertex()
                        vertex.face = point.face
                        vertex.light = event.light
                        vertex.light_face = event.face
                        vertex.light_u = event.u
                        vertex.light_v = event.v
                        seen.chi = weight_of_light(scene, vertex, at.x)
        return seen

    @wp.func
    def draw_mirrored(
        scene: Scene, branch: Sampler, at: record, point: BranchPoint, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Drawn:
        one, other = mirrored_pair(scene, branch, at, point, max_depth, rr_depth)
        drawn = Drawn()
        drawn.one = one
        drawn.other = other
        drawn.light = light_seen(scene, at, point, sample_4d(branch, LIGHT_SLOT), 1.0)
        return drawn

    @wp.func
    def chosen_direction(
        scene: Scene,
        branch: Sampler,
        at: record,
        point: BranchPoint,
        n4: wp.vec4,
        weight: wp.float32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> Seen:
        goes_on = scatter(at, point.state, point.face, n4, NO_ROULETTE)
        wo = enter_frame(at.frame, goes_on.wo)
        return follow(scene, branch, at, goes_on.after, wo, weight * goes_on.inv_pdf, max_depth, rr_depth)

    @wp.func
    def draw_resampled(
        scene: Scene,
        branch: Sampler,
        at: record,
        point: BranchPoint,
        a_n: wp.vec3,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        t: wp.array(dtype=wp.float32),
        key: wp.array(dtype=wp.float32),
        order: wp.array(dtype=wp.int32),
    ) -> Drawn:
        drawn = Drawn()
        sizes = wp.vec3(wp.abs(a_n[0]), wp.abs(a_n[1]), wp.abs(a_n[2]))
        u = sample_4d(branch, CHOICE_SLOT)
        r4 = sample_4d(branch, DIRECTION_SLOT)
        chosen = choose_directions(scene, at, r4, sizes, u[0], t, key, order)
        seen = Seen()
        if chosen.first < 0:
            seen.light = wp.vec3(chosen.first_weight, 0.0, 0.0)  # 0 or NaN
            drawn.one = seen
        else:
            n4 = numbers(r4, chosen.first)
            drawn.one = chosen_direction(scene, branch, at, point, n4, chosen.first_weight, max_depth, rr_depth)
            n4 = numbers(r4, chosen.second)
            drawn.other = chosen_direction(scene, branch, at, point, n4, chosen.second_weight, max_depth, rr_depth)
        if wp.static(has_lights):
            r4 = sample_4d(branch, LIGHT_SLOT)
            chosen = choose_lights(scene, at, r4, sizes, u[1], t, key, order)
            if chosen.first < 0:
                seen.light = wp.vec3(chosen.first_weight, 0.0, 0.0)
                drawn.light = seen
            else:
                drawn.light = light_seen(scene, at, point, numbers(r4, chosen.first), chosen.first_weight)
                drawn.other_light = light_seen(scene, at, point, numbers(r4, chosen.second), chosen.second_weight)
        return drawn

    @wp.func
    def turn_of(
        at: record, surface: Surface, wi: wp.vec3, seen: Seen, a_n: wp.vec3, chi: wp.float32
    ) -> tuple[material_record, wp.vec3]:
        """Adjoints of what turns normals in the material, and of the frame's normal; ``chi``: weight of wi's turn."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        a_material = material_record()
        n = wp.vec3(0.0, 0.0, 0.0)
        if not vanishes(seen.light):
            fa = eval_vjp(at, enter_frame(at.frame, seen.wo), wp.cw_mul(a_n, seen.light))
            a_material = only(fa.material)
            if wp.static(geometry):
                n = frame_vjp(at.frame, surface.tangent, wi, seen.wo, chi * fa.wi, seen.chi * fa.wo).n
        return a_material, n

    @wp.func
    def pull(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        camera: Camera,
        sample: CameraSample,
        point: BranchPoint,
        at: record,
        surface: Surface,
        a_n: wp.vec3,
        drawn: Drawn,
    ) -> wp.float32:
        """Scatter the adjoints; in forward mode the derivative. ``a_n``: adjoint of what leaves the vertex."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        chi = wp.float32(1.0)
        origin = point.state.o
        if wp.static(geometry):
            if point.state.depth == 0:
                origin = camera_origin(scene, camera, sample)
            before = PathVertex()
            before.face = point.face
            before.u = point.u
            before.v = point.v
            before.previous_face = point.state.left_face - 1
            before.o = origin
            chi = weight_before(scene, before)
        wi = -point.state.d
        a_material = material_record()
        a_frame_n = wp.vec3(0.0, 0.0, 0.0)
        number = wp.int32(0)
        while number < wp.static(4 if resamples else 3):
            m, n = turn_of(at, surface, wi, seen_of(drawn, number), a_n, chi)
            a_material = add_materials(a_material, m)
            a_frame_n += n
            number += 1
        adjoint, total = accumulate_material(
            scene, target, at.slots, point.face, point.u, point.v, surface.uv, a_material, VertexAdjoint()
        )
        if wp.static(geometry):
            adjoint.n = at.frame.side * a_frame_n
            carry = Carry()
            carry.face = point.face
            carry.u = point.u
            carry.v = point.v
            carry.o = origin
            carry.d = point.state.d
            carry.adjoint = adjoint
            if point.state.depth == 0:
                total += finish(scene, target, camera, sample, carry)
            else:
                done = finish_vertex(scene, target, carry, False)
                total += done.dot
        return total

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def pairs(
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
        t = wp.zeros(shape=(wp.static(max(candidates, 1)),), dtype=wp.float32)
        key = wp.zeros(shape=(wp.static(max(candidates, 1)),), dtype=wp.float32)
        order = wp.zeros(shape=(wp.static(max(candidates, 1)),), dtype=wp.int32)
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            branch = salted(sampler, SALT, 0)
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            point = branch_point(scene, sampler, branch, state, delta, job.max_depth, job.rr_depth)
            if point.face < 0:
                continue
            surface = interaction.surface(scene, point.face, point.u, point.v)
            at = interaction.on(scene, surface, point.face, point.u, point.v, point.state.d)
            if not glossy(at.model):
                continue
            a_n = point.weight * wp.cw_mul(delta, point.state.throughput)
            drawn = Drawn()
            if wp.static(resamples):
                drawn = draw_resampled(scene, branch, at, point, a_n, job.max_depth, job.rr_depth, t, key, order)
            else:
                drawn = draw_mirrored(scene, branch, at, point, job.max_depth, job.rr_depth)
            light = drawn.one.light + drawn.other.light + drawn.light.light + drawn.other_light.light
            valid = finite(light)
            if wp.static(forward):
                found = wp.vec3(0.0, 0.0, 0.0)
                for channel in range(3):
                    a = wp.cw_mul(axis_vec3(channel), a_n)
                    found[channel] = pull(scene, target, camera, sample, point, at, surface, a, drawn)
                valid = valid and finite(found)
                if valid:
                    derivative += wp.vec3d(found)
            else:
                if valid:
                    valid = pull(scene, target, camera, sample, point, at, surface, a_n, drawn) == 0.0
            if not valid:
                count_invalid(scene, sampler)
        if wp.static(forward):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return pairs
