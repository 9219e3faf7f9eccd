"""Signed fields on surfaces as plain arrays, made without a renderer, for ``warp_psdr.view.viewer``.

A field is a scalar at vertices, at faces, or at the texels of an image that texture coordinates spread over a mesh (an
environment map over a sphere). A vector field becomes arrows, and a scalar: its component along the vertex normal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from warp_psdr.plots import Reduce, as_array, symmetric_limit, to_signed


@dataclass(frozen=True, eq=False)
class Field:
    """A signed scalar on a surface."""

    vertices: np.ndarray  #: (N, 3)
    faces: np.ndarray  #: (M, 3)
    values: np.ndarray  #: on "vertex": (N,); "face": (M,); "texel": (H, W), first row at v = 0
    on: Literal["vertex", "face", "texel"]
    quantity: str = ""  #: how the values come from vectors or colours, for the caption
    uvs: np.ndarray | None = None  #: on "texel": (N, 2), where the texture is read, ``to_uv`` applied
    wrap: Literal["repeat", "mirror", "clamp"] = "repeat"
    unsure: np.ndarray | None = None  #: of vectors: (N,), which are below two of their standard deviations


@dataclass(frozen=True, eq=False)
class Arrows:
    """Arrows of world-space length; those that point into the surface end on it instead of hiding behind it."""

    starts: np.ndarray  #: (K, 3)
    vectors: np.ndarray  #: (K, 3)
    unsure: np.ndarray  #: (K,), drawn in grey


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit, area-weighted vertex normals, (N, 3); zero where no face of non-zero area meets."""
    corners = vertices[faces]
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(normals, faces[:, corner], weighted)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def mesh_field(
    vertices: Any,
    faces: Any,
    values: Any,
    *,
    on: Literal["vertex", "face"] = "vertex",
    vectors: bool = False,
    normals: Any = None,
    reduce: Reduce = "mean",
) -> Field:
    """Make a field of values at vertices or faces.

    Args:
        vertices: (N, 3).
        faces: (M, 3) vertex indices.
        values: (N,) or (N, C) at vertices, (M,) or (M, C) at faces, with C = 1 or 3.
        on: Where the values live.
        vectors: The values are vectors at vertices, not colours: take the component along the vertex normal.
        normals: (N, 3) unit normals; derived from the faces when missing.
        reduce: How colours become one value.

    Raises:
        ValueError: The number of values does not match the mesh.
    """
    vertices, faces, values = as_array(vertices), np.asarray(faces, dtype=np.int64), as_array(values)
    count = len(vertices) if on == "vertex" else len(faces)
    expected = (count, 3) if vectors else (count, *values.shape[1:])
    if values.ndim not in (1, 2) or values.shape != expected:
        shape = "(N, 3)" if vectors else "(N,), (N, 1) or (N, 3)"
        raise ValueError(f"got values of shape {values.shape} for N = {count} {on} positions; expected {shape}")
    if vectors:
        directions = vertex_normals(vertices, faces) if normals is None else as_array(normals)
        along = np.einsum("ij,ij->i", values, directions)
        return Field(vertices, faces, along, "vertex", "component along the normal")
    if values.ndim == 1:
        values = values[:, None]
    return Field(vertices, faces, to_signed(values, reduce=reduce), on, _channels(values, reduce))


def texture_field(
    vertices: Any,
    faces: Any,
    uvs: Any,
    image: Any,
    *,
    to_uv: Any = None,
    wrap: Literal["repeat", "mirror", "clamp"] = "repeat",
    reduce: Reduce = "mean",
) -> Field:
    """Make a field of texels, shown through the texture coordinates.

    Args:
        vertices: (N, 3).
        faces: (M, 3).
        uvs: (N, 2), or None: the barycentrics of each triangle, as in rendering.
        image: (H, W), (H, W, 1) or (H, W, 3), first row at v = 0.
        to_uv: (3, 3), applied to the texture coordinates.
        wrap: Outside of the unit square.
        reduce: How colours become one value.

    Raises:
        ValueError: The image has another shape, or there is not one texture coordinate a vertex.
    """
    vertices, faces, texels = as_array(vertices), np.asarray(faces, dtype=np.int64), as_array(image)
    if texels.ndim not in (2, 3) or texels.size == 0:
        raise ValueError(f"got an image of shape {texels.shape}; expected (H, W), (H, W, 1) or (H, W, 3)")
    if uvs is None:
        vertices = vertices[faces].reshape(-1, 3)
        faces = np.arange(len(vertices)).reshape(-1, 3)
        uvs = np.tile([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], (len(faces), 1))
    coordinates = as_array(uvs)
    if coordinates.shape != (len(vertices), 2):
        raise ValueError(f"got texture coordinates of shape {coordinates.shape}; expected ({len(vertices)}, 2)")
    if to_uv is not None:
        matrix = as_array(to_uv)
        coordinates = coordinates @ matrix[:2, :2].T + matrix[:2, 2]
    values = texels if texels.ndim == 2 else to_signed(texels, reduce=reduce)
    quantity = "" if texels.ndim == 2 else _channels(texels, reduce)
    return Field(vertices, faces, values, "texel", quantity, coordinates, wrap)


