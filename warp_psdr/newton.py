"""Scenes of Newton's models: what a simulation moves, as shapes that ``psdr.bind`` moves with it."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
import warp as wp

from warp_psdr.bind import Simulation, remember
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
Mesh = tuple[np.ndarray, np.ndarray, bool]


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
    ``soft0``, ``soft1``, ... in the order of their first particles. World coordinates are the model's.

    Args:
        model: finalised, on the CPU or on a CUDA device, which becomes the scene's.
        sensor: of the scene, as for ``psdr.load_dict``.
        emitters: likewise.
        bsdfs: by name, instead of two-sided ``principled`` of the model's colour.
        resolution: of the film; default: the sensor's.
        smooth: whether round and soft shapes have interpolated normals.
        **more: other objects of the scene, by name.

    Raises:
        TypeError: this is no model.
        ValueError: a name of ``bsdfs`` names nothing.

    Warns:
        SceneWarning: what is left out: height fields, Gaussians, particles that belong to no surface.
    """
    if not hasattr(model, "shape_type") or not hasattr(model, "particle_q"):
        raise TypeError(f"from_newton: got {type(model).__name__}, expected a newton.Model (builder.finalize())")
    given, used = dict(bsdfs or {}), set()
    scene: dict[str, Any] = {"type": "scene", "sensor": dict(sensor), **more}
    scene |= {f"emitter{i}": dict(emitter) for i, emitter in enumerate(emitters)}

    def bsdf_of(name: str, color: np.ndarray) -> dict[str, Any]:
        used.add(name)
        paint = {"type": "principled", "base_color": {"type": "rgb", "value": color.tolist()}, "roughness": 0.5}
        return dict(given.get(name, {"type": "twosided", "inner": paint}))

    bodies, local, left = {}, {}, []
    poses = _numpy(model.body_q, (-1, 7))
    for number, (name, mesh) in enumerate(_meshes(model)):
        if not isinstance(mesh, tuple):
            left += [f"{name} ({mesh})"] if mesh else []
            continue
        at = Transform(_matrix(_numpy(model.shape_transform, (-1, 7))[number]))
        body = int(model.shape_body.numpy()[number])
        pose = Transform(_matrix(poses[body])) @ at if body >= 0 else at
        color = _numpy(model.shape_color, (-1, 3))[number] if model.shape_color is not None else np.array(GREY)
        scene[name] = _mesh(mesh, bsdf_of(name, color), smooth) | {"to_world": pose}
        if body >= 0:
            bodies[f"{name}.to_world"], local[f"{name}.to_world"] = body, at.matrix
    particles: dict[str, np.ndarray] = {}
    places = _numpy(model.particle_q, (-1, 3))
    faces = _surfaces(model)
    for i, (numbers, own) in enumerate(_parts(faces)):
        name = f"soft{i}"
        scene[name] = _mesh((places[numbers], own, True), bsdf_of(name, np.array(GREY)), smooth)
        particles[f"{name}.vertex_positions"] = numbers
    loose = len(places) - len(np.unique(faces))
    left += [f"{loose} particles that belong to no surface"] if loose else []
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
    vertices, faces, round_or_soft = mesh
    shape = {"type": "mesh", "vertices": vertices.astype(np.float32), "faces": faces.astype(np.int32), "bsdf": bsdf}
    return shape | ({} if smooth and round_or_soft else {"face_normals": True})


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
            found.append((name, (vertices * scale, faces, False)))
        else:
            found.append((name, _primitive(int(kind), scale, extent)))
    return found


def _primitive(kind: int, scale: np.ndarray, extent: float) -> Mesh | str:
    x, y, z = (float(s) for s in scale)
    if kind == PLANE:
        x, y = (0.5 * (edge or ENDLESS * extent) for edge in (x, y))
        corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
        return corners, np.array([[0, 1, 2], [0, 2, 3]]), False
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
    return made.vertices, made.faces, kind in (SPHERE, ELLIPSOID, CAPSULE)


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
