"""Arrays of users in place of parameters: the scene reads what they hold whenever it follows edits."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.scene.layout import POSITIONS, Parameter

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Radii of the loaded scene beyond which bound vertices are told to have flown away.
FLOWN = 20.0


class Bindings:
    """The arrays that stand for parameters of a scene.

    Args:
        scene: the scene.
    """

    def __init__(self, scene: Scene):
        self._scene = scene
        self._radius = 0.0  # of the scene, before anything was bound
        self._arrays: dict[str, wp.array] = {}
        self._told: set[str] = set()

    def get(self, name: str) -> wp.array | None:
        """Return what stands for a parameter; None: the scene's own array."""
        return self._arrays.get(name)

    @property
    def names(self) -> list[str]:
        """The parameters for which arrays stand."""
        return list(self._arrays)

    def set(self, name: str, array: wp.array | None) -> None:
        """Let an array stand for a parameter; None: its own one, with the values that were followed last.

        Raises:
            TypeError: this is no array of the parameter's type.
            ValueError: its size is another one, or it lies on another device.
        """
        if array is None:
            self._arrays.pop(name, None)
            return
        p = self._scene.parameters[name]
        if not isinstance(array, wp.array) or array.dtype is not p.dtype or not array.is_contiguous:
            given = f"wp.array of {array.dtype.__name__}" if isinstance(array, wp.array) else type(array).__name__
            raise TypeError(
                f"bind {name!r}: got {given}, expected a contiguous wp.array of {p.dtype.__name__}, shape {p.shape}"
            )
        if tuple(array.shape) != p.shape:
            raise ValueError(
                f"bind {name!r}: got shape {tuple(array.shape)}, expected {p.shape}; faces, and the number of "
                "vertices, are fixed when the scene is loaded"
            )
        if array.device != self._scene.device:
            raise ValueError(f"bind {name!r}: the array is on {array.device}, the scene on {self._scene.device}")
        self._radius = self._radius or self._scene.radius
        self._arrays[name] = array

    def refuse(self, name: str) -> None:
        """Refuse to give a parameter values for which an array stands.

        Raises:
            ValueError: there is such an array.
        """
        if name in self._arrays:
            raise ValueError(f"{name!r} is bound to an array; write into that, or call params.bind({name!r}, None)")

    def suspend(self) -> dict[str, wp.array]:
        """Let the scene's own arrays stand for all parameters, and return what did, for ``resume``."""
        arrays, self._arrays = self._arrays, {}
        return arrays

    def resume(self, arrays: dict[str, wp.array]) -> None:
        """Let these arrays stand for parameters again."""
        self._arrays = arrays

    def follow(self) -> None:
        """Copy what the arrays hold into the scene's own ones; no tape records it."""
        for name, array in self._arrays.items():
            p = self._scene.parameters[name]
            view = self._scene.view(name)
            own, theirs = (
                wp.array(ptr=a.ptr, dtype=wp.float32, shape=(p.size,), device=a.device, copy=False)
                for a in (view, array)
            )
            wp.copy(own, theirs)
            if POSITIONS in p.uses and name not in self._told:
                self._tell_flown(p, array)

    def _tell_flown(self, p: Parameter, array: wp.array) -> None:
        held = array.numpy()
        far = float(np.abs(held - self._scene.origin.astype(np.float32)).max(initial=0.0))
        if np.isfinite(far) and far > FLOWN * self._radius:
            self._told.add(p.name)
            warnings.warn(
                f"{p.name!r}: a vertex is {far:.3g} from the scene's origin, and the scene's radius was "
                f"{self._radius:.3g} before; a step of the simulation may have been unstable: make steps smaller",
                RuntimeWarning,
                stacklevel=4,
            )
