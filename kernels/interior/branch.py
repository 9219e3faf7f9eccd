"""Branches: derivatives by the shape of lobes, from directions that are drawn for the derivative, not for the image.

This file is the driver of the methods that draw for derivatives. A path is drawn as for an image. One of its vertices
at which a requested value is read is chosen, by the adjoint times the throughput there. At that vertex the method
chooses two directions and two light points by the local derivative. The directions continue as two paths of the image
with the same random numbers; the light points get a shadow ray each. MIS weights are those of the image's sampler: a
partition that depends on the direction alone is right for any sampler. Record and sweep (``replay.py``) differentiates
everything else.

Derivation: ``docs/theory/interior.md#branches``.
"""

import functools
from dataclasses import replace

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.camera_rays import make_camera_paths
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.decomposed import make_decomposed_directions
from warp_psdr.kernels.interior.factors.branch_point import (
    CHOICE_SLOT,
    DIRECTION_SLOT,
    LIGHT_SLOT,
    NO_ROULETTE,
    SALT,
    VERTEX_SLOT,
    BranchPoint,
    make_branch_point,
)
from warp_psdr.kernels.interior.factors.candidates import is_upper, make_candidates
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.mixtures import make_mixture, mixed_values
from warp_psdr.kernels.interior.factors.shape_parameters import make_shape_parameters
from warp_psdr.kernels.interior.factors.sinks import make_material_sink
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.interior.resampled import make_resampling, one_of
from warp_psdr.kernels.invalid import count_invalid, finite, inverse_pdf, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_path_radiance
from warp_psdr.kernels.reading import bsdf_at, shape_at
from warp_psdr.kernels.rng import Sampler, hashed, make_sampler, salted, sampler_at
from warp_psdr.kernels.scattering import make_light_sampler, make_next_event, make_scatter, samples_lights
from warp_psdr.kernels.sensor.camera import CameraSample
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig, PathState
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_branch_kernel(
    config: PathConfig, wanted: GradientRequest, role: str, candidates: int, decomposed: bool = False
):
    """Return the kernel of ``interior.Resampled``: the derivative by all values that ``wanted`` holds, complete.

    ``wanted`` holds branched material values and nothing else. Arguments as ``make_replay_kernel``'s. ``decomposed``:
    directions are those of ``interior.Decomposed``.
    """
    # Light behind null lobes is found by paths, not by shadow rays: one of the two complete ways.
    config = replace(config, through=False)
    unlit = config.unlit()
    lanes, starts, walk_step = make_camera_paths(unlit, False)
    path_radiance = make_path_radiance(config)
    interaction = make_interaction(config.surfaces, config.lights)
    record = interaction.record
    bsdf = interaction.bsdf
    dot, add_materials = bsdf.algebra.dot, bsdf.algebra.add
    material_record = bsdf.record
    eval_vjp, scatter_vjp = interaction.eval_vjp, interaction.scatter_vjp
    has_smooth = bsdf.has_smooth
    scatter = make_scatter(config, True)
    has_lights = samples_lights(config.lights, config.surfaces.bsdfs)
    sample_light = make_light_sampler(config.lights) if has_lights else None
    next_event = make_next_event(config.surfaces, config.lights, True) if has_lights else None
    direction_targets, light_targets, density = make_candidates(config, wanted, candidates)
    mixing = bool(mixed_values(config.surfaces, wanted))
    mixture_count, _rate, end_of, _member = (
        make_mixture(config.surfaces, wanted) if mixing else (None, None, None, None)
    )
    pdf_of = interaction.pdf
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    accumulate_material = make_material_sink(config.surfaces, wanted, role)
    shape_count, shape_direction, along_shape, moved_shape = make_shape_parameters(config.surfaces, wanted, role)
    resampling = make_resampling(candidates)
    numbers, choose_two = resampling.numbers, resampling.choose
    sample_4d = make_sampler(config.sampler).sample_4d
    sample_weight = make_sample_weight(role)
    forward = role == "forward"

    @wp.func
    def lobe_vjp(at: record, lobe: wp.int32, wo: wp.vec3, w: wp.vec3) -> material_record:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if wp.static(scatter_vjp is not None):
            if lobe > LOBE_SMOOTH:
                return scatter_vjp(at, lobe, w, wp.vec3(0.0, 0.0, 0.0)).material
        return eval_vjp(at, wo, w).material

    @wp.func
    def derivative_along(at: record, lobe: wp.int32, wo: wp.vec3, direction: material_record) -> wp.vec3:
        """Derivative of the value of a lobe, one number a colour."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        d = wp.vec3(0.0, 0.0, 0.0)
        for channel in range(3):
            d[channel] = dot(lobe_vjp(at, lobe, wo, axis_vec3(channel)), direction)
        return d

    @wp.func
    def reads_shape(scene: Scene, shape: wp.int32) -> wp.bool:
        """Whether a material of a shape has a value that is branched."""
        front = bsdf_at(scene, shape_at(scene, shape).bsdf)
        count = shape_count(scene, front.slots)
        if wp.static(config.surfaces.two_sided):
            if front.two_sided == 1:
                count += shape_count(scene, bsdf_at(scene, front.back).slots)
        return count > 0

    branch_point = make_branch_point(walk_step, reads_shape)

    @wp.func
    def partial(
        at: record, lobe: wp.int32, wo: wp.vec3, w: wp.vec3, direction: material_record
    ) -> tuple[material_record, wp.vec3]:
        """Adjoint of the material for a weight ``w`` of a lobe's value; in forward mode the derivative, else ``w``."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if wp.static(forward):
            return material_record(), wp.cw_mul(w, derivative_along(at, lobe, wo, direction))
        else:
            return lobe_vjp(at, lobe, wo, w), w

    @wp.func
    def from_candidates(
        scene: Scene,
        branch: Sampler,
        at: record,
        point: BranchPoint,
        direction: material_record,
        moved: material_record,
        a_n: wp.vec3,
        u: wp.vec2,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        t: wp.array(dtype=wp.float32),
    ) -> tuple[material_record, wp.vec3]:
        """dbeta_n L_{n+1}, of two directions; ``a_n``: adjoint of what leaves the vertex."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        sizes = wp.vec3(wp.abs(a_n[0]), wp.abs(a_n[1]), wp.abs(a_n[2]))
        r4 = sample_4d(branch, DIRECTION_SLOT)
        mixes = wp.bool(False)
        lower = at.material
        upper = at.material
        if wp.static(mixing):
            mixes = mixture_count(direction) == 1
            lower = end_of(at.material, direction, 0, False)
            upper = end_of(at.material, direction, 0, True)
        direction_targets(scene, at, mixes, lower, upper, moved, r4, sizes, t)
        chosen = choose_two(t, u)
        a_material = material_record()
        found = wp.vec3(0.0, 0.0, 0.0)
        if chosen.first < 0:
            found[0] = chosen.first_weight
        ray = wp.int32(0)
        while ray < 2:
            k, weight = one_of(chosen, ray)
            ray += 1
            if k >= 0:
                there = at
                if wp.static(mixing):
                    if mixes:
                        there.material = lower
                        if is_upper(numbers(r4, k)):
                            there.material = upper
                goes_on = scatter(there, point.state, point.face, numbers(r4, k), NO_ROULETTE)
                wo = enter_frame(at.frame, goes_on.wo)
                inv_pdf = goes_on.inv_pdf
                state = goes_on.after
                if wp.static(mixing):
                    if mixes:
                        both = density(at, lower, goes_on.lobe, wo) + density(at, upper, goes_on.lobe, wo)
                        inv_pdf = 2.0 * inverse_pdf(both)
                        if goes_on.lobe == LOBE_SMOOTH:
                            state.pdf = pdf_of(at, wo)
                            if state.pdf <= 0.0:
                                state.alive = 0
                radiance = path_radiance(scene, branch, state, max_depth, rr_depth)
                w = (weight * inv_pdf) * wp.cw_mul(a_n, radiance)
                if not vanishes(w):
                    a, d = partial(at, goes_on.lobe, wo, w, direction)
                    a_material = add_materials(a_material, a)
                    found += d
        return a_material, found

    from_directions = from_candidates
    if decomposed:
        from_directions = make_decomposed_directions(config, wanted, role, path_radiance, scatter, partial)

    @wp.func
    def from_lights(
        scene: Scene,
        branch: Sampler,
        at: record,
        direction: material_record,
        moved: material_record,
        a_n: wp.vec3,
        u: wp.vec2,
        t: wp.array(dtype=wp.float32),
    ) -> tuple[material_record, wp.vec3]:
        """dD_n, of two light points that are drawn by what they would send without anything in between."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        a_material = material_record()
        found = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(has_lights):
            sizes = wp.vec3(wp.abs(a_n[0]), wp.abs(a_n[1]), wp.abs(a_n[2]))
            r4 = sample_4d(branch, LIGHT_SLOT)
            light_targets(scene, at, moved, r4, sizes, t)
            chosen = choose_two(t, u)
            if chosen.first < 0:
                found[0] = chosen.first_weight
            ray = wp.int32(0)
            while ray < 2:
                k, weight = one_of(chosen, ray)
                ray += 1
                if k >= 0:
                    ls, light, _probability = sample_light(scene, at.x, numbers(r4, k))
                    event = next_event(at, ls, light)
                    if not visibility.occluded(scene, event.o, event.d, event.t_max):
                        w = (weight * event.weight) * wp.cw_mul(a_n, ls.radiance)
                        a, d = partial(at, LOBE_SMOOTH, enter_frame(at.frame, event.wi), w, direction)
                        a_material = add_materials(a_material, a)
                        found += d
        return a_material, found

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def branches(
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
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        t = wp.zeros(shape=(wp.static(candidates),), dtype=wp.float32)
        first_number = hashed(salted(sampler_at(pixel.number, 0, job.seed), SALT, 0), VERTEX_SLOT - 1).x >> wp.uint32(8)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            branch = salted(sampler, SALT, 0)
            state, _sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            point = branch_point(scene, sampler, branch, state, delta, job.max_depth, job.rr_depth)
            if point.face < 0:
                continue
            surface = interaction.surface(scene, point.face, point.u, point.v)
            at = interaction.on(scene, surface, point.face, point.u, point.v, point.state.d)
            count = shape_count(scene, at.slots)
            if count == 0:
                continue
            u = sample_4d(branch, CHOICE_SLOT)
            # In turn, from a random one on: what differs between numbers is no noise of the choice.
            number = (wp.int32(first_number % wp.uint32(count)) + job.first_sample + i) % count
            direction = shape_direction(scene, target, at.slots, point.face, point.u, point.v, surface.uv, number)
            a_n = (point.weight * wp.float32(count)) * wp.cw_mul(delta, point.state.throughput)
            moved, moves = moved_shape(at.material, direction)
            if not moves:
                continue
            a_material, found = from_directions(
                scene, branch, at, point, direction, moved, a_n, wp.vec2(u[0], u[1]), job.max_depth, job.rr_depth, t
            )
            if has_smooth(at.model):
                a_lights, found_lights = from_lights(scene, branch, at, direction, moved, a_n, wp.vec2(u[2], u[3]), t)
                a_material = add_materials(a_material, a_lights)
                found += found_lights
            valid = finite(found)
            if wp.static(forward):
                if valid:
                    derivative += wp.vec3d(found)
            else:
                if valid:
                    a_material = along_shape(a_material, direction)
                    _adjoint, dropped = accumulate_material(
                        scene, target, at.slots, point.face, point.u, point.v, surface.uv, a_material, VertexAdjoint()
                    )
                    valid = dropped == 0.0
            if not valid:
                count_invalid(scene, sampler)
        if wp.static(forward):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return branches
