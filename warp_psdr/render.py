"""Drivers: primal image, reverse mode, forward mode, and the tape."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.arguments import adjoint_array, checked_seed, flat_tangents, sample_count, samples
from warp_psdr.boundary import contacts
from warp_psdr.boundary import drivers as boundary_drivers
from warp_psdr.chain import derived_ranges, pull_derived
from warp_psdr.device import launch
from warp_psdr.kernels.constants import RFILTER_BOX
from warp_psdr.kernels.interior.forward import make_forward_kernel
from warp_psdr.kernels.interior.replay import make_replay_kernel
from warp_psdr.kernels.interior.textbook import make_textbook_kernel
from warp_psdr.kernels.path import make_primal_kernel
from warp_psdr.kernels.reduction import add_lanes, add_range
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.kernels.splat import make_splat_kernel, resolve
from warp_psdr.options import PathIntegrator, from_description
from warp_psdr.plan import Plan
from warp_psdr.plan import plan as make_plan

if TYPE_CHECKING:
    from warp_psdr.parameters import Parameters
    from warp_psdr.scene.scene import Scene
    from warp_psdr.work_precision.budget import Reached, Wanted
    from warp_psdr.work_precision.quantity import Quantity
    from warp_psdr.work_precision.report import Report

#: Random-number streams: the primal image, the interior and the boundary term are independent of each other.
STREAM_PRIMAL, STREAM_INTERIOR, STREAM_BOUNDARY = 0, 1, 2
Progress = Callable[[float], None]


def render(
    scene: Scene,
    params: Parameters | None = None,
    *,
    sensor: int = 0,
    integrator: PathIntegrator | None = None,
    spp: int | None = None,
    spp_grad: int | None = None,
    seed: int = 0,
    tape: wp.Tape | None = None,
    progress: Progress | None = None,
    target_error: float | None = None,
    time_budget: float | None = None,
    report: Report | None = None,
    reached: Callable[[Reached], None] | None = None,
) -> wp.array:
    """Render an image.

    Args:
        scene: a loaded scene.
        params: its parameters; needed with a tape only.
        sensor: which camera.
        integrator: default: what the scene file names, else ``PathIntegrator()``.
        spp: samples a pixel; default: the sensor's sample count.
        spp_grad: samples a pixel of the backward pass; default: ``spp``.
        seed: equal seeds give equal bits; the backward pass is decorrelated from the image.
        tape: a Warp tape to record the rendering on: ``tape.backward(loss)`` then adds to the gradients of the
            parameters that ``params.requires_grad`` named.
        progress: called with the finished fraction.
        target_error: instead of ``spp``: the relative error (of the whole image, in the mean square) to be reached.
        time_budget: instead of ``spp``: seconds to be spent, after compiling.
        report: of ``psdr.accuracy`` for this call; a budget without one runs a pilot of its own.
        reached: called with what a budget bought (``work_precision.Reached``), for example ``print``.

    Returns:
        ``wp.array2d`` of vec3, shape (H, W) of the crop window: radiance in W/m^2/sr, averaged under the pixel filter.

    Raises:
        ValueError: an option out of range, or two that exclude each other; with a tape: parameters are missing, or
            what is requested moves a discontinuity that the method of the boundary term does not cover.
    """
    from warp_psdr.work_precision import budget, quantity

    if budget.check(spp, target_error, time_budget, report):
        if tape is not None:
            raise ValueError(
                "tape: a recorded image takes spp; render with the budget, then call "
                "render_backward(..., target_error=...) with the loss's adjoint"
            )
        scene.camera(sensor)
        what = quantity.image(scene, integrator=integrator, sensor=sensor)
        wanted = budget.Wanted(target_error, time_budget, report)
        return _budgeted(what, wanted, seed, progress, reached)
    integrator = integrator or from_description(scene.description.integrator)
    spp, seed = sample_count(scene, sensor, spp), checked_seed(seed)
    plan = make_plan(scene, integrator=integrator, sensor=sensor)
    gradient_spp = samples("spp_grad", spp_grad if spp_grad is not None else spp)
    if tape is not None:
        if params is None or not params.requested:
            raise ValueError("render(tape=...) differentiates what params.requires_grad(...) names; pass such params")
        make_plan(
            scene, params, integrator=integrator, sensor=sensor
        )  # says what cannot be differentiated, before the work
    camera = scene.camera(sensor)
    image = wp.zeros(
        (camera.crop_height, camera.crop_width), dtype=wp.vec3, device=scene.device, requires_grad=tape is not None
    )
    draw = _render_splatted if plan.config.filter != RFILTER_BOX else boxed
    draw(scene, plan, sensor, spp, mix_seed(seed, STREAM_PRIMAL), image, progress)
    if tape is not None and params is not None:
        _record(tape, image, scene, params, sensor=sensor, integrator=integrator, spp=gradient_spp, seed=seed)
    return image


def _budgeted(what: Quantity, wanted: Wanted, seed: int, progress, reached) -> wp.array:
    """Return an image that was estimated within a budget."""
    from warp_psdr.work_precision.budget import spend

    values, bought = spend(what, wanted, seed=seed, progress=progress)
    if reached is not None:
        reached(bought)
    camera = what.scene.camera(what.sensor)
    pixels = values.reshape(camera.crop_height, camera.crop_width, 3).astype(np.float32)
    return wp.array(pixels, dtype=wp.vec3, device=what.scene.device)


def _record(tape: wp.Tape, image: wp.array, scene: Scene, params: Parameters, **options) -> None:
    def backward() -> None:
        render_backward(scene, params, image.grad, **options)

    tape.record_func(backward, [image, *(params[name] for name in params.requested)])


def boxed(
    scene: Scene,
    plan: Plan,
    sensor: int,
    spp: int,
    seed: int,
    image: wp.array,
    progress: Progress | None = None,
    pixels: wp.array | None = None,
) -> None:
    """Add the mean of ``spp`` samples to every pixel, or to those listed; a sample counts in its own pixel."""
    camera = scene.camera(sensor)
    _launch(
        scene,
        make_primal_kernel(plan.config),
        (camera.crop_width, camera.crop_height),
        lambda data, first, count, pixels, lane: (
            [data, camera, pixels, first, 0, spp, 1.0 / spp, seed, plan.max_depth, plan.rr_depth],
            [image],
        ),
        lanes=workers.LANES,
        progress=progress,
        listed=pixels,
    )


def _render_splatted(scene: Scene, plan: Plan, sensor: int, spp: int, seed: int, image: wp.array, progress) -> None:
    """A sample counts for every pixel whose filter reaches it."""
    films = splatted(scene, plan, sensor, spp, seed, progress)
    launch(resolve, dim=image.shape, inputs=[films], outputs=[image], device=scene.device)


def splatted(
    scene: Scene,
    plan: Plan,
    sensor: int,
    spp: int,
    seed: int,
    progress: Progress | None = None,
    pixels: wp.array | None = None,
) -> wp.array:
    """Return the lanes' films, (lanes, H, W) of vec4: sums of weighted radiance and of weights (``kernels/splat.py``).

    ``pixels`` lists pixels of the raster that is extended by the filter's reach, ``filter_margin``.
    """
    camera = scene.camera(sensor)
    margin = filter_margin(camera)
    size = camera.crop_height * camera.crop_width
    lanes = workers.lane_count(4 * size) if scene.device.is_cpu else 1
    films = wp.zeros((lanes, camera.crop_height, camera.crop_width), dtype=wp.vec4, device=scene.device)
    _launch(
        scene,
        make_splat_kernel(plan.config),
        (camera.crop_width + 2 * margin, camera.crop_height + 2 * margin),
        lambda data, first, count, pixels, lane: (
            [data, camera, pixels, first, margin, spp, seed, plan.max_depth, plan.rr_depth],
            [films[lane]],
        ),
        lanes=lanes,
        progress=progress,
        listed=pixels,
    )
    return films


def filter_margin(camera) -> int:
    """Return how many pixels beyond the film's border a sample can lie that counts for it."""
    return math.ceil(camera.filter_radius - 0.5)


