"""Losses that compare a rendered image with a target, and regularisers of grids, as Warp kernels that a tape records.

Every loss of an image is a mean over all pixels and channels, an array of shape ``(1,)`` for ``tape.backward(loss)``,
and adds up in a fixed order, so that equal images give equal bits. The derivative reaches ``image.grad``; the target is
a constant. ``eikonal`` and ``laplacian`` are means over a grid of signed distances, and ``total`` adds losses up.

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

__all__ = ["eikonal", "huber", "l1", "l2", "laplacian", "relative_l2", "total"]

CHANNELS = 3
#: Weights of pixels, or None.
Weights = np.ndarray | wp.array | None


class Loss(wp.array):
    """A loss on its device: a Warp array of shape (1,); ``float(loss)`` is its value, which it shows by itself.

    Args:
        device: Warp device.
        requires_grad: with an array for its gradient.
    """

    def __init__(self, device: Any, *, requires_grad: bool):
        super().__init__(shape=(1,), dtype=wp.float32, device=device, requires_grad=requires_grad)

    def __float__(self) -> float:
        return float(self.numpy()[0])

    def __format__(self, form: str) -> str:
        return format(float(self), form)

    def __repr__(self) -> str:
        return f"<loss {float(self):.6g}, wp.array of shape (1,)>"

    __str__ = __repr__


def l2(image: wp.array, target: wp.array | np.ndarray, *, weights: Weights = None) -> wp.array:
    """Return the mean squared difference, ``mean((image - target)^2)``.

    Args:
        image: Rendered image, ``wp.array2d[vec3]`` of shape ``(H, W)``, ``(B, H, W)`` or ``(H, W, bins)``, or a mask or
            depth of ``render_aov``, float32; differentiable.
        target: Image of the same shape, or a NumPy array ``(H, W, 3)``, ``(B, H, W, 3)`` of several sensors, and
            without the 3 of a mask or depth; a constant.
        weights: Of the pixels, of the image's shape, ``(H, W)`` or ``(B, H, W)``, not negative: the mean is
            ``sum(weights * loss) / (sum(weights) channels)``, so that 0 leaves pixels out; a constant. None: all alike.

    Returns:
        Array of shape ``(1,)``, float32, on the image's device.

    Raises:
        TypeError: If ``image`` or ``target`` is no image.
        ValueError: If their shapes differ.
    """
    return _mean(kernels.squared, image, target, weights)


def l1(image: wp.array, target: wp.array | np.ndarray, *, weights: Weights = None) -> wp.array:
    """Return the mean absolute difference, ``mean(|image - target|)``; its derivative at equality is 0.

    Args:
        image: As for :func:`l2`.
        target: As for :func:`l2`.
        weights: As for :func:`l2`.

    Returns:
        Array of shape ``(1,)``, float32, on the image's device.

    Raises:
        TypeError: If ``image`` or ``target`` is no image.
        ValueError: If their shapes differ.
    """
    return _mean(kernels.absolute, image, target, weights)


def huber(image: wp.array, target: wp.array | np.ndarray, *, delta: float = 0.1, weights: Weights = None) -> wp.array:
    """Return the mean Huber loss: ``d^2 / 2`` where ``|d| <= delta``, ``delta (|d| - delta / 2)`` beyond.

    Args:
        image: As for :func:`l2`.
        target: As for :func:`l2`.
        delta: Difference beyond which the loss grows linearly, in units of radiance.
        weights: As for :func:`l2`.

    Returns:
        Array of shape ``(1,)``, float32, on the image's device.

    Raises:
        TypeError: If ``image`` or ``target`` is no image.
        ValueError: If their shapes differ or ``delta`` is not positive.
    """
    return _mean(kernels.huber, image, target, weights, _positive("delta", delta))


def relative_l2(
    image: wp.array, target: wp.array | np.ndarray, *, epsilon: float = 1e-2, weights: Weights = None
) -> wp.array:
    """Return the mean squared difference relative to the target, ``mean((image - target)^2 / (target^2 + epsilon))``.

    Dividing by the target, not by the rendered image, keeps the derivative free of the image's own noise.

    Args:
        image: As for :func:`l2`.
        target: As for :func:`l2`.
        epsilon: Squared radiance below which the difference counts as absolute.
        weights: As for :func:`l2`.

    Returns:
        Array of shape ``(1,)``, float32, on the image's device.

    Raises:
        TypeError: If ``image`` or ``target`` is no image.
        ValueError: If their shapes differ or ``epsilon`` is not positive.
    """
    return _mean(kernels.relative_squared, image, target, weights, _positive("epsilon", epsilon))


def eikonal(grid: wp.array, lengths: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> wp.array:
    """Return how far a grid is from one of distances, the mean of ``(|grad| - 1)^2`` over its voxels.

    The slope is that of tri-linear interpolation at the middle of a voxel.

    Args:
        grid: Values of a ``sdfgrid``, (Z, Y, X, 1) or (Z, Y, X), float32; differentiable.
        lengths: Of its box along x, y and z, in the unit of the values: of the columns of its ``to_world``.

    Returns:
        Array of shape ``(1,)``, float32, on the grid's device.

    Raises:
        TypeError: If ``grid`` is no such array.
        ValueError: If a length is not positive.
    """
    return _grid_mean(0, 1, grid, lengths)


def laplacian(grid: wp.array, lengths: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> wp.array:
    """Return the mean of the squared Laplacian over the nodes of a grid, by second differences; less is smoother.

    Of distances it is the squared sum of the surface's curvatures, in 1 / unit^2. The border's values go on behind it.

    Args:
        grid: As for :func:`eikonal`.
        lengths: As for :func:`eikonal`.

    Returns:
        Array of shape ``(1,)``, float32, on the grid's device.

    Raises:
        TypeError: If ``grid`` is no such array.
        ValueError: If a length is not positive.
    """
    return _grid_mean(1, 0, grid, lengths)


def total(loss: wp.array, *terms: tuple[float, wp.array]) -> wp.array:
    """Return a loss plus weighted ones, for ``tape.backward(total(loss, (0.1, regulariser)))``.

    Args:
        loss: Array of shape ``(1,)``, float32.
        terms: Pairs of a weight and such an array.

    Returns:
        Array of shape ``(1,)``, float32, on the device of ``loss``.

    Raises:
        TypeError: If a loss is no such array.
        ValueError: If a weight is not finite.
    """
    kernel = kernels.make_total()
    for name, value in (("loss", loss), *((f"terms[{i}][1]", value) for i, (_weight, value) in enumerate(terms))):
        if not isinstance(value, wp.array) or value.shape != (1,) or value.dtype != wp.float32:
            raise TypeError(f"{name}: got {_describe(value)}, expected a loss: wp.array of float32, shape (1,)")
    for i, (weight, _value) in enumerate(terms):
        if not math.isfinite(weight):
            raise ValueError(f"terms[{i}][0]: got {weight}, expected a finite weight")
    compiler.ensure([kernel], loss.device)
    for weight, value in terms:
        differentiable = bool(loss.requires_grad or value.requires_grad)
        after = Loss(loss.device, requires_grad=differentiable)
        wp.launch(kernel, dim=1, inputs=[value, float(weight), loss], outputs=[after], device=loss.device)
        loss = after
    return loss


def _grid_mean(which: int, less: int, grid: wp.array, lengths: tuple[float, float, float]) -> wp.array:
    """The mean of terms of a grid; ``less``: by how many there are fewer terms along an axis than nodes."""
    shape = grid.shape[:3] if isinstance(grid, wp.array) and grid.ndim in (3, 4) else ()
    if not shape or grid.dtype != wp.float32 or (grid.ndim == 4 and grid.shape[3] != 1) or min(shape) < 2:
        raise TypeError(
            f"grid: got {_describe(grid)}, expected wp.array of float32, (Z, Y, X, 1), 2 or more along each"
        )
    if len(lengths) != 3 or not all(math.isfinite(x) and x > 0.0 for x in lengths):
        raise ValueError(f"lengths: got {lengths}, expected three positive numbers")
    inverse = wp.vec3(*((n - 1) / length for n, length in zip(shape[::-1], lengths, strict=True)))
    nz, ny, nx = (n - less for n in shape)
    terms = wp.empty((nz * ny, nx), dtype=wp.float32, device=grid.device, requires_grad=bool(grid.requires_grad))
    inputs = [grid.reshape(shape), inverse]
    kernel = kernels.make_grid_terms()[which]
    compiler.ensure([kernel, kernels.make_sums()[0]], grid.device)
    wp.launch(kernel, dim=(nz, ny, nx), inputs=inputs, outputs=[terms], device=grid.device)
    return _mean_of(terms, 1.0 / terms.size)


def _mean(
    term: wp.Function, image: wp.array, target: wp.array | np.ndarray, weights: Weights, parameter: float = 0.0
) -> wp.array:
    if not isinstance(image, wp.array) or image.ndim not in (2, 3) or image.dtype not in (wp.vec3, wp.float32):
        raise TypeError(
            f"image: got {_describe(image)}, expected wp.array2d[vec3] of shape (H, W), (B, H, W) of several sensors, "
            "or (H, W, bins) of a transient film, as render returns it, or an array of float32 of render_aov"
        )
    channels = CHANNELS if image.dtype == wp.vec3 else 1
    target = _as_image(target, image)
    weight, total = _as_weights(weights, image)
    rows, columns = image.shape[0], image.size // image.shape[0]
    if image.ndim == 3:
        image, target, weight = (array.reshape((rows, columns)) for array in (image, target, weight))
    terms = wp.empty((rows, columns), dtype=wp.float32, device=image.device, requires_grad=bool(image.requires_grad))
    terms_kernel = kernels.make_terms(term, channels)
    compiler.ensure([terms_kernel, kernels.make_sums()[0]], image.device)
    wp.launch(
        terms_kernel,
        dim=terms.shape,
        inputs=[image, target, weight, parameter],
        outputs=[terms],
        device=image.device,
    )
    return _mean_of(terms, 1.0 / (total * channels))


def _as_weights(weights: Weights, image: wp.array) -> tuple[wp.array, float]:
    """Return the pixels' weights in the shape of the image, and their sum."""
    if weights is None:
        return wp.ones(image.shape, dtype=wp.float32, device=image.device), float(image.size)
    values = np.asarray(weights.numpy() if isinstance(weights, wp.array) else weights)
    if values.dtype.kind not in "fiub":
        raise TypeError(f"weights: got {_describe(weights)}, expected an array of numbers of shape {image.shape}")
    values = values.astype(np.float32)
    if values.shape != image.shape:
        raise ValueError(f"weights: got shape {values.shape}, expected a number a pixel, {image.shape}")
    total = float(values.sum(dtype=np.float64))
    if not (np.isfinite(values).all() and values.min() >= 0.0 and total > 0.0):
        raise ValueError("weights: expected finite numbers that are not negative, some of them positive")
    return wp.array(values, dtype=wp.float32, device=image.device), total


