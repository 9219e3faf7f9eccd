"""Checks of the drivers' arguments."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.estimate.draw import Draw
from warp_psdr.scene.derived_values import accumulate_derived
from warp_psdr.scene.parameters import check_owner

if TYPE_CHECKING:
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene


#: Sample numbers are 32-bit integers with a sign.
MOST_SAMPLES = (1 << 31) - 1


def sample_count(scene: Scene, sensor: int, spp: int | None) -> int:
    """Return the samples a pixel: those given, else the sensor's."""
    return samples("spp", scene.description.sensors[sensor].sample_count if spp is None else spp)


def checked_seed(value) -> int:
    """Return a seed as an int."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
        raise ValueError(f"seed: got {value!r}, expected a non-negative integer")
    return int(value)


def samples(name: str, value) -> int:
    """Return a number of samples a pixel as an int."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name}: got {value!r}, expected a positive integer (samples a pixel)")
    if value > MOST_SAMPLES:
        raise ValueError(f"{name}: got {value}, expected at most {MOST_SAMPLES}; average renderings of several seeds")
    return int(value)


def sample_range(value, spp: int | None = None) -> tuple[int, int]:
    """Return a range of sample numbers (a, b), the numbers a ... b - 1, as two ints.

    Args:
        value: what was given.
        spp: how many samples there are; None: their numbers have no end.

    Raises:
        ValueError: it is no such range.
    """
    most, end = (MOST_SAMPLES, str(MOST_SAMPLES)) if spp is None else (spp, f"spp = {spp}")
    numbers = tuple(value) if isinstance(value, (tuple, list)) else ()
    whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) for n in numbers)
    if len(numbers) != 2 or not whole or not 0 <= numbers[0] < numbers[1] <= most:
        raise ValueError(
            f"samples: got {value!r}, expected (a, b) with 0 <= a < b <= {end}: the numbers a ... b - 1 of every "
            "pixel's samples"
        )
    return int(numbers[0]), int(numbers[1])


def draw_of(integrator: PathIntegrator, spp: int, value) -> Draw:
    """Return the samples that a call of a derivative draws: all, or a range (a, b) of the numbers below ``spp``.

    Raises:
        ValueError: it is no such range, or the boundary term is guided.
    """
    if value is None:
        return Draw(spp)
    method = integrator.boundary
    guiding = getattr(method, "guiding", None)
    if guiding is not None:
        raise ValueError(
            f"samples: guiding.{type(guiding).__name__} keeps a structure from one gradient to the next, so ranges do "
            f"not add up; say boundary.{type(method).__name__}(guiding=None), or leave samples out"
        )
    return Draw(spp, *sample_range(value, spp))


def refuse_budget(name: str, **budget) -> None:
    """Raise where an argument of a name stands beside those of a budget.

    Raises:
        ValueError: one of them is given.
    """
    for other, value in budget.items():
        if value is not None:
            raise ValueError(f"{name} and {other} exclude each other: a budget chooses its samples itself; give one")


def requested(scene: Scene, params: Parameters) -> list[str]:
    """Return the names of what is to be differentiated."""
    check_owner(scene, params)
    if not params.requested:
        raise ValueError("nothing to differentiate: call params.requires_grad(...) with parameter names first")
    return params.requested


def adjoint_array(adjoint, shape: tuple[int, ...], device) -> wp.array:
    """Return the adjoint of an image of a shape as an array of vec3, checked."""
    if isinstance(adjoint, wp.array) and adjoint.dtype is wp.vec3:
        if adjoint.shape != shape:
            raise ValueError(f"adjoint: got shape {adjoint.shape} of vec3, expected the image's {shape}")
        _check_finite(adjoint.numpy())
        return adjoint if adjoint.device == device else adjoint.to(device)
    array = np.asarray(adjoint.numpy() if isinstance(adjoint, wp.array) else adjoint, dtype=np.float32)
    if array.shape != (*shape, 3):
        raise ValueError(
            f"adjoint: got shape {array.shape}, expected the image's {(*shape, 3)}, the derivative of the loss by "
            f"every pixel and channel, or a Warp array of vec3, {shape}"
        )
    _check_finite(array)
    return wp.array(np.ascontiguousarray(array), dtype=wp.vec3, device=device)


def flat(image: wp.array) -> wp.array:
    """Return an image as kernels take it: that of a transient film, (H, W, bins), as (H, W bins); the same memory."""
    return image if image.ndim == 2 else image.reshape((image.shape[0], image.shape[1] * image.shape[2]))


def _check_finite(adjoint: np.ndarray) -> None:
    if not np.isfinite(adjoint).all():
        raise ValueError("adjoint: holds NaN or infinite numbers; check the loss and the target image")


def flat_tangents(scene: Scene, params: Parameters, tangents: dict) -> wp.array:
    """Return the flat tangents of all values, those that follow from poses and positions included."""
    check_owner(scene, params)
    flat = np.zeros(scene.values.shape[0], np.float32)
    for name, tangent in tangents.items():
        values = params.check(name, tangent, "tangent")
        p = scene.parameters[name]
        flat[p.offset : p.offset + p.size] = values.reshape(-1)
    target = wp.array(flat, dtype=wp.float32, device=scene.device)
    accumulate_derived(scene, list(tangents), target)
    return target