def render_backward(
    scene: Scene,
    params: Parameters,
    adjoint,
    *,
    sensor: int = 0,
    integrator: PathIntegrator | None = None,
    spp: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    target_error: float | None = None,
    time_budget: float | None = None,
    report: Report | None = None,
) -> Reached | None:
    """Add the gradient of ``sum(adjoint * image)`` to ``params[name].grad`` of every requested parameter.

    Args:
        scene: a loaded scene.
        params: its parameters, after ``requires_grad``.
        adjoint: derivative of a loss with respect to the image, NumPy (H, W, 3) or Warp (H, W) of vec3.
        sensor: which camera.
        integrator: default: what the scene file names.
        spp: samples a pixel; default: the sensor's sample count.
        seed: equal seeds give equal bits; with a budget if a report is given and no time.
        progress: called with the finished fraction.
        target_error: instead of ``spp``: the relative error of the gradient to be reached, the root mean square over
            the parameters. Samples are split over the terms, and over the image, by what they gain for their time.
        time_budget: instead of ``spp``: seconds to be spent, after compiling.
        report: of ``psdr.accuracy`` for this call, or one like it; a budget without one runs a pilot of its own.

    Returns:
        What a budget bought; None without one.

    Raises:
        ValueError: nothing is requested, options that exclude each other, a wrong adjoint, an option out of range,
            or a moving discontinuity that the method of the boundary term does not cover.
    """
    from warp_psdr.work_precision import budget, quantity

    if budget.check(spp, target_error, time_budget, report):
        what = quantity.gradient(scene, params, adjoint, integrator=integrator, sensor=sensor)
        wanted = budget.Wanted(target_error, time_budget, report)
        values, bought = budget.spend(what, wanted, seed=seed, progress=progress)
        for name, block in what.blocks.items():
            total = wp.array(values[block].astype(np.float32), dtype=wp.float32, device=scene.device)
            _add(scene, params, name, total, 0)
        return bought
    integrator = integrator or from_description(scene.description.integrator)
    names = params.requested
    if not names:
        raise ValueError("nothing to differentiate: call params.requires_grad(...) with parameter names first")
    spp, seed = sample_count(scene, sensor, spp), checked_seed(seed)
    plan = make_plan(scene, params, integrator=integrator, sensor=sensor)
    adjoint = adjoint_array(adjoint, scene.camera(sensor), scene.device)
    buffers = gradient_buffers(scene)
    interior_backward(scene, plan, sensor, spp, seed, adjoint, buffers, progress)
    if plan.boundary is not None:
        seed = mix_seed(seed, STREAM_BOUNDARY)
        boundary_drivers.backward(scene, plan, names, adjoint, buffers, sensor=sensor, spp=spp, seed=seed)
    total = gradient(scene, names, buffers)
    for name in names:
        _add(scene, params, name, total, scene.parameters[name].offset)
    return None