def _channels(values: np.ndarray, reduce: Reduce) -> str:
    return f"{reduce} of RGB" if values.shape[-1] == 3 else ""


def environment_field(
    image: Any,
    to_world: Any = None,
    *,
    center: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
    radius: float = 1.0,
    reduce: Reduce = "mean",
) -> Field:
    """Make a field of an environment map's texels on a sphere, each in the direction that it lights from.

    Args:
        image: (H, W) or (H, W, 1 or 3), latitude and longitude: the first row is +y, the middle of a row -z.
        to_world: (4, 4) rotation of the map; identity when missing.
        center: Of the sphere.
        radius: Of the sphere.
        reduce: How colours become one value.
    """
    texels = as_array(image)
    columns, rows = 96, 49
    longitude, v = np.meshgrid(np.linspace(0.0, 1.0, columns + 1), np.linspace(0.0, 1.0, rows))
    phi, theta = 2.0 * math.pi * longitude, math.pi * v
    local = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=-1).reshape(-1, 3)
    rotation = np.eye(3) if to_world is None else as_array(to_world)[:3, :3]
    world = local @ rotation.T
    corner = (np.arange(rows - 1)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    quads = np.stack([corner, corner + 1, corner + columns + 2, corner + columns + 1], axis=1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    if np.linalg.det(rotation) > 0.0:  # the front is inside, whatever the handedness
        faces = faces[:, ::-1]
    # The rows' centres reach both poles, the columns' centres lie half a texel inside.
    height = max(texels.shape[0], 1)
    uvs = np.stack([longitude.reshape(-1), (v.reshape(-1) * (height - 1) + 0.5) / height], axis=1)
    return texture_field(np.asarray(center) + radius * world, faces, uvs, texels, reduce=reduce)


def arrows(
    vertices: Any,
    vectors: Any,
    *,
    normals: Any = None,
    unsure: Any = None,
    count: int = 160,
    length: float | None = None,
    limit: float | None = None,
    percentile: float = 99.0,
) -> Arrows:
    """Choose and scale arrows that stay legible: the largest vector of each cell of a grid over the surface.

    Args:
        vertices: (N, 3).
        vectors: (N, 3), in any unit; those that are not finite are left out, as those below 2 % of the limit.
        normals: (N, 3); an arrow against its normal ends at the vertex, others start there.
        unsure: (N,), which vectors noise may have made.
        count: About as many arrows as wanted; never more than twice that.
        length: Of the longest arrow, in the unit of the vertices; a tenth of the bounding box's diagonal when missing.
        limit: Magnitude that the longest arrow stands for; longer vectors are cut to it.
        percentile: Of the magnitudes, the limit when none is given.

    Raises:
        ValueError: Vertices and vectors differ in shape, or ``count`` is below 1.
    """
    vertices, vectors = as_array(vertices), as_array(vectors)
    if vertices.shape != vectors.shape or vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"got vertices {vertices.shape} and vectors {vectors.shape}; expected (N, 3) twice")
    if count < 1:
        raise ValueError(f"got count {count}; expected at least 1")
    magnitude = np.linalg.norm(vectors, axis=1)
    if limit is None:
        limit = symmetric_limit(magnitude, percentile)
    low = vertices.min(axis=0)
    extent = np.maximum(vertices.max(axis=0) - low, 1e-12)
    chosen = np.flatnonzero(np.isfinite(magnitude) & (magnitude > 0.02 * limit))
    cells = max(int(math.sqrt(count)), 1)
    while True:  # coarser until few enough: how many cells a surface meets depends on its shape
        cell = np.floor((vertices[chosen] - low) / extent.max() * cells * 0.9999).astype(np.int64)
        order = np.lexsort((chosen, -magnitude[chosen]))
        _, first = np.unique(cell[order], axis=0, return_index=True)
        if len(first) <= 2 * count or cells == 1:
            break
        cells = max(int(cells * 0.8), 1)
    kept = np.sort(chosen[order[first]])
    scale = (0.1 * float(np.linalg.norm(extent)) if length is None else length) / limit
    drawn = vectors[kept] * (scale * np.minimum(1.0, limit / np.maximum(magnitude[kept], 1e-30)))[:, None]
    starts = vertices[kept].copy()
    if normals is not None:
        inwards = np.einsum("ij,ij->i", drawn, as_array(normals)[kept]) < 0.0
        starts[inwards] -= drawn[inwards]
    return Arrows(starts, drawn, np.zeros(len(kept), bool) if unsure is None else np.asarray(unsure, bool)[kept])
