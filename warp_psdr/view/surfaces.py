"""Shapes of any kind as triangles, and gradients by their parameters on these surfaces, for the viewer.

A pose and the weights of a network belong to no place of a surface. Gradients by them are shown as the motion of the
surface in a step along the gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial, singledispatch
from typing import Any

import numpy as np

from warp_psdr import sdf
from warp_psdr.plots import as_array
from warp_psdr.scene.description import ShapeDescription
from warp_psdr.scene.kinds.affine import Exact
from warp_psdr.scene.kinds.curve import Curves
from warp_psdr.scene.kinds.kind import Geometry, geometry_of
from warp_psdr.scene.kinds.network_bounds import values_of
from warp_psdr.scene.kinds.neuralsdf import Network
from warp_psdr.scene.kinds.sdfgrid import SdfGrid
from warp_psdr.topology.grid_contacts import interpolated
from warp_psdr.view.fields import Field, vertex_normals
from warp_psdr.view.tubes import tube_field, tube_mesh

#: Vertices (N, 3), faces (M, 3), and texture coordinates (N, 2) or None.
Surface = tuple[np.ndarray, np.ndarray, np.ndarray | None]
#: Sides of a circle of an exact shape.
SIDES = 64
#: Step of differences by the weights of networks, over the largest of them.
DIFFERENCE = 1.0e-5


def value_now(values: Mapping[str, Any], name: str, default: Any) -> Any:
    """Return the current value of a parameter, or the description's."""
    return as_array(values[name]) if name in values else default


def pose_now(values: Mapping[str, Any], shape: ShapeDescription) -> np.ndarray:
    """Return a shape's ``to_world``, (4, 4), float64."""
    name = f"{shape.instance or shape.path}.to_world"
    return as_array(value_now(values, name, shape.to_world)).reshape(4, 4).astype(np.float64)


def own_now(values: Mapping[str, Any], shape: ShapeDescription) -> dict[str, np.ndarray]:
    """Return the current values of the parameters of a shape without triangles, by their names behind its path."""
    held = geometry_of(shape).parameters()
    return {name: value_now(values, f"{shape.path}.{name}", v).reshape(v.shape) for name, v in held.items()}


def surface_of(values: Mapping[str, Any], shape: ShapeDescription) -> Surface:
    """Return vertices (N, 3), faces (M, 3) and texture coordinates (N, 2) of a shape, in the world.

    Surfaces of grids and networks are those of marching cubes, exact shapes and tubes have some corners around.
    Texture coordinates are None where there are none.

    Args:
        values: current values of parameters, which stand in for the description's.
        shape: of any kind.
    """
    if shape.geometry is not None:
        return _drawn(shape.geometry, own_now(values, shape), pose_now(values, shape))
    if shape.prototype is None:
        vertices = as_array(value_now(values, f"{shape.path}.vertex_positions", shape.vertices)).reshape(-1, 3)
        return vertices, shape.faces, shape.texcoords
    local = as_array(value_now(values, f"{shape.source}.vertex_positions", shape.local_vertices)).reshape(-1, 3)
    pose = pose_now(values, shape)
    return local @ pose[:3, :3].T + pose[:3, 3], shape.faces, shape.texcoords


@singledispatch
def _drawn(geometry: Geometry, own: Mapping[str, np.ndarray], pose: np.ndarray) -> Surface:
    """Return the surface of a shape without triangles, with the current values of its own parameters."""
    raise NotImplementedError(f"{geometry.title} is not drawn")


@_drawn.register
def _(geometry: Exact, own: Mapping[str, np.ndarray], pose: np.ndarray) -> Surface:
    made = geometry.tessellate(SIDES)
    faces = made.faces[:, ::-1] if np.linalg.det(pose[:3, :3]) < 0.0 else made.faces
    return made.vertices @ pose[:3, :3].T + pose[:3, 3], faces, made.texcoords


@_drawn.register
def _(geometry: SdfGrid, own: Mapping[str, np.ndarray], pose: np.ndarray) -> Surface:
    return *sdf.to_mesh(own["grid"][..., 0], pose, geometry.cubic, device="cpu"), None


@_drawn.register
def _(geometry: Network, own: Mapping[str, np.ndarray], pose: np.ndarray) -> Surface:
    return *sdf.to_mesh(network_values(geometry.with_parameters(own)), pose, False, device="cpu"), None


@_drawn.register
def _(geometry: Curves, own: Mapping[str, np.ndarray], pose: np.ndarray) -> Surface:
    vertices, faces, _out = tube_mesh(geometry, own["control_points"], pose)
    return vertices, faces, None


def network_values(network: Network) -> np.ndarray:
    """Return the values (Z, Y, X) of a network at the corners of its cells."""
    at = np.linspace(0.0, 1.0, network.count + 1)
    q = np.stack(np.meshgrid(at, at, at, indexing="ij")[::-1], axis=-1)
    found, _slopes = values_of(network, q.reshape(-1, 3))
    return found.reshape(q.shape[:3])


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
    surface: Surface, network: Network, pose: np.ndarray, name: str, gradient: np.ndarray
) -> tuple[Field, None, np.ndarray]:
    """Return how a step along a gradient by the weights or the bias of one layer moves the surface of a network.

    Where phi grows by phi', the surface phi = 0 moves outwards by -phi' / |grad phi|; phi' is a central difference.

    Args:
        surface: of the network, as ``surface_of`` has it.
        network: with its current layers.
        pose: the network's, (4, 4).
        name: of the parameter, behind the path.
        gradient: by it, of its shape.

    Returns:
        The field, no vectors, and the normals (N, 3) at its vertices.
    """
    vertices, faces, _texcoords = surface
    to_box = np.linalg.inv(pose[:3, :3])
    q = (vertices - pose[:3, 3]) @ to_box.T
    layer, _, what = name.removeprefix("layer").partition(".")
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
    if shape.geometry is not None:
        fields = _own_fields(shape.geometry, own_now(values, shape), pose, surface)
        found |= {f"{shape.path}.{name}": field for name, field in fields.items()}
    return found


@singledispatch
def _own_fields(
    geometry: Geometry, own: Mapping[str, np.ndarray], pose: np.ndarray, surface: Surface
) -> dict[str, tuple[tuple[int, ...], Callable]]:
    """Return what ``own_fields`` does, of the parameters beside the pose, by their names behind the path."""
    return {}


@_own_fields.register
def _(geometry: SdfGrid, own: Mapping[str, np.ndarray], pose: np.ndarray, surface: Surface):
    vertices, faces, _texcoords = surface

    def on_grid(g: np.ndarray) -> tuple[Field, None, np.ndarray]:
        field, normals = grid_field(vertices, faces, pose, g)
        return field, None, normals

    return {"grid": (own["grid"].shape[:3], on_grid)}


@_own_fields.register
def _(geometry: Network, own: Mapping[str, np.ndarray], pose: np.ndarray, surface: Surface):
    network = geometry.with_parameters(own)
    return {name: (held.shape, partial(network_field, surface, network, pose, name)) for name, held in own.items()}


@_own_fields.register
def _(geometry: Curves, own: Mapping[str, np.ndarray], pose: np.ndarray, surface: Surface):
    points = own["control_points"]
    return {"control_points": (points.shape, lambda g: tube_field(geometry, points, pose, g))}