def _add(scene: Scene, params: Parameters, name: str, total: wp.array, offset: int) -> None:
    """Add a stretch of a flat gradient to a parameter's own."""
    size, grad = scene.parameters[name].size, params[name].grad
    flat = wp.array(ptr=grad.ptr, dtype=wp.float32, shape=(size,), device=scene.device, copy=False)
    launch(add_range, dim=size, inputs=[total, offset], outputs=[flat], device=scene.device)


def interior_backward(
    scene: Scene,
    plan: Plan,
    sensor: int,
    spp: int,
    seed: int,
    adjoint: wp.array,
    buffers: wp.array,
    progress: Progress | None = None,
    pixels: wp.array | None = None,
) -> None:
    """Add the gradient of the interior term, of all pixels or of those listed, to the lanes' flat buffers."""
    camera = scene.camera(sensor)
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    _launch(
        scene,
        _gradient_kernel(plan, "reverse"),
        (camera.crop_width, camera.crop_height),
        lambda data, first, count, pixels, lane: (
            [
                data, camera, pixels, first, 0, spp, 1.0 / spp, mix_seed(seed, STREAM_INTERIOR),
                _depth(plan), plan.rr_depth, adjoint,
            ],
            [buffers[lane], dummy],
        ),
        lanes=buffers.shape[0],
        progress=progress,
        listed=pixels,
    )  # fmt: skip


def gradient_buffers(scene: Scene) -> wp.array:
    """Return zeros, (lanes, values): a flat gradient for every lane of a launch."""
    size = scene.values.shape[0]
    lanes = workers.lane_count(size) if scene.device.is_cpu else 1
    return wp.zeros((lanes, size), dtype=wp.float32, device=scene.device)


def render_forward(
    scene: Scene,
    params: Parameters,
    tangents: dict,
    *,
    sensor: int = 0,
    integrator: PathIntegrator | None = None,
    spp: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    target_error: float | None = None,
    time_budget: float | None = None,
    report: Report | None = None,
    reached: Callable[[Reached], None] | None = None,
) -> wp.array:
    """Render the derivative of the image along a direction of parameter space.

    Args:
        scene: a loaded scene.
        params: its parameters; ``requires_grad`` is not needed here.
        tangents: name -> direction, NumPy or Warp, in the parameter's shape; a number fills it.
        sensor: which camera.
        integrator: default: what the scene file names.
        spp: samples a pixel; default: the sensor's sample count.
        seed: equal seeds give equal bits, and the random numbers of ``render_backward``.
        progress: called with the finished fraction.
        target_error: instead of ``spp``: the relative error of the derivative image to be reached.
        time_budget: instead of ``spp``: seconds to be spent, after compiling.
        report: of ``psdr.accuracy`` for this call; a budget without one runs a pilot of its own.
        reached: called with what a budget bought (``work_precision.Reached``), for example ``print``.

    Returns:
        ``wp.array2d`` of vec3, shape (H, W): d image / d t for parameters + t * tangents.

    Raises:
        ValueError: no or wrong tangents, an option out of range or two that exclude each other, a moving discontinuity
            that the method of the boundary term does not cover, or surfaces that touch and are moved apart or into
            each other.
    """
    from warp_psdr.work_precision import budget, quantity

    if budget.check(spp, target_error, time_budget, report):
        what = quantity.derivative(scene, params, tangents, integrator=integrator, sensor=sensor)
        wanted = budget.Wanted(target_error, time_budget, report)
        return _budgeted(what, wanted, seed, progress, reached)
    integrator = integrator or from_description(scene.description.integrator)
    if not tangents:
        raise ValueError("render_forward needs at least one tangent: {'parameter name': direction}")
    spp, seed = sample_count(scene, sensor, spp), checked_seed(seed)
    names = list(tangents)
    target = flat_tangents(scene, params, tangents)
    plan = make_plan(scene, integrator=integrator, sensor=sensor, names=names)
    camera = scene.camera(sensor)
    if plan.boundary is not None:
        contacts.check(scene, target.numpy())
    image = wp.zeros((camera.crop_height, camera.crop_width), dtype=wp.vec3, device=scene.device)
    interior_forward(scene, plan, sensor, spp, seed, target, image, progress)
    if plan.boundary is not None:
        seed = mix_seed(seed, STREAM_BOUNDARY)
        boundary_drivers.forward(scene, plan, names, target, image, sensor=sensor, spp=spp, seed=seed)
    return image


