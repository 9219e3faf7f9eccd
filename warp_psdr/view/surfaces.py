"""Shapes of any kind as triangles, and gradients by their parameters on these surfaces, for the viewer.

A pose and the weights of a network belong to no place of a surface. Gradients by them are shown as the motion of the
surface in a step along the gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from warp_psdr import sdf
from warp_psdr.plots import as_array
from warp_psdr.scene import primitives
from warp_psdr.scene.description import Network, ShapeDescription
from warp_psdr.scene.network_bounds import values_of
from warp_psdr.topology.grid_contacts import interpolated
from warp_psdr.view.fields import Field, vertex_normals
from warp_psdr.view.tubes import tube_field, tube_mesh

#: Vertices (N, 3), faces (M, 3), and texture coordinates (N, 2) or None.
Surface = tuple[np.ndarray, np.ndarray, np.ndarray | None]
#: Sides of a circle of an exact shape.
SIDES = 64
#: Step of differences by the weights of networks, over the largest of them.
DIFFERENCE = 1.0e-5
_EXACT = {"sphere": primitives.sphere, "disk": primitives.disk, "cylinder": primitives.cylinder}


def value_now(values: Mapping[str, Any], name: str, default: Any) -> Any:
    """Return the current value of a parameter, or the description's."""
    return as_array(values[name]) if name in values else default


def pose_now(values: Mapping[str, Any], shape: ShapeDescription) -> np.ndarray:
    """Return a shape's ``to_world``, (4, 4), float64."""
    name = f"{shape.instance or shape.path}.to_world"
    return as_array(value_now(values, name, shape.to_world)).reshape(4, 4).astype(np.float64)


def control_points(values: Mapping[str, Any], shape: ShapeDescription) -> np.ndarray:
    """Return the control points (P, 4) of curves, in their own coordinates."""
    assert shape.curves is not None
    return as_array(value_now(values, f"{shape.path}.control_points", shape.curves.points)).reshape(-1, 4)


def surface_of(values: Mapping[str, Any], shape: ShapeDescription) -> Surface:
    """Return vertices (N, 3), faces (M, 3) and texture coordinates (N, 2) of a shape, in the world.

    Surfaces of grids and networks are those of marching cubes, exact shapes and tubes have some corners around.
    Texture coordinates are None where there are none.

    Args:
        values: current values of parameters, which stand in for the description's.
        shape: of any kind.
    """
    if shape.curves is not None:
        vertices, faces, _out = tube_mesh(shape.curves, control_points(values, shape), pose_now(values, shape))
        return vertices, faces, None
    if shape.grid is not None:
        return *_zero_set(grid_values(values, shape), values, shape, shape.grid.cubic), None
    if shape.network is not None:
        return *_zero_set(network_values(values, shape), values, shape, False), None
    if shape.primitive in _EXACT:
        made, pose = _EXACT[shape.primitive](SIDES), pose_now(values, shape)
        faces = made.faces[:, ::-1] if np.linalg.det(pose[:3, :3]) < 0.0 else made.faces
        return made.vertices @ pose[:3, :3].T + pose[:3, 3], faces, made.texcoords
    if shape.prototype is None:
        vertices = as_array(value_now(values, f"{shape.path}.vertex_positions", shape.vertices)).reshape(-1, 3)
        return vertices, shape.faces, shape.texcoords
    local = as_array(value_now(values, f"{shape.source}.vertex_positions", shape.local_vertices)).reshape(-1, 3)
    pose = pose_now(values, shape)
    return local @ pose[:3, :3].T + pose[:3, 3], shape.faces, shape.texcoords


def grid_values(values: Mapping[str, Any], shape: ShapeDescription) -> np.ndarray:
    """Return the values (Z, Y, X) of a grid."""
    assert shape.grid is not None
    return as_array(value_now(values, f"{shape.path}.grid", shape.grid.values)).reshape(shape.grid.values.shape[:3])


def network_values(values: Mapping[str, Any], shape: ShapeDescription) -> np.ndarray:
    """Return the values (Z, Y, X) of a network at the corners of its cells."""
    network = shape.network
    assert isinstance(network, Network)
    at = np.linspace(0.0, 1.0, network.count + 1)
    q = np.stack(np.meshgrid(at, at, at, indexing="ij")[::-1], axis=-1)
    found, _slopes = values_of(_network_now(values, shape), q.reshape(-1, 3))
    return found.reshape(q.shape[:3])


def _network_now(values: Mapping[str, Any], shape: ShapeDescription) -> Network:
    """Return a network with its current layers, float64."""
    network = shape.network
    assert isinstance(network, Network)
    layers = []
    for n, (weight, bias) in enumerate(network.layers):
        w, b = (
            as_array(value_now(values, f"{shape.path}.layer{n}.{what}", held)).reshape(held.shape).astype(np.float64)
            for what, held in (("weight", weight), ("bias", bias))
        )
        layers.append((w, b))
    return replace(network, layers=layers)


def _zero_set(
    nodes: np.ndarray, values: Mapping[str, Any], shape: ShapeDescription, cubic: bool
) -> tuple[np.ndarray, np.ndarray]:
    return sdf.to_mesh(nodes, pose_now(values, shape), cubic, device="cpu")


