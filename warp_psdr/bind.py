"""A simulator's state as parameters of a scene: particles as vertices, rigid bodies as poses, on the user's tape."""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr import compiler
from warp_psdr.kernels.shape.rigid import gather_points, poses_of_bodies
from warp_psdr.scene.parameters import parameter_of

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

__all__ = ["bind"]

#: Names that one array holds, one after the other.
Names = str | tuple[str, ...]


@dataclass(frozen=True)
class Points:
    """The particles that vertices go with.

    Attributes:
        numbers: (N,) int32, of each vertex's particle.
        least: the number of particles that there have to be.
        offsets: (N,) vec3, from there to the vertex; None: they are one.
    """

    numbers: wp.array
    least: int
    offsets: wp.array | None = None


@dataclass(frozen=True)
class Simulation:
    """What a simulator's state moves in a scene: arguments of ``bind``, and particles by the names of vertices.

    Attributes:
        bodies: name of a ``to_world`` -> number of its body.
        local: name of a ``to_world`` -> (4, 4), see ``bind``.
        particles: name of ``vertex_positions`` -> the particles that they go with.
    """

    bodies: Mapping[str, int]
    local: Mapping[str, Any]
    particles: Mapping[str, Points]


_simulations: weakref.WeakKeyDictionary[Scene, Simulation] = weakref.WeakKeyDictionary()


def remember(scene: Scene, simulation: Simulation) -> None:
    """Let ``bind`` know what a simulator's state moves in a scene."""
    _simulations[scene] = simulation


def bind(
    params: Parameters,
    state: Mapping[Names, wp.array] | Any,
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
            a tuple of names, in their order. For a scene of ``psdr.from_newton`` also a ``newton.State``.
        bodies: name of a ``to_world`` -> number in its array of transforms, if not that of its place in the tuple; -1
            for what is fixed to the world.
        local: name of a ``to_world`` -> (4, 4), which stands behind the transform: pose = transform x local. Default:
            the size that the shape was loaded with, what its ``to_world`` does beside turning and moving it.

    Raises:
        KeyError: there is no such parameter.
        TypeError: a value is no array of the parameter's type, nor of transforms; the scene has no model that a state
            could be of.
        ValueError: an array has another size, or lies on another device.
    """
    if not isinstance(state, Mapping):
        _bind_state(params, state)
        return
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


def _size(scene: Scene, name: str) -> np.ndarray:
    """Return the symmetric factor of the pose that a shape was loaded with (polar decomposition), (4, 4)."""
    size, owner = np.eye(4), scene.parameters[name].owner
    loaded = scene.description.shapes[owner].to_world if 0 <= owner < len(scene.description.shapes) else None
    if loaded is not None:
        linear = np.asarray(loaded, float)[:3, :3]
        _turn, stretches, axes = np.linalg.svd(linear)
        if np.linalg.det(linear) < 0.0:
            stretches[-1] *= -1.0  # a mirror image stays one
        size[:3, :3] = axes.T @ np.diag(stretches) @ axes
    return size


def _bind_state(params: Parameters, state: Any) -> None:
    """Bind the bodies and particles of a simulator's state (``body_q``, ``particle_q``)."""
    scene = params.scene
    simulation = _simulations.get(scene)
    if simulation is None:
        raise TypeError(
            f"bind: got {type(state).__name__}, expected arrays by parameter name; a newton.State is for a scene of "
            "psdr.from_newton"
        )
    if simulation.bodies:
        names = tuple(simulation.bodies)
        _bind_bodies(params, names, state.body_q, simulation.bodies, simulation.local)
    for name, found in simulation.particles.items():
        points = state.particle_q
        if found.least > points.size:
            raise ValueError(f"bind {name!r}: the state has {points.size} particles, expected {found.least} or more")
        n, offsets = found.numbers.size, found.offsets
        if offsets is not None or n < points.size:
            if offsets is None:
                offsets = wp.zeros(n, dtype=wp.vec3, device=scene.device)
            gathered = wp.zeros(n, dtype=wp.vec3, device=scene.device, requires_grad=points.requires_grad)
            compiler.ensure([gather_points], scene.device)
            inputs = [points, found.numbers, offsets]
            wp.launch(gather_points, dim=n, inputs=inputs, outputs=[gathered], device=scene.device)
            points = gathered
        params.bind(name, points)


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
    given = [local[name] if name in local else _size(params.scene, name) for name in names]
    behind = np.stack([np.asarray(matrix, np.float32) for matrix in given])
    poses = wp.zeros((len(names), 4, 4), dtype=wp.float32, device=device, requires_grad=bool(transforms.requires_grad))
    compiler.ensure([poses_of_bodies], device)
    inputs = [transforms, wp.array(numbers, device=device), wp.array(behind, dtype=wp.mat44, device=device)]
    wp.launch(poses_of_bodies, dim=len(names), inputs=inputs, outputs=[poses], device=device)
    for i, name in enumerate(names):
        params.bind(name, poses[i])
