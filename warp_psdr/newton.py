"""Scenes of Newton's models: what a simulation moves, as shapes that ``psdr.bind`` moves with it."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
import warp as wp

from warp_psdr.bind import Points, Simulation, remember
from warp_psdr.scene.load import SceneWarning, load_dict
from warp_psdr.scene.transforms import Transform

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

__all__ = ["from_newton"]

#: Numbers of Newton's kinds of shapes (``newton.GeoType``).
PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH, CONE, CONVEX = 1, 3, 4, 5, 6, 7, 8, 9, 10
#: Bit of ``shape_flags`` of what is shown.
VISIBLE = 1
#: Edge of a plane without ends, over the extent of what else there is; triangles of a circle.
ENDLESS, ROUND = 20.0, 48
#: Colour of what has none.
GREY = (0.6, 0.6, 0.6)
#: Bit of ``particle_flags`` of what moves; number of free particles up to which each is a finer ball.
ACTIVE, FEW = 1, 500


@dataclass(frozen=True)
class Mesh:
    """A mesh in its own coordinates.

    Attributes:
        vertices: (N, 3).
        faces: (F, 3).
        bends: whether it is round or soft, so that its normals may be interpolated.
        source: the ``newton.Mesh`` that it is of, which may have normals, texture coordinates and a material.
    """

    vertices: np.ndarray
    faces: np.ndarray
    bends: bool
    source: Any = None


def from_newton(
    model: Any,
    *,
    sensor: Mapping[str, Any],
    emitters: Iterable[Mapping[str, Any]] = (),
    bsdfs: Mapping[str, Mapping[str, Any]] | None = None,
    resolution: int | None = None,
    smooth: bool = True,
    **more: Mapping[str, Any],
) -> Scene:
    """Return a scene of a ``newton.Model``: shapes, cloths and soft bodies, which ``psdr.bind(params, state)`` moves.

    A shape is named by its label in the model, without what names in scenes cannot have; cloths and soft bodies are
    ``soft0``, ``soft1``, ... in the order of their first particles. Particles that belong to no surface are balls of
    their radii, which are one shape, ``particles``. World coordinates are the model's.

    Materials are two-sided ``principled`` of the model's colours; that of a ``newton.Mesh`` has its texture, roughness
    and metallic, as USD and MJCF files give them.

    Args:
        model: finalised, on the CPU or on a CUDA device, which becomes the scene's.
        sensor: of the scene, as for ``psdr.load_dict``.
        emitters: likewise.
        bsdfs: by name, instead of the model's material.
        resolution: of the film; default: the sensor's.
        smooth: whether round and soft shapes have interpolated normals.
        **more: other objects of the scene, by name.

    Raises:
        TypeError: this is no model.
        ValueError: a name of ``bsdfs`` names nothing.

    Warns:
        SceneWarning: what is left out: height fields, Gaussians, textures that have to be downloaded.
    """
    if not hasattr(model, "shape_type") or not hasattr(model, "particle_q"):
        raise TypeError(f"from_newton: got {type(model).__name__}, expected a newton.Model (builder.finalize())")
    given, used = dict(bsdfs or {}), set()
    scene: dict[str, Any] = {"type": "scene", "sensor": dict(sensor), **more}
    scene |= {f"emitter{i}": dict(emitter) for i, emitter in enumerate(emitters)}

    def bsdf_of(name: str, color: np.ndarray, source: Any = None) -> dict[str, Any]:
        used.add(name)
        return dict(given[name]) if name in given else _material(name, color, source, left)

    bodies, local, left = {}, {}, []
    poses = _numpy(model.body_q, (-1, 7))
    for number, (name, mesh) in enumerate(_meshes(model)):
        if not isinstance(mesh, Mesh):
            left += [f"{name} ({mesh})"] if mesh else []
            continue
        at = Transform(_matrix(_numpy(model.shape_transform, (-1, 7))[number]))
        body = int(model.shape_body.numpy()[number])
        pose = Transform(_matrix(poses[body])) @ at if body >= 0 else at
        color = _numpy(model.shape_color, (-1, 3))[number] if model.shape_color is not None else np.array(GREY)
        scene[name] = _mesh(mesh, bsdf_of(name, color, mesh.source), smooth) | {"to_world": pose}
        if body >= 0:
            bodies[f"{name}.to_world"], local[f"{name}.to_world"] = body, at.matrix
    particles: dict[str, Points] = {}
    places = _numpy(model.particle_q, (-1, 3))
    faces = _surfaces(model)
    for i, (numbers, own) in enumerate(_parts(faces)):
        name = f"soft{i}"
        scene[name] = _mesh(Mesh(places[numbers], own, True), bsdf_of(name, np.array(GREY)), smooth)
        particles[f"{name}.vertex_positions"] = _points(numbers, model.device)
    loose = np.setdiff1d(np.flatnonzero(_numpy(model.particle_flags, (-1,)) & ACTIVE), faces)
    if len(loose):
        balls, numbers, offsets = _balls(places, _numpy(model.particle_radius, (-1,)), loose)
        scene["particles"] = _mesh(balls, bsdf_of("particles", np.array(GREY)), smooth)
        particles["particles.vertex_positions"] = _points(numbers, model.device, offsets)
    if set(given) - used:
        raise ValueError(
            f"bsdfs: nothing is named {', '.join(sorted(set(given) - used))}; expected some of {sorted(used)}"
        )
    if left:
        warnings.warn(f"from_newton leaves out {'; '.join(left)}", SceneWarning, stacklevel=2)
    loaded = load_dict(scene, device=model.device, **({} if resolution is None else {"resolution": resolution}))
    remember(loaded, Simulation(bodies, local, particles))
    return loaded


def _mesh(mesh: Mesh, bsdf: dict[str, Any], smooth: bool) -> dict[str, Any]:
    shape: dict[str, Any] = {"type": "mesh", "vertices": mesh.vertices.astype(np.float32), "bsdf": bsdf}
    shape["faces"] = mesh.faces.astype(np.int32)
    normals = getattr(mesh.source, "normals", None)
    texcoords = _texcoords(mesh.source)
    if texcoords is not None:
        shape["texcoords"] = texcoords
    if normals is not None and len(normals) == len(mesh.vertices):
        return shape | {"normals": np.float32(normals)}
    return shape | ({} if smooth and mesh.bends else {"face_normals": True})


def _texcoords(source: Any) -> np.ndarray | None:
    """Return texture coordinates, v from the top as ours; None: the mesh has none for its vertices."""
    uvs = getattr(source, "uvs", None)
    if uvs is None or len(uvs) != len(np.asarray(source.vertices).reshape(-1, 3)):
        return None
    transform = np.asarray(getattr(source, "texture_transform", np.eye(2, 3)), float)
    u, v = transform[:, :2] @ np.asarray(uvs, float).T + transform[:, 2:]
    return np.stack([u, 1.0 - v], axis=1).astype(np.float32)


def _material(name: str, color: np.ndarray, source: Any, left: list[str]) -> dict[str, Any]:
    """Return the material of a shape; what cannot be had of it is added to ``left``."""
    texture = getattr(source, "texture", None) if _texcoords(source) is not None else None
    base: dict[str, Any] = {"type": "rgb", "value": color.tolist()}
    if isinstance(texture, str) and "://" in texture:
        left.append(f"the texture of {name} ({texture})")
    elif isinstance(texture, str):
        base = {"type": "bitmap", "filename": texture}
    elif texture is not None:
        base = {"type": "bitmap", "data": texture[..., :3] if texture.ndim == 3 else texture}
    given = {key: getattr(source, key, None) for key in ("roughness", "metallic")}
    numbers = {"roughness": 0.5} | {key: float(value) for key, value in given.items() if value is not None}
    return {"type": "twosided", "inner": {"type": "principled", "base_color": base, **numbers}}


def _points(numbers: np.ndarray, device: wp.Device, offsets: np.ndarray | None = None) -> Points:
    """Return the particles that vertices go with, on a device."""
    places = wp.array(numbers.astype(np.int32), dtype=wp.int32, device=device)
    apart = None if offsets is None else wp.array(offsets, dtype=wp.vec3, device=device)
    return Points(places, int(numbers.max()) + 1, apart)


def _balls(places: np.ndarray, radii: np.ndarray, which: np.ndarray) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """Return a ball for each of the particles, as one mesh, and each vertex's particle and way from there."""
    one = trimesh.creation.icosphere(subdivisions=2 if len(which) <= FEW else 1)
    n = len(one.vertices)
    numbers = np.repeat(which, n)
    offsets = radii[numbers, None] * np.tile(one.vertices, (len(which), 1))
    faces = one.faces + n * np.arange(len(which))[:, None, None]
    return Mesh(places[numbers] + offsets, faces.reshape(-1, 3), True), numbers, offsets.astype(np.float32)


