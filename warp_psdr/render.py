"""Drivers: primal image, reverse mode, forward mode, and the tape."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.boundary import drivers as boundary_drivers
from warp_psdr.chain import derived_ranges, pull_derived, push_derived
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

    Returns:
        ``wp.array2d`` of vec3, shape (H, W) of the crop window: radiance in W/m^2/sr, averaged under the pixel filter.

    Raises:
        ValueError: an option out of range; with a tape: parameters are missing, or what is requested moves a
            discontinuity that the method of the boundary term does not cover.
    """
    integrator = integrator or from_description(scene.description.integrator)
    spp, seed = _sample_count(scene, sensor, spp), _seed(seed)
    plan = make_plan(scene, integrator=integrator, sensor=sensor)
    gradient_spp = _samples("spp_grad", spp_grad if spp_grad is not None else spp)
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
    draw = _render_splatted if plan.config.filter != RFILTER_BOX else _render_boxed
    draw(scene, plan, sensor, spp, mix_seed(seed, STREAM_PRIMAL), image, progress)
    if tape is not None and params is not None:
        _record(tape, image, scene, params, sensor=sensor, integrator=integrator, spp=gradient_spp, seed=seed)
    return image


def _record(tape: wp.Tape, image: wp.array, scene: Scene, params: Parameters, **options) -> None:
    def backward() -> None:
        render_backward(scene, params, image.grad, **options)

    tape.record_func(backward, [image, *(params[name] for name in params.requested)])


def _render_boxed(scene: Scene, plan: Plan, sensor: int, spp: int, seed: int, image: wp.array, progress) -> None:
    """A sample belongs to the pixel that it falls into."""
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
    )