def _mean_of(terms: wp.array, scale: float) -> wp.array:
    """The sum of terms in a fixed order, times a factor."""
    device, differentiable = terms.device, bool(terms.requires_grad)
    rows = wp.empty(terms.shape[0], dtype=wp.float64, device=device, requires_grad=differentiable)
    mean = Loss(device, requires_grad=differentiable)
    sum_rows, mean_of_rows = kernels.make_sums()
    wp.launch(sum_rows, dim=rows.shape, inputs=[terms], outputs=[rows], device=device)
    wp.launch(mean_of_rows, dim=1, inputs=[rows, wp.float64(scale)], outputs=[mean], device=device)
    return mean


def _as_image(target: wp.array | np.ndarray, image: wp.array) -> wp.array:
    """Return ``target`` as a Warp image on the device of ``image`` and of its shape, which has no gradient."""
    kind = image.dtype
    shape = (*image.shape, CHANNELS) if kind == wp.vec3 else image.shape
    if isinstance(target, wp.array):
        if target.dtype != kind or target.ndim != image.ndim:
            raise TypeError(
                f"target: got {_describe(target)}, expected an array of {kind.__name__} or a NumPy array {shape}"
            )
        if target.shape != image.shape:
            raise ValueError(
                f"target: got shape {target.shape}, expected the image's {image.shape}; resize one of them"
            )
        there: Any = target.to(image.device)
        return wp.array(there, dtype=kind, copy=False, requires_grad=False) if there.requires_grad else there
    values = np.asarray(target)
    if values.dtype in (np.uint8, np.uint16):
        raise TypeError(
            f"target: got {_describe(target)}, expected linear values: read the file with psdr.read_image, or divide "
            f"by {np.iinfo(values.dtype).max} and linearise: ((x + 0.055) / 1.055) ** 2.4, x / 12.92 up to 0.04045"
        )
    if values.dtype.kind not in "fiu":
        raise TypeError(f"target: got {_describe(target)}, expected wp.array2d[vec3] or a NumPy array {shape}")
    if values.shape != shape:
        raise ValueError(f"target: got shape {values.shape}, expected {shape}; resize it or drop its alpha channel")
    return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=kind, device=image.device)


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
