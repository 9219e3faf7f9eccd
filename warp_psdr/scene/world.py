"""World coordinates of parameters, for a scene whose values are relative to an origin of its own (``origin``)."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import numpy as np
import warp as wp

from warp_psdr.scene.layout import Parameter
from warp_psdr.scene.origin import from_world, shift_of, to_world

#: Steps of float32 world coordinates, over the scene's radius, to which edits may round without a warning: half a pixel
#: of an image of a thousand, and the step of a slow optimiser.
COARSE = 1.0e-3


class World:
    """The arrays that users read and edit in place of stretches of the values.

    Args:
        values: Flat values of the scene; positions and poses in them are relative to ``origin``.
        origin: (3,) float64, world units.
        parameters: Of the scene.
    """

    def __init__(self, values: wp.array, origin: np.ndarray, parameters: Iterable[Parameter]):
        self._values = values
        self._origin = origin
        self._world = {p.name: wp.clone(self._stretch(p)) for p in parameters if p.placed and origin.any()}
        self._warned = False

    def view(self, p: Parameter) -> wp.array:
        """Return a parameter's array: world coordinates of what has a place, else the values themselves."""
        return p.shaped(self._world.get(p.name, self._stretch(p)))

    def place(self, p: Parameter, values: np.ndarray) -> bool:
        """Take new values of a parameter, float32 or float64, which are not rounded before they are made relative.

        Returns:
            Whether they differ from the former ones.
        """
        held = self._stretch(p).numpy()
        stored = values.reshape(-1).astype(np.float32, copy=False)
        if p.placed and self._origin.any():
            stored, _ = from_world(values.reshape(-1), held, shift_of(p.numpy_shape, self._origin))
        differs = not np.array_equal(stored, held)
        self._stretch(p).assign(stored)
        self.show([p])
        return differs

    def show(self, parameters: Iterable[Parameter]) -> None:
        """Let world coordinates follow the values."""
        for p in parameters if self._origin.any() else ():
            if p.placed:
                world = to_world(self._stretch(p).numpy(), shift_of(p.numpy_shape, self._origin))
                self._world[p.name].assign(world)

    def take_over(self, p: Parameter, radius: float) -> None:
        """Let the values follow edits of world coordinates in place; warn where float32 is too coarse for that.

        Args:
            p: The parameter.
            radius: Of the scene, world units.
        """
        if not (p.placed and self._origin.any()):
            return
        world = self._world[p.name].numpy()
        shift = shift_of(p.numpy_shape, self._origin)
        stored, edited = from_world(world, self._stretch(p).numpy(), shift)
        if not edited.any():
            return
        self._stretch(p).assign(stored)
        step = float(np.spacing(np.float32(np.abs(self._origin).max()))) / radius
        if step > COARSE and not self._warned:
            self._warned = True
            warnings.warn(
                f"{p.name!r} was edited in float32 world coordinates, which this far from the origin have steps of "
                f"{step:.1g} of the scene's radius; assign float64 values, or move the scene by "
                f"{(-self._origin).tolist()} before it is loaded",
                RuntimeWarning,
                stacklevel=4,
            )

    def _stretch(self, p: Parameter) -> wp.array:
        return self._values[p.offset : p.offset + p.size]
