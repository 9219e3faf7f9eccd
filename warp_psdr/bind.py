"""A simulator's state as parameters of a scene: particles as vertices, rigid bodies as poses, on the user's tape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr import compiler
from warp_psdr.kernels.shape.rigid import poses_of_bodies
from warp_psdr.scene.parameters import parameter_of

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters

__all__ = ["bind"]

#: Names that one array holds, one after the other.
Names = str | tuple[str, ...]


def bind(
    params: Parameters,
    state: Mapping[Names, wp.array],
    *,
    bodies: Mapping[str, int] | None = None,
    local: Mapping[str, Any] | None = None,
) -> None:
    """Let a state of a simulation be values of a scene, for the renderings that follow.

    What has to be computed, poses of rigid bodies, is computed by one kernel for each array; the tape that is active
    records it, and gradients reach the state's own arrays. Call it once a frame: each call makes arrays of its own.

    Args:
        params: parameters of a scene. Those whose arrays have gradients become requested.
        state: arrays by parameter name, as for ``params.bind``. ``to_world`` also takes a ``wp.array`` of
            ``wp.transform`` (position in world units, and a quaternion x, y, z, w): of one element, or of several under
            a tuple of names, in their order.
        bodies: name of a ``to_world`` -> number in its array of transforms, if not that of its place in the tuple; -1
            for what is fixed to the world.
        local: name of a ``to_world`` -> (4, 4), which stands behind the transform: pose = transform x local, for
            example the shape's scale. Default: the unit matrix.

    Raises:
        KeyError: there is no such parameter.
        TypeError: a value is no array of the parameter's type, nor of transforms.
        ValueError: an array has another size, or lies on another device.
    """
    for key, array in state.items():
        names = (key,) if isinstance(key, str) else tuple(key)
        if isinstance(array, wp.array) and array.dtype is wp.transform:
            _bind_bodies(params, names, array, bodies or {}, local or {})
        elif len(names) == 1:
            params.bind(names[0], array)
        else:
            raise TypeError(
                f"bind: several names, {names}, take one wp.array of wp.transform, got {type(array).__name__}"
            )


def _bind_bodies(
    params: Parameters, names: Sequence[str], transforms: wp.array, bodies: Mapping[str, int], local: Mapping[str, Any]
) -> None:
    for name in names:
        if parameter_of(params.scene, name).shape != (4, 4):
            raise TypeError(f"bind {name!r}: transforms are poses, of parameters whose shape is (4, 4)")
    numbers = np.array([bodies.get(name, i) for i, name in enumerate(names)], np.int32)
    if numbers.size and not (-1 <= numbers.min() and numbers.max() < transforms.size):
        raise ValueError(
            f"bind: {', '.join(names)} need transforms up to number {numbers.max()}, and there are {transforms.size}"
        )
    device = params.scene.device
    if transforms.device != device:
        raise ValueError(f"bind: the transforms are on {transforms.device}, the scene on {device}")
    behind = np.stack([np.asarray(local.get(name, np.eye(4)), np.float32) for name in names])
    poses = wp.zeros((len(names), 4, 4), dtype=wp.float32, device=device, requires_grad=bool(transforms.requires_grad))
    compiler.ensure([poses_of_bodies], device)
    inputs = [transforms, wp.array(numbers, device=device), wp.array(behind, dtype=wp.mat44, device=device)]
    wp.launch(poses_of_bodies, dim=len(names), inputs=inputs, outputs=[poses], device=device)
    for i, name in enumerate(names):
        params.bind(name, poses[i])
