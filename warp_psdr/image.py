"""What rendering returns: a Warp array that a notebook shows as a picture."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import warp as wp

#: Least width and height of a picture that is shown, pixels: smaller images are enlarged by a whole number.
_SHOWN = 192


class Image(wp.array):
    """An image on its device: a ``wp.array2d`` of vec3, shape (H, W), top row first; notebooks show it.

    That of a transient film has the shape (H, W, bins), and notebooks show the sum over its bins. Those of a list of
    sensors are a stack, (B, H, W), which notebooks show side by side.

    It is a Warp array in everything else: kernels, tapes, ``numpy()`` and PyTorch take it as one.

    Args:
        shape: (H, W), (H, W, bins) of a transient film, or (B, H, W) of a stack.
        device: Warp device.
        requires_grad: with an array for its gradient.
        signed: a derivative, which is shown in two hues with a colour bar instead of as radiance.
        stack: images of several sensors.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        device: Any,
        *,
        requires_grad: bool = False,
        signed: bool = False,
        stack: bool = False,
    ):
        super().__init__(shape=shape, dtype=wp.vec3, device=device, requires_grad=requires_grad)
        self.signed, self.stack = signed, stack
        self.zero_()

    def __reduce__(self):
        """Return what a copy, or another process, makes the same image of."""
        device = wp.get_device(self.device).alias
        return _image_of, (self.numpy(), device, self.requires_grad, self.signed, self.stack)

    def __deepcopy__(self, _memo: Any) -> Image:
        return _image_of(*self.__reduce__()[1])

    def _repr_png_(self) -> bytes:
        """Return the picture that a notebook shows: sRGB, clipped to [0, 1]."""
        from PIL import Image as Picture

        from warp_psdr.image_io import linear_to_srgb

        values = self.numpy()
        if self.stack:
            values = np.concatenate(values, axis=1)
        elif self.ndim == 3:
            values = values.sum(axis=2)
        stream = io.BytesIO()
        if self.signed:
            from warp_psdr.plots import RADIANCE_DERIVATIVE, derivative_image

            derivative_image(stream, values, unit=RADIANCE_DERIVATIVE)
            return stream.getvalue()
        pixels = (255.0 * linear_to_srgb(values)).round().astype("uint8")
        factor = max(-(-_SHOWN // max(min(pixels.shape[:2]), 1)), 1)
        Picture.fromarray(pixels.repeat(factor, axis=0).repeat(factor, axis=1)).save(stream, "PNG")
        return stream.getvalue()


def _image_of(values: np.ndarray, device: str, requires_grad: bool, signed: bool, stack: bool) -> Image:
    image = Image(values.shape[:-1], device, requires_grad=requires_grad, signed=signed, stack=stack)
    image.assign(values)
    return image