def _render_splatted(scene: Scene, plan: Plan, sensor: int, spp: int, seed: int, image: wp.array, progress) -> None:
    """A sample counts for every pixel whose filter reaches it."""
    camera = scene.camera(sensor)
    margin = math.ceil(camera.filter_radius - 0.5)
    lanes = workers.lane_count(4 * image.size) if scene.device.is_cpu else 1
    films = wp.zeros((lanes, *image.shape), dtype=wp.vec4, device=scene.device)
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
    )
    launch(resolve, dim=image.shape, inputs=[films], outputs=[image], device=scene.device)


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
) -> None:
    """Add the gradient of ``sum(adjoint * image)`` to ``params[name].grad`` of every requested parameter.

    Args:
        scene: a loaded scene.
        params: its parameters, after ``requires_grad``.
        adjoint: derivative of a loss with respect to the image, NumPy (H, W, 3) or Warp (H, W) of vec3.
        sensor: which camera.
        integrator: default: what the scene file names.
        spp: samples a pixel; default: the sensor's sample count.
        seed: equal seeds give equal bits.
        progress: called with the finished fraction.

    Raises:
        ValueError: nothing is requested, a wrong adjoint, an option out of range, or a moving discontinuity that
            the method of the boundary term does not cover.
    """
    integrator = integrator or from_description(scene.description.integrator)
    names = params.requested
    if not names:
        raise ValueError("nothing to differentiate: call params.requires_grad(...) with parameter names first")
    spp, seed = _sample_count(scene, sensor, spp), _seed(seed)
    plan = make_plan(scene, params, integrator=integrator, sensor=sensor)
    camera = scene.camera(sensor)
    adjoint = _adjoint(adjoint, camera, scene.device)
    size = scene.values.shape[0]
    lanes = workers.lane_count(size) if scene.device.is_cpu else 1
    buffers = wp.zeros((lanes, size), dtype=wp.float32, device=scene.device)
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
        lanes=lanes,
        progress=progress,
    )  # fmt: skip
    if plan.boundary is not None:
        seed = mix_seed(seed, STREAM_BOUNDARY)
        boundary_drivers.backward(scene, plan, names, adjoint, buffers, sensor=sensor, spp=spp, seed=seed)
    _accumulate(scene, params, names, buffers)


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

    Returns:
        ``wp.array2d`` of vec3, shape (H, W): d image / d t for parameters + t * tangents.

    Raises:
        ValueError: no or wrong tangents, an option out of range, or a moving discontinuity that the method of the
            boundary term does not cover.
    """
    integrator = integrator or from_description(scene.description.integrator)
    if not tangents:
        raise ValueError("render_forward needs at least one tangent: {'parameter name': direction}")
    spp, seed = _sample_count(scene, sensor, spp), _seed(seed)
    names = list(tangents)
    flat = np.zeros(scene.values.shape[0], np.float32)
    for name, tangent in tangents.items():
        values = params.check(name, tangent, "tangent")
        p = scene.parameters[name]
        flat[p.offset : p.offset + p.size] = values.reshape(-1)
    plan = make_plan(scene, integrator=integrator, sensor=sensor, names=names)
    camera = scene.camera(sensor)
    target = wp.array(flat, dtype=wp.float32, device=scene.device)
    push_derived(scene, names, target)
    image = wp.zeros((camera.crop_height, camera.crop_width), dtype=wp.vec3, device=scene.device)
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
    )  # fmt: skip
    if plan.boundary is not None:
        seed = mix_seed(seed, STREAM_BOUNDARY)
        boundary_drivers.forward(scene, plan, names, target, image, sensor=sensor, spp=spp, seed=seed)
    return image


def _accumulate(scene: Scene, params: Parameters, names: list[str], buffers: wp.array) -> None:
    """Sum the lanes, pull the sums back to poses and positions, and add them to the users' gradients."""
    total = wp.zeros(scene.values.shape[0], dtype=wp.float32, device=scene.device)
    ranges = [(scene.parameters[n].offset, scene.parameters[n].size) for n in names]
    for offset, size in dict.fromkeys(ranges + derived_ranges(scene, names)):
        launch(add_lanes, dim=size, inputs=[buffers, offset], outputs=[total], device=scene.device)
    pull_derived(scene, names, total)
    for name in names:
        p = scene.parameters[name]
        grad = params[name].grad
        flat = wp.array(ptr=grad.ptr, dtype=wp.float32, shape=(p.size,), device=scene.device, copy=False)
        launch(add_range, dim=p.size, inputs=[total, p.offset], outputs=[flat], device=scene.device)


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
    scene: Scene, kernel: wp.Kernel, raster: tuple[int, int], arguments, *, lanes: int, progress: Progress | None
) -> None:
    """Run a kernel over a raster (width, height): in one launch on CUDA, in lanes on worker threads on the CPU."""
    data = scene.data()
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


def _sample_count(scene: Scene, sensor: int, spp: int | None) -> int:
    scene.camera(sensor)  # says so where there is no such sensor
    return _samples("spp", scene.description.sensors[sensor].sample_count if spp is None else spp)


def _seed(value) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
        raise ValueError(f"seed: got {value!r}, expected a non-negative integer")
    return int(value)


def _samples(name: str, value) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name}: got {value!r}, expected a positive integer (samples a pixel)")
    return int(value)


def _adjoint(adjoint, camera, device) -> wp.array:
    shape = (camera.crop_height, camera.crop_width)
    if isinstance(adjoint, wp.array) and adjoint.dtype is wp.vec3:
        if adjoint.shape != shape:
            raise ValueError(f"adjoint: got shape {adjoint.shape} of vec3, expected the image's {shape}")
        return adjoint if adjoint.device == device else adjoint.to(device)
    array = np.asarray(adjoint.numpy() if isinstance(adjoint, wp.array) else adjoint, dtype=np.float32)
    if array.shape != (*shape, 3):
        raise ValueError(f"adjoint: got shape {array.shape}, expected the image's {(*shape, 3)}")
    if not np.isfinite(array).all():
        raise ValueError("adjoint: holds NaN or infinite numbers; check the loss and the target image")
    return wp.array(np.ascontiguousarray(array), dtype=wp.vec3, device=device)