def _numpy(array: wp.array | None, shape: tuple[int, ...]) -> np.ndarray:
    return np.zeros((0, *shape[1:]), np.float32) if array is None else array.numpy().reshape(shape)


def _matrix(transform: np.ndarray) -> np.ndarray:
    """Return the matrix of a position and a quaternion (x, y, z, w)."""
    return np.array(wp.transform_to_matrix(wp.transform(*transform.tolist())), np.float64).reshape(4, 4)


def _name(label: str, taken: set[str]) -> str:
    """Return a name of its own that a scene can have."""
    base = "".join(c if c.isalnum() or c in "_-" else "_" for c in label).strip("_") or "shape"
    name, i = base, 2
    while name in taken:
        name, i = f"{base}_{i}", i + 1
    taken.add(name)
    return name


def _meshes(model: Any) -> list[tuple[str, Mesh | str]]:
    """Return the name of every shape, and its mesh in its own coordinates; a reason where there is none."""
    kinds, flags = (_numpy(array, (-1,)) for array in (model.shape_type, model.shape_flags))
    scales, extent = _numpy(model.shape_scale, (-1, 3)), _extent(model)
    taken = {"sensor", "type"}
    found: list[tuple[str, Mesh | str]] = []
    for i, (kind, scale) in enumerate(zip(kinds, scales, strict=True)):
        name = _name(model.shape_label[i], taken)
        source = model.shape_source[i]
        if not flags[i] & VISIBLE:
            found.append((name, ""))
        elif kind in (MESH, CONVEX):
            vertices, faces = np.asarray(source.vertices).reshape(-1, 3), np.asarray(source.indices).reshape(-1, 3)
            found.append((name, Mesh(vertices * scale, faces, False, source)))
        else:
            found.append((name, _primitive(int(kind), scale, extent)))
    return found


