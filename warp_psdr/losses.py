"""Losses that compare a rendered image with a target, as Warp kernels that a tape records.

Every loss is a mean over all pixels and channels, an array of shape ``(1,)`` for ``tape.backward(loss)``, and adds up
in a fixed order, so that equal images give equal bits. The derivative reaches ``image.grad``; the target is a constant.

A rendered image is noisy, and these losses are not linear in it: the mean of ``l2`` over many seeds is the loss of the
mean image plus the mean variance of a pixel. Its *gradient* stays unbiased because ``render`` draws the samples of the
gradient independently of those of the image.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from warp_psdr import compiler
from warp_psdr.kernels import loss as kernels

__all__ = ["huber", "l1", "l2", "relative_l2"]

CHANNELS = 3


def l2(image: wp.array, target: wp.array | np.ndarray) -> wp.array:
    """Return the mean squared difference, ``mean((image - target)^2)``.

    Args:
        image: Rendered image, ``wp.array2d[vec3]`` of shape ``(H, W)``; differentiable.
        target: Image of the same shape, or a NumPy array ``(H, W, 3)``; a constant.

    Returns:
        Array of shape ``(1,)``, float32, on the image's device.

    Raises:
        TypeError: If ``image`` or ``target`` is no image.
        ValueError: If their shapes differ.
    """
    return _mean(kernels.squared, image, target)


def l1(image: wp.array, target: wp.array | np.ndarray) -> wp.array:
    """Return the mean absolute difference, ``mean(|image - target|)``; its derivative at equality is 0.

    Args:
        image: As for :func:`l2`.
        target: As for :func:`l2`.

    Returns:
        Array of shape ``(1,)``, float32, on the image's device.

    Raises:
        TypeError: If ``image`` or ``target`` is no image.
        ValueError: If their shapes differ.
    """
    return _mean(kernels.absolute, image, target)


def huber(image: wp.array, target: wp.array | np.ndarray, *, delta: float = 0.1) -> wp.array:
    """Return the mean Huber loss: ``d^2 / 2`` where ``|d| <= delta``, ``delta (|d| - delta / 2)`` beyond.

    Args:
        image: As for :func:`l2`.
        target: As for :func:`l2`.
        delta: Difference beyond which the loss grows linearly, in units of radiance.

    Returns:
        Array of shape ``(1,)``, float32, on the image's device.

    Raises:
        TypeError: If ``image`` or ``target`` is no image.
        ValueError: If their shapes differ or ``delta`` is not positive.
    """
    return _mean(kernels.huber, image, target, _positive("delta", delta))


def relative_l2(image: wp.array, target: wp.array | np.ndarray, *, epsilon: float = 1e-2) -> wp.array:
    """Return the mean squared difference relative to the target, ``mean((image - target)^2 / (target^2 + epsilon))``.

    Dividing by the target, not by the rendered image, keeps the derivative free of the image's own noise.

    Args:
        image: As for :func:`l2`.
        target: As for :func:`l2`.
        epsilon: Squared radiance below which the difference counts as absolute.

    Returns:
        Array of shape ``(1,)``, float32, on the image's device.

    Raises:
        TypeError: If ``image`` or ``target`` is no image.
        ValueError: If their shapes differ or ``epsilon`` is not positive.
    """
    return _mean(kernels.relative_squared, image, target, _positive("epsilon", epsilon))


def _mean(term: wp.Function, image: wp.array, target: wp.array | np.ndarray, parameter: float = 0.0) -> wp.array:
    if not isinstance(image, wp.array) or image.ndim != 2 or image.dtype != wp.vec3:
        raise TypeError(
            f"image: got {_describe(image)}, expected wp.array2d[vec3] of shape (H, W), as render returns it"
        )
    target = _as_image(target, image)
    height, width = image.shape
    differentiable = bool(image.requires_grad)
    terms = wp.empty((height, width), dtype=wp.float32, device=image.device, requires_grad=differentiable)
    rows = wp.empty(height, dtype=wp.float64, device=image.device, requires_grad=differentiable)
    mean = wp.empty(1, dtype=wp.float32, device=image.device, requires_grad=differentiable)
    sum_rows, mean_of_rows = kernels.make_sums()
    terms_kernel = kernels.make_terms(term)
    compiler.ensure([terms_kernel, sum_rows], image.device)
    wp.launch(
        terms_kernel,
        dim=(height, width),
        inputs=[image, target, parameter],
        outputs=[terms],
        device=image.device,
    )
    wp.launch(sum_rows, dim=height, inputs=[terms], outputs=[rows], device=image.device)
    scale = wp.float64(1.0 / (height * width * CHANNELS))
    wp.launch(mean_of_rows, dim=1, inputs=[rows, scale], outputs=[mean], device=image.device)
    return mean


def _as_image(target: wp.array | np.ndarray, image: wp.array) -> wp.array:
    """Return ``target`` as a Warp image on the device of ``image`` and of its shape, which has no gradient."""
    shape = (*image.shape, CHANNELS)
    if isinstance(target, wp.array):
        if target.dtype != wp.vec3 or target.ndim != 2:
            raise TypeError(f"target: got {_describe(target)}, expected wp.array2d[vec3] or a NumPy array {shape}")
        if target.shape != image.shape:
            raise ValueError(
                f"target: got shape {target.shape}, expected the image's {image.shape}; resize one of them"
            )
        there: Any = target.to(image.device)
        return wp.array(there, dtype=wp.vec3, copy=False, requires_grad=False) if there.requires_grad else there
    values = np.asarray(target)
    if values.dtype.kind not in "fiu":
        raise TypeError(f"target: got {_describe(target)}, expected wp.array2d[vec3] or a NumPy array {shape}")
    if values.shape != shape:
        raise ValueError(f"target: got shape {values.shape}, expected {shape}; resize it or drop its alpha channel")
    return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=wp.vec3, device=image.device)


def _positive(name: str, value: float) -> float:
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{name}: got {value}, expected a positive number")
    return float(value)


def _describe(value: object) -> str:
    if isinstance(value, wp.array):
        return f"wp.array of {value.dtype.__name__}, shape {value.shape}"
    if isinstance(value, np.ndarray):
        return f"NumPy array of {value.dtype}, shape {value.shape}"
    return type(value).__name__