def interior_forward(
    scene: Scene,
    plan: Plan,
    sensor: int,
    spp: int,
    seed: int,
    target: wp.array,
    image: wp.array,
    progress: Progress | None = None,
    pixels: wp.array | None = None,
) -> None:
    """Add the derivative of the interior term along flat tangents to all pixels, or to those listed."""
    camera = scene.camera(sensor)
    dummy = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
    _launch(
        scene,
        _gradient_kernel(plan, "forward"),
        (camera.crop_width, camera.crop_height),
        lambda data, first, count, pixels, lane: (
            [
                data, camera, pixels, first, 0, spp, 1.0 / spp, mix_seed(seed, STREAM_INTERIOR),
                _depth(plan), plan.rr_depth, dummy,
            ],
            [target, image],
        ),
        lanes=workers.LANES,
        progress=progress,
        listed=pixels,
    )  # fmt: skip


def gradient(scene: Scene, names: list[str], buffers: wp.array) -> wp.array:
    """Sum the lanes and pull the sums back to poses and positions: the flat gradient of the named parameters."""
    total = wp.zeros(scene.values.shape[0], dtype=wp.float32, device=scene.device)
    ranges = [(scene.parameters[n].offset, scene.parameters[n].size) for n in names]
    for offset, size in dict.fromkeys(ranges + derived_ranges(scene, names)):
        launch(add_lanes, dim=size, inputs=[buffers, offset], outputs=[total], device=scene.device)
    pull_derived(scene, names, total)
    return total


def _gradient_kernel(plan: Plan, role: str) -> wp.Kernel:
    if plan.block == 0:
        return make_textbook_kernel(plan.config, plan.wanted, role)
    if role == "forward":
        return make_forward_kernel(plan.config, plan.wanted)
    return make_replay_kernel(plan.config, plan.wanted, plan.block, plan.blocks)


def _depth(plan: Plan) -> int:
    """Depth limit of a differential pass: its records have to hold the path."""
    if plan.block == 0 or plan.max_depth > 0:
        return plan.max_depth
    return plan.block * plan.blocks


def _launch(
    scene: Scene,
    kernel: wp.Kernel,
    raster: tuple[int, int],
    arguments,
    *,
    lanes: int,
    progress: Progress | None,
    listed: wp.array | None = None,
) -> None:
    """Run a kernel over a raster (width, height): in one launch on CUDA, in lanes on worker threads on the CPU.

    ``listed``: numbers of its pixels, instead of all of them.
    """
    data = scene.data()
    order = listed
    if order is None:
        order = wp.array(workers.pixel_order(*raster), dtype=wp.int32, device=scene.device)
    count = order.shape[0]
    wp.load_module(kernel.module, device=scene.device)  # compile once, before the threads start
    if not scene.device.is_cpu:
        inputs, outputs = arguments(data, 0, count, order, 0)
        launch(kernel, dim=count, inputs=inputs, outputs=outputs, device=scene.device)
        return
    parts = workers.chunks(count, lanes)
    done, lock = 0, threading.Lock()

    def lane(i: int) -> None:
        nonlocal done
        for first, n in parts[i]:
            inputs, outputs = arguments(data, first, n, order, i)
            launch(kernel, dim=n, inputs=inputs, outputs=outputs, device=scene.device)
            if progress is not None:
                with lock:
                    done += n
                    progress(done / count)

    workers.run_lanes(lane, lanes)
