"""Shapes of any kind as triangles, and gradients by the nodes of grids on them: what the viewer draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from warp_psdr import sdf
from warp_psdr.plots import as_array
from warp_psdr.scene import primitives
from warp_psdr.scene.description import Network, ShapeDescription
from warp_psdr.scene.network_bounds import values_of
from warp_psdr.topology.grid_contacts import interpolated
from warp_psdr.view.fields import Field, vertex_normals
from warp_psdr.view.tubes import tube_mesh

#: Vertices (N, 3), faces (M, 3), and texture coordinates (N, 2) or None.
Surface = tuple[np.ndarray, np.ndarray, np.ndarray | None]
#: Sides of a circle of an exact shape.
SIDES = 64
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
    layers = []
    for n, (weight, bias) in enumerate(network.layers):
        w, b = (
            as_array(value_now(values, f"{shape.path}.layer{n}.{what}", held)).reshape(held.shape).astype(np.float64)
            for what, held in (("weight", weight), ("bias", bias))
        )
        layers.append((w, b))
    at = np.linspace(0.0, 1.0, network.count + 1)
    q = np.stack(np.meshgrid(at, at, at, indexing="ij")[::-1], axis=-1)
    found, _slopes = values_of(replace(network, layers=layers), q.reshape(-1, 3))
    return found.reshape(q.shape[:3])


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