def _primitive(kind: int, scale: np.ndarray, extent: float) -> Mesh | str:
    x, y, z = (float(s) for s in scale)
    if kind == PLANE:
        x, y = (0.5 * (edge or ENDLESS * extent) for edge in (x, y))
        corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
        return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), False)
    if kind == BOX:
        made = trimesh.creation.box(extents=[2.0 * x, 2.0 * y, 2.0 * z])
    elif kind in (SPHERE, ELLIPSOID):
        made = trimesh.creation.icosphere(subdivisions=4)
        made.apply_scale([x, x, x] if kind == SPHERE else [x, y, z])
    elif kind == CAPSULE:
        made = trimesh.creation.capsule(height=2.0 * y, radius=x, count=[ROUND // 2, ROUND])
        made.apply_translation([0.0, 0.0, -made.bounds.mean(axis=0)[2]])
    elif kind == CYLINDER:
        made = trimesh.creation.cylinder(radius=x, height=2.0 * y, sections=ROUND)
    elif kind == CONE:
        made = trimesh.creation.cone(radius=x, height=2.0 * y, sections=ROUND)
        made.apply_translation([0.0, 0.0, -y])
    else:
        return "a height field, a point cloud or Gaussians, which have no triangles"
    return Mesh(made.vertices, made.faces, kind in (SPHERE, ELLIPSOID, CAPSULE))


def _extent(model: Any) -> float:
    """Return the extent of bodies and particles, world units."""
    places = np.concatenate([_numpy(model.body_q, (-1, 7))[:, :3], _numpy(model.particle_q, (-1, 3))])
    return max(float(np.ptp(places, axis=0).max()), 1.0) if len(places) else 1.0


def _surfaces(model: Any) -> np.ndarray:
    """Return the triangles of cloths and of soft bodies, (N, 3) numbers of particles."""
    triangles, tets = _numpy(model.tri_indices, (-1, 3)), _numpy(model.tet_indices, (-1, 4))
    bare = tets[~np.isin(tets, triangles).any(axis=1)] if len(tets) else tets
    sides = bare[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3)
    _own, first, counts = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
    return np.concatenate([triangles, sides[first[counts == 1]]]).astype(np.int64)


def _parts(faces: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the particles of each connected surface, and its triangles by their places among them."""
    labels = np.arange(faces.max(initial=-1) + 1)
    while True:
        least = labels[faces].min(axis=1, keepdims=True)
        after = labels.copy()
        np.minimum.at(after, faces, np.broadcast_to(least, faces.shape))
        after = after[after]
        if np.array_equal(after, labels):
            break
        labels = after
    found = []
    for label in np.unique(labels[faces]):
        numbers, own = np.unique(faces[labels[faces[:, 0]] == label], return_inverse=True)
        found.append((numbers, own.reshape(-1, 3)))
    return found