def grid_field(
    vertices: np.ndarray, faces: np.ndarray, pose: np.ndarray, gradient: np.ndarray
) -> tuple[Field, np.ndarray]:
    """Return a gradient by the nodes of a grid, (Z, Y, X), on its surface.

    It is interpolated, with the opposite sign: how the value grows as the surface moves outwards there, by a length in
    which phi is measured.

    Args:
        vertices: (N, 3), of the surface, as ``surface_of`` has it.
        faces: (M, 3).
        pose: the grid's, (4, 4).
        gradient: by its nodes.

    Returns:
        The field, and the normals (N, 3) at its vertices.
    """
    q = (vertices - pose[:3, 3]) @ np.linalg.inv(pose[:3, :3]).T
    held = -interpolated(gradient, np.clip(q, 0.0, 1.0) * (np.array(gradient.shape[::-1]) - 1))
    field = Field(vertices, faces, held, "vertex", "growth as the surface moves outwards")
    return field, vertex_normals(vertices, faces)


def pose_field(
    vertices: np.ndarray, faces: np.ndarray, pose: np.ndarray, gradient: np.ndarray
) -> tuple[Field, np.ndarray, np.ndarray]:
    """Return how a step along a gradient by a pose moves a surface.

    A point x = A q + b moves by A' q + b', A' and b' the gradient by A and b.

    Args:
        vertices: (N, 3), of the surface, as ``surface_of`` has it.
        faces: (M, 3).
        pose: the shape's, (4, 4).
        gradient: by it, (4, 4).

    Returns:
        The field of the motion along the normals, the motion (N, 3), and the normals (N, 3), at its vertices.
    """
    q = (vertices - pose[:3, 3]) @ np.linalg.inv(pose[:3, :3]).T
    motion = q @ gradient[:3, :3].T + gradient[:3, 3]
    normals = vertex_normals(vertices, faces)
    along = (motion * normals).sum(axis=1)
    return Field(vertices, faces, along, "vertex", "motion outwards in a step along the gradient"), motion, normals


def network_field(
    surface: Surface, values: Mapping[str, Any], shape: ShapeDescription, name: str, gradient: np.ndarray
) -> tuple[Field, None, np.ndarray]:
    """Return how a step along a gradient by the weights or the bias of one layer moves the surface of a network.

    Where phi grows by phi', the surface phi = 0 moves outwards by -phi' / |grad phi|; phi' is a central difference.

    Args:
        surface: of the network, as ``surface_of`` has it.
        values: current values of parameters.
        shape: the network's.
        name: of the parameter.
        gradient: by it, of its shape.

    Returns:
        The field, no vectors, and the normals (N, 3) at its vertices.
    """
    vertices, faces, _texcoords = surface
    network, pose = _network_now(values, shape), pose_now(values, shape)
    to_box = np.linalg.inv(pose[:3, :3])
    q = (vertices - pose[:3, 3]) @ to_box.T
    layer, _, what = name.removeprefix(f"{shape.path}.layer").partition(".")
    number, part = int(layer), ("weight", "bias").index(what)
    held = network.layers[number][part]
    step = DIFFERENCE * max(1.0, float(np.abs(held).max())) / max(float(np.abs(gradient).max()), 1e-300)
    found = []
    for sign in (1.0, -1.0):
        changed = list(network.layers[number])
        changed[part] = held + sign * step * gradient
        layers = [*network.layers[:number], (changed[0], changed[1]), *network.layers[number + 1 :]]
        found.append(values_of(replace(network, layers=layers), q)[0])
    growth = (found[0] - found[1]) / (2.0 * step)
    slopes = np.linalg.norm(values_of(network, q)[1] @ to_box, axis=1)
    field = Field(vertices, faces, -growth / slopes, "vertex", "motion outwards in a step along the gradient")
    return field, None, vertex_normals(vertices, faces)


def own_fields(
    values: Mapping[str, Any], shape: ShapeDescription, surface: Surface
) -> dict[str, tuple[tuple[int, ...], Callable[[np.ndarray], tuple[Field, np.ndarray | None, np.ndarray]]]]:
    """Return parameters that define a shape, but for the vertices of meshes: name -> (its size, what draws it).

    What draws it takes the gradient of that size and returns a field, the vectors at its vertices where there are any,
    and the normals there.

    Args:
        values: current values of parameters, which stand in for the description's.
        shape: of any kind.
        surface: as ``surface_of`` has it.
    """
    vertices, faces, _texcoords = surface
    pose = pose_now(values, shape) if shape.to_world is not None else np.eye(4)
    found: dict[str, tuple[tuple[int, ...], Callable]] = {}
    if shape.to_world is not None:
        name = f"{shape.instance or shape.path}.to_world"
        found[name] = (4, 4), lambda g: pose_field(vertices, faces, pose, g)
    if shape.curves is not None:
        curves, points = shape.curves, control_points(values, shape)
        found[f"{shape.path}.control_points"] = curves.points.shape, lambda g: tube_field(curves, points, pose, g)
    if shape.grid is not None:

        def on_grid(g: np.ndarray) -> tuple[Field, None, np.ndarray]:
            field, normals = grid_field(vertices, faces, pose, g)
            return field, None, normals

        found[f"{shape.path}.grid"] = grid_values(values, shape).shape, on_grid
    if shape.network is not None:
        for n, layer in enumerate(shape.network.layers):
            for what, held in zip(("weight", "bias"), layer, strict=True):
                name = f"{shape.path}.layer{n}.{what}"
                found[name] = held.shape, partial(network_field, surface, values, shape, name)
    return found
