"""Drivers: primal image, reverse mode, forward mode, and the tape."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import warp as wp

from warp_psdr import compiler
from warp_psdr.device import active_tape
from warp_psdr.estimate import light
from warp_psdr.estimate.arguments import (
    adjoint_array,
    checked_seed,
    draw_of,
    flat,
    flat_tangents,
    refuse_budget,
    requested,
    sample_count,
)
from warp_psdr.estimate.arguments import samples as checked_samples
from warp_psdr.estimate.batches import add_in_batches, count_in_batches
from warp_psdr.estimate.calls import ImageCall, derivative
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.films import Rectangle, film
from warp_psdr.estimate.gradient_sums import GradientSums, add_to_gradient
from warp_psdr.estimate.passes import Progress
from warp_psdr.estimate.views import assembled, count_of_views, each, of_one, require_range, shape_of_views
from warp_psdr.film import Film
from warp_psdr.image import Image
from warp_psdr.invalid import warns
from warp_psdr.options.integrator import Integrator, PathIntegrator
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.plan.plan import decide
from warp_psdr.plan.transient import shape_of
from warp_psdr.scene.description import Sensor
from warp_psdr.scene.frames import frames_of, held_at
from warp_psdr.scene.loaded import check_loaded
from warp_psdr.scene.parameters import check_owner
from warp_psdr.topology import contacts

if TYPE_CHECKING:
    from warp_psdr.accuracy.budget import Budget, Reached
    from warp_psdr.accuracy.quantity import Quantity
    from warp_psdr.accuracy.report import Report
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene


@overload
def render(
    scene: Scene,
    params: Parameters | None = None,
    *,
    sensor: Sensor = 0,
    integrator: Integrator | None = None,
    spp: int | None = None,
    spp_grad: int | None = None,
    samples: None = None,
    seed: int = 0,
    tape: wp.Tape | None = None,
    progress: Progress | None = None,
    target_error: float | None = None,
    time_budget: float | None = None,
    report: Report | None = None,
    reached: Callable[[Reached], None] | None = None,
) -> Image: ...


@overload
def render(
    scene: Scene,
    params: Parameters | None = None,
    *,
    sensor: Sensor = 0,
    integrator: Integrator | None = None,
    spp: int | None = None,
    samples: tuple[int, int],
    pixels: list[Rectangle] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Film: ...


@warns
def render(
    scene: Scene,
    params: Parameters | None = None,
    *,
    sensor: Sensor = 0,
    integrator: Integrator | None = None,
    spp: int | None = None,
    spp_grad: int | None = None,
    samples: tuple[int, int] | None = None,
    pixels: list[Rectangle] | None = None,
    seed: int = 0,
    tape: wp.Tape | None = None,
    progress: Progress | None = None,
    target_error: float | None = None,
    time_budget: float | None = None,
    report: Report | None = None,
    reached: Callable[[Reached], None] | None = None,
) -> Image | Film:
    """Render an image, or the film of some of its samples.

    Args:
        scene: a loaded scene.
        params: its parameters; needed with a tape only.
        sensor: which camera, by its number or its id; of a ``batch`` all its cameras; several in a list.
        integrator: a ``PathIntegrator``, or Mitsuba's dictionary (``{"type": "path", "max_depth": 4}``) or plugin name;
            default: what the scene file names, else ``PathIntegrator()``.
        spp: samples a pixel; default: the sensor's sample count.
        spp_grad: samples a pixel of the backward pass; default: ``spp``.
        samples: (a, b): draw the samples with the numbers a ... b - 1 of every pixel, 0 <= a < b, and return their
            ``psdr.Film``. The numbers go on without end, and sample n of a pixel is the same for any range and ``spp``,
            which is therefore not needed, and b may exceed it. Films of (0, n) and (n, m) add up to that of (0, m),
            whose image is that of ``spp=m``. Not with a tape or a budget, and before one sensor.
        pixels: with ``samples``: rectangles [(x0, y0, x1, y1), ...] in the crop window, columns x0 ... x1 - 1 and rows
            y0 ... y1 - 1. Only what counts there is drawn, with the values of the whole film; the film is empty
            elsewhere. Not where paths start at the lights.
        seed: equal seeds give equal bits, with a budget only where a report is given and no time; the backward pass is
            decorrelated from the image.
        tape: a Warp tape to record the rendering on: ``tape.backward(loss)`` then adds to the gradients of the
            parameters that ``params.requires_grad`` named. In a tape's ``with`` block that tape, if ``params`` has
            such parameters.
        progress: called with the finished fraction.
        target_error: instead of ``spp``: the relative error (of the whole image, in the mean square) to be reached.
        time_budget: instead of ``spp``: seconds to be spent, after compiling.
        report: of ``psdr.accuracy`` for this call; a budget without one runs a pilot of its own.
        reached: called with what a budget bought (``accuracy.Reached``), for example ``print``.

    Returns:
        ``wp.array2d`` of vec3, shape (H, W) of the crop window: radiance in W/m^2/sr, averaged under the pixel filter
            (``psdr.Image``, which notebooks show). Of a list of sensors (B, H, W), of a ``batch`` side by side. Of a
            ``transient_hdr_film``: (H, W, bins), the radiance of light that arrives within each bin, whose sum is the
            image of light of all those lengths. With ``samples``: a ``psdr.Film``.

    Raises:
        ValueError: an option out of range, or two that exclude each other; with a tape: parameters are missing, or
            what is requested moves a discontinuity that the method of the boundary term does not cover.
    """
    from warp_psdr.accuracy import budget, quantity
    from warp_psdr.accuracy import views as quantities

    try:
        check_loaded(scene)
    except ValueError as error:
        told = tape or active_tape()
        if told is not None:
            error.add_note(f"This is rendering number {frames_of(told, scene).count + 1} of the scene on its tape.")
        raise
    views = scene.description.views(sensor)
    if params is not None:
        check_owner(scene, params)
    if tape is None and params is not None and params.requested:
        tape = active_tape()
    if pixels is not None and samples is None:
        raise ValueError("pixels: rectangles of a film of samples=(a, b); give these, for example samples=(0, spp)")
    if samples is not None:
        refuse_budget("samples", target_error=target_error, time_budget=time_budget, report=report)
        if tape is not None:
            raise ValueError(
                "samples: a film is not recorded on a tape; leave samples out, or call "
                "render_backward(..., samples=(a, b)) with the loss's adjoint"
            )
        if spp is not None:
            checked_samples("spp", spp)
        return film(scene, views, integrator_of(scene, integrator), samples, pixels, checked_seed(seed), progress)
    if budget.check(spp, target_error, time_budget, report):
        if tape is not None:
            raise ValueError(
                "tape: a recorded image takes spp; render with the budget, then call "
                "render_backward(..., target_error=...) with the loss's adjoint"
            )
        what = quantities.together(views, lambda n: quantity.image(scene, integrator=integrator, sensor=n))
        wanted = budget.Budget(target_error, time_budget, report)
        return _budgeted(what, wanted, seed, progress, reached)
    integrator, seed = integrator_of(scene, integrator), checked_seed(seed)
    if tape is not None and (params is None or not params.requested):
        raise ValueError("render(tape=...) differentiates what params.requires_grad(...) names; pass such params")
    if views.several:
        spp = count_of_views(scene, views, spp)
        gradient_spp = checked_samples("spp_grad", spp_grad) if spp_grad is not None else spp
        for number in views.sensors if tape is not None else ():
            decide(scene, params, integrator=integrator, sensor=number)

        def alone(number: int, told: Progress | None) -> Image:
            return render(scene, sensor=number, integrator=integrator, spp=spp, seed=seed, progress=told)

        image = assembled(scene, views, alone, progress, requires_grad=tape is not None)
        if tape is not None and params is not None:
            _record(tape, image, scene, params, sensor=sensor, integrator=integrator, spp=gradient_spp, seed=seed)
        return image
    sensor = views.sensors[0]
    spp = sample_count(scene, sensor, spp)
    gradient_spp = checked_samples("spp_grad", spp_grad if spp_grad is not None else spp)
    call = ImageCall(scene, decide(scene, integrator=integrator, sensor=sensor), sensor, seed)
    if tape is not None:
        # Says what cannot be differentiated, before the work.
        differentiated = decide(scene, params, integrator=integrator, sensor=sensor)
        compiler.begin([*call.kernels(), *light.gradient_kernels(differentiated, "reverse")], scene.device)
    image = call.finish(call.draw(Draw(spp), progress), requires_grad=tape is not None)
    if tape is not None and params is not None:
        _record(tape, image, scene, params, sensor=sensor, integrator=integrator, spp=gradient_spp, seed=seed)
    return image


def _budgeted(what: Quantity, wanted: Budget, seed: int, progress, reached) -> Image:
    """Return an image that was estimated within a budget."""
    from warp_psdr.accuracy.budget import spend

    values, bought = spend(what, wanted, seed=seed, progress=progress)
    if reached is not None:
        reached(bought)
    pixels = what.pixels(values)
    stack = what.views is not None and what.views.stacked
    image = Image(pixels.shape[:-1], what.scene.device, signed=what.role == "forward", stack=stack)
    image.assign(pixels.astype(np.float32))
    return image


def _record(tape: wp.Tape, image: wp.array, scene: Scene, params: Parameters, **options) -> None:
    """Let a tape add the gradient to the arrays that hold the parameters now, by the values that they hold now."""
    arrays = {name: params[name] for name in params.requested}
    frame = frames_of(tape, scene).take()

    def backward() -> None:
        for name, array in arrays.items():
            if array.grad is None:
                raise RuntimeError(
                    f"tape.backward: {name!r} was requested by render(tape=...) and has no gradient any more; call "
                    "tape.backward before requires_grad_only names others"
                )
        with held_at(scene, frame.state):
            _add_gradient(scene, arrays, image.grad, **options)

    tape.record_func(backward, [image, *arrays.values()])


@warns
def render_backward(
    scene: Scene,
    params: Parameters,
    adjoint,
    *,
    sensor: Sensor = 0,
    integrator: Integrator | None = None,
    spp: int | None = None,
    samples: tuple[int, int] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    target_error: float | None = None,
    time_budget: float | None = None,
    report: Report | None = None,
    errors: bool = False,
) -> Reached | None:
    """Add the gradient of ``sum(adjoint * image)`` to ``params[name].grad`` of every requested parameter.

    Args:
        scene: a loaded scene.
        params: its parameters, after ``requires_grad``.
        adjoint: derivative of a loss with respect to the image, NumPy (H, W, 3) or Warp (H, W) of vec3; (B, H, W, 3) or
            (B, H, W) of a list of sensors, and of a ``transient_hdr_film`` (H, W, bins, 3) or (H, W, bins) of vec3.
        sensor: which camera, by its number or its id; of a ``batch`` all its cameras; several in a list.
        integrator: as of ``render``; default: what the scene file names.
        spp: samples a pixel; default: the sensor's sample count.
        samples: (a, b), 0 <= a < b <= ``spp``: add the part of the gradient that the samples with the numbers a ...
            b - 1 of the ``spp`` bring, of the boundary term in proportion. The parts of ranges that partition
            (0, ``spp``) add up to the whole at the same values, seed and methods. One part alone is no estimate of it:
            its samples of the boundary term lie on some of the edges. Neither with a budget nor with guiding.
            There is no ``pixels`` here: give an adjoint that is zero in the other pixels, whose samples cost next to
            nothing.
        seed: equal calls in equal order give equal bits, and so do equal seeds and values unless a repeated gradient
            is guided (``PathIntegrator.boundary``); with a budget if a report is given and no time.
        progress: called with the finished fraction.
        target_error: instead of ``spp``: the relative error of the gradient to be reached, the root mean square over
            the parameters. Samples are split over the terms, and over the image, by what they gain for their time.
        time_budget: instead of ``spp``: seconds to be spent, after compiling.
        report: of ``psdr.accuracy`` for this call, or one like it; a budget without one runs a pilot of its own.
        errors: also tell how far random numbers may have moved each number: ``params[name].std`` becomes the standard
            deviation of ``params[name].grad``, in its shape; ``params.zero_grad()`` sets both to zero, and a gradient
            without ``errors`` that is added takes it away. The gradient is the mean of eight of ``spp`` / 8 samples
            each, so that bars have seven degrees of freedom (95 %: 2.4 times).

    Returns:
        What a budget bought; None without one.

    Raises:
        ValueError: nothing is requested, options that exclude each other, a wrong adjoint, an option out of range,
            a gradient without error bars that ``errors`` would add to, or a moving discontinuity that the method of the
            boundary term does not cover.
    """
    from warp_psdr.accuracy import budget
    from warp_psdr.accuracy import views as quantities

    check_loaded(scene)
    views = scene.description.views(sensor)
    for option, given in (("samples", samples is not None), ("errors", errors)):
        if given:
            refuse_budget(option, target_error=target_error, time_budget=time_budget, report=report)
    if budget.check(spp, target_error, time_budget, report):
        what = quantities.gradient(scene, views, params, adjoint, integrator=integrator)
        wanted = budget.Budget(target_error, time_budget, report)
        values, bought = budget.spend(what, wanted, seed=seed, progress=progress)
        for name, block in what.blocks.items():
            total = wp.array(values[block].astype(np.float32), dtype=wp.float32, device=scene.device)
            add_to_gradient(params[name], total, 0)
        return bought
    names, method = requested(scene, params), integrator_of(scene, integrator)

    def add(arrays: dict[str, wp.array], spp: int | None, seed: int, progress: Progress | None) -> None:
        options: dict[str, Any] = {"spp": spp, "samples": samples, "seed": seed, "progress": progress}
        _add_gradient(scene, arrays, adjoint, sensor=sensor, integrator=method, **options)

    if errors:
        if samples is not None:
            raise ValueError("render_backward: errors and samples exclude each other: a range is no estimate by itself")
        add_in_batches(params, names, add, count_in_batches(scene, views, spp), checked_seed(seed), progress)
    else:
        add({name: params[name] for name in names}, spp, checked_seed(seed), progress)
    return None


def _add_gradient(
    scene: Scene,
    arrays: Mapping[str, wp.array],
    adjoint,
    *,
    sensor: Sensor,
    integrator: PathIntegrator,
    spp: int | None,
    samples: tuple[int, int] | None = None,
    seed: int,
    progress: Progress | None = None,
) -> None:
    """Add to the gradients of the arrays that hold parameters, which are given by name; see ``render_backward``."""
    views, names = scene.description.views(sensor), list(arrays)
    if views.several:
        spp = count_of_views(scene, views, spp)
        require_range(scene, views, integrator, spp, samples)
        options: dict[str, Any] = {"integrator": integrator, "spp": spp, "samples": samples, "seed": seed}
        adjoints = adjoint_array(adjoint, shape_of_views(scene, views), scene.device).numpy()
        for number, place, told in each(scene, views, progress):
            own = of_one(scene, views, adjoints, place)
            _add_gradient(scene, arrays, own, sensor=number, progress=told, **options)
        return
    sensor = views.sensors[0]
    spp = sample_count(scene, sensor, spp)
    draw = draw_of(integrator, spp, samples)
    adjoint = flat(adjoint_array(adjoint, shape_of(scene, sensor), scene.device))
    plan = decide(scene, names=names, integrator=integrator, sensor=sensor)
    guide = integrator.boundary == "auto" and samples is None  # what guides changes from call to call
    call = derivative(scene, plan, names, "reverse", sensor, spp, seed, adjoint, guide=guide)
    sums = GradientSums(scene, names)
    call.add(draw, sums, progress)
    total = sums.result()
    for name, array in arrays.items():
        add_to_gradient(array, total, scene.parameters[name].offset)


@warns
def render_forward(
    scene: Scene,
    params: Parameters,
    tangents: dict,
    *,
    sensor: Sensor = 0,
    integrator: Integrator | None = None,
    spp: int | None = None,
    samples: tuple[int, int] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    target_error: float | None = None,
    time_budget: float | None = None,
    report: Report | None = None,
    reached: Callable[[Reached], None] | None = None,
) -> Image:
    """Render the derivative of the image along a direction of parameter space.

    Args:
        scene: a loaded scene.
        params: its parameters; ``requires_grad`` is not needed here.
        tangents: name -> direction, NumPy or Warp, in the parameter's shape; a number fills it. What a pose and the
            vertices that it moves bring add up, each with the other at rest, and so does what positions bring, whose
            computed normals follow, and what these normals bring themselves.
        sensor: which camera, by its number or its id; of a ``batch`` all its cameras; several in a list.
        integrator: as of ``render``; default: what the scene file names.
        spp: samples a pixel; default: the sensor's sample count.
        samples: (a, b), 0 <= a < b <= ``spp``: return the part of the derivative image that samples with the numbers
            a ... b - 1 of the ``spp`` bring, as of ``render_backward``. Neither with a budget nor with guiding.
        seed: equal seeds give equal bits, with a budget only where a report is given and no time, and the random
            numbers of ``render_backward``.
        progress: called with the finished fraction.
        target_error: instead of ``spp``: the relative error of the derivative image to be reached.
        time_budget: instead of ``spp``: seconds to be spent, after compiling.
        report: of ``psdr.accuracy`` for this call; a budget without one runs a pilot of its own.
        reached: called with what a budget bought (``accuracy.Reached``), for example ``print``.

    Returns:
        ``wp.array2d`` of vec3, shape (H, W): d image / d t for parameters + t * tangents; (B, H, W) of a list of
            sensors, (H, W, bins) of a ``transient_hdr_film``.

    Raises:
        ValueError: no or wrong tangents, an option out of range or two that exclude each other, or a moving
            discontinuity that the method of the boundary term does not cover.
    """
    from warp_psdr.accuracy import budget, quantity
    from warp_psdr.accuracy import views as quantities

    check_loaded(scene)
    views = scene.description.views(sensor)
    if samples is not None:
        refuse_budget("samples", target_error=target_error, time_budget=time_budget, report=report)
    if budget.check(spp, target_error, time_budget, report):
        what = quantities.together(
            views, lambda n: quantity.derivative(scene, params, tangents, integrator=integrator, sensor=n)
        )
        wanted = budget.Budget(target_error, time_budget, report)
        return _budgeted(what, wanted, seed, progress, reached)
    integrator = integrator_of(scene, integrator)
    if not tangents:
        raise ValueError("render_forward needs at least one tangent: {'parameter name': direction}")
    seed = checked_seed(seed)
    if views.several:
        spp = count_of_views(scene, views, spp)
        require_range(scene, views, integrator, spp, samples)

        def alone(number: int, told: Progress | None) -> Image:
            return render_forward(
                scene,
                params,
                tangents,
                sensor=number,
                integrator=integrator,
                spp=spp,
                samples=samples,
                seed=seed,
                progress=told,
            )

        return assembled(scene, views, alone, progress, signed=True)
    sensor = views.sensors[0]
    spp = sample_count(scene, sensor, spp)
    draw = draw_of(integrator, spp, samples)
    names = list(tangents)
    target = flat_tangents(scene, params, tangents)
    plan = decide(scene, integrator=integrator, sensor=sensor, names=names)
    if plan.boundary is not None:
        contacts.warn(scene, target.numpy())
    guide = integrator.boundary == "auto" and samples is None  # what guides changes from call to call
    call = derivative(scene, plan, names, "forward", sensor, spp, seed, target, guide=guide)
    return call.image(call.draw(draw, progress))
