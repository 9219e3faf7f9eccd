"""Mesh files with their materials as parts of a scene dictionary, and a scene around one of them."""

from __future__ import annotations

import math
import os
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.scene.context import Context, Outside
from warp_psdr.scene.errors import SceneError, error, listing
from warp_psdr.scene.files.dictionary import describe_dict
from warp_psdr.scene.files.gltf_materials import read_gltf_materials
from warp_psdr.scene.files.material_files import Images, two_sided
from warp_psdr.scene.files.mesh_files import read_mesh
from warp_psdr.scene.files.mtl_files import Surface, read_mtl
from warp_psdr.scene.load import SceneWarning, load_dict
from warp_psdr.scene.shapes.meshes import MeshData
from warp_psdr.scene.shapes.reading import FLIP_TEX_COORDS
from warp_psdr.scene.transforms import Transform

if TYPE_CHECKING:
    import warp as wp

    from warp_psdr.scene.scene import Scene

_KINDS = ("obj", "gltf", "glb", "ply", "stl", "off", "serialized")
#: Of a camera of ``preview_scene``: the vertical angle, and the direction in which the mesh lies, y up.
_FOV, _FORWARD = 35.0, (-0.55, -0.35, -0.75)
#: Half the side of the floor, and the gap above it, in radii of the mesh; what touches has a boundary term of its own.
_FLOOR, _GAP = 4.0, 1.0e-3
#: The lamp: direction of its light, y up, its distance and half its side in radii of the mesh. It has an area, for no
#: path finds a light without one behind glass or a mask.
_LAMP, _DISTANCE, _SIDE = (-0.5, -1.0, -0.25), 8.0, 0.8
#: Radiance of the sky, and irradiance at the mesh by the lamp: a white floor has a radiance near 1.
_SKY, _IRRADIANCE = 0.5, 2.0


def load_mesh(
    path: str | os.PathLike[str],
    bsdf: dict[str, Any] | None = None,
    *,
    to_world: Any = None,
    name: str | None = None,
    allow_outside: Outside = False,
) -> dict[str, Any]:
    """Read a mesh file with its materials, as a shape for ``psdr.load_dict``.

    ``psdr.load_dict({"type": "scene", "vase": psdr.load_mesh("vase.obj"), ...})``. A mesh of one material is one
    shape, which has the name that the scene gives it: ``"vase.vertex_positions"``. A mesh of several is a ``merge`` of
    one shape a material, as Mitsuba splits them, and these have names of their own, of the file and of the material:
    ``"vase-leaf.vertex_positions"``, ``"vase-leaf.bsdf.brdf_0.base_color.data"``.

    MTL files: ``Kd`` and ``map_Kd`` are the colour, ``Ks`` and ``Ns`` (or ``Pr`` and ``Pm``) the gloss of a
    ``principled`` model, which is ``diffuse`` without, ``d`` and ``map_d`` the opacity, ``Ke`` light, ``norm`` a normal
    map. glTF: metalness and roughness make a ``principled`` model, with normal map, opacity and light. What is not read
    is warned of. Materials of files that know no sides are two-sided, and so is the grey of a mesh without a material.

    Args:
        path: An ``.obj``, ``.gltf``, ``.glb``, ``.ply``, ``.stl``, ``.off`` or ``.serialized`` file.
        bsdf: The scattering model of the whole mesh, in place of the file's materials.
        to_world: Where the mesh is placed: ``psdr.Transform`` or a 4 x 4 matrix.
        name: Before the names of materials, in place of the file's.
        allow_outside: Where materials and pictures that the file names may lie beside its own folder; see
            ``psdr.load_file``.

    Returns:
        A dictionary of type "mesh" or "merge"; it holds all arrays, and may be changed.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, or names a file outside of its folder.

    Warns:
        SceneWarning: Something in the file is ignored or missing.
    """
    file = Path(path)
    kind = file.suffix.lower().removeprefix(".")
    if kind not in _KINDS:
        raise ValueError(f"'{path}' is no mesh file; give one of {listing('.' + known for known in _KINDS)}")
    if not file.is_file():
        raise FileNotFoundError(f"no such mesh: '{path}'; check the name")
    context = Context("load_mesh", file.parent, allow_outside)
    data = read_mesh(kind, file, "load_mesh", context.note, find=lambda name: context.file(name, f"'{file}'"))
    flip = kind in FLIP_TEX_COORDS
    parts = {}
    place = {} if to_world is None else {"to_world": to_world}
    if bsdf is not None:
        parts[""] = _shape(data, Surface(bsdf), flip) | place
    else:
        surfaces = _surfaces(kind, file, data, context)
        for number, surface in surfaces.items():
            part = data if len(surfaces) == 1 else _part(data, number)
            parts[_free(_material_name(data, number), parts)] = _shape(part, surface, flip) | place
    for note in context.notes:
        warnings.warn(note, SceneWarning, stacklevel=2)
    if len(parts) == 1:
        return next(iter(parts.values()))
    prefix = _plain(file.stem if name is None else name)
    return {"type": "merge", **{f"{prefix}-{key}": part for key, part in parts.items()}}


def _surfaces(kind: str, file: Path, data: MeshData, context: Context) -> dict[int, Surface]:
    """Return the model of every material that a face has, by its number."""
    plain = Surface(two_sided({"type": "diffuse"}))
    materials = data.materials
    if materials is None:
        return {-1: plain}
    images = Images(context, f"'{file}'")
    found: dict[str, Surface] = {}
    if kind in ("gltf", "glb"):
        listed = read_gltf_materials(file, images)
        materials.names = [name for name, _ in listed]
        surfaces = [surface for _, surface in listed]
    else:
        for name in materials.files:
            try:
                found |= read_mtl(images.path(name), images)
            except FileNotFoundError:
                context.note(f"{images.place}: there is no file of materials '{name}'")
        for name in materials.names:
            if found and name not in found:
                context.note(f"{images.place}: no file describes the material '{name}'; it is grey")
        surfaces = [found.get(name, plain) for name in materials.names]
    used = np.unique(materials.faces).tolist()
    return {number: surfaces[number] if number >= 0 else plain for number in used}


def _material_name(data: MeshData, number: int) -> str:
    if number < 0 or data.materials is None:
        return "plain"
    return _plain(data.materials.names[number]) or f"material{number}"


def _plain(name: str) -> str:
    """Return a name without what separates the parts of a parameter's."""
    return re.sub(r"[^\w-]+", "_", name)


def _free(name: str, taken: dict[str, Any]) -> str:
    """Return a name that is not taken."""
    others = (f"{name}{i}" for i in range(2, len(taken) + 3))
    return next(other for other in (name, *others) if other not in taken)


def _part(data: MeshData, number: int) -> MeshData:
    """Return the faces of one material, and their vertices."""
    assert data.materials is not None
    chosen = data.materials.faces == number
    used, faces = np.unique(data.faces[chosen], return_inverse=True)
    attributes = {
        key: values[chosen] if key.startswith("face_") else values[used] for key, values in data.attributes.items()
    }
    return MeshData(
        data.vertices[used],
        faces.reshape(-1, 3),
        None if data.normals is None else data.normals[used],
        None if data.texcoords is None or not data.texcoords[used].any() else data.texcoords[used],
        attributes,
        data.face_normals,
    )


def _shape(data: MeshData, surface: Surface, flip: bool) -> dict[str, Any]:
    """Return a mesh as a dictionary; ``flip``: its texture coordinates count v from the bottom."""
    shape: dict[str, Any] = {"type": "mesh", "vertices": data.vertices, "faces": data.faces, **data.attributes}
    if data.normals is not None:
        shape["normals"] = data.normals
    if data.texcoords is not None:
        shape["texcoords"] = data.texcoords * [1.0, -1.0] + [0.0, 1.0] if flip else data.texcoords
    if data.face_normals:
        shape["face_normals"] = True
    shape["bsdf"] = surface.bsdf
    return shape if surface.emitter is None else shape | {"emitter": surface.emitter}


def preview_scene(
    mesh: str | os.PathLike[str] | dict[str, Any],
    *,
    resolution: int = 256,
    spp: int = 64,
    max_depth: int = 4,
    up: str = "y",
    device: str | wp.Device | None = None,
) -> Scene:
    """Put a camera, a sky, a lamp and a floor around a mesh, and load that scene.

    The shape is called ``"mesh"``: its parameters are ``"mesh.vertex_positions"``, ``"mesh.bsdf..."`` and so on, those
    of a mesh of several materials as ``load_mesh`` says. The others are ``"floor"``, ``"sky"``, ``"lamp"`` and
    ``"camera"``.

    Args:
        mesh: A mesh file, or a shape's dictionary, such as ``load_mesh`` returns.
        resolution: Width and height of the image in pixels.
        spp: Samples a pixel, where a call does not say.
        max_depth: Of paths, in segments.
        up: The mesh's axis that points up, "y" or "z".
        device: Warp device; None: Warp's current one.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the mesh cannot be read.
    """
    if up not in ("y", "z"):
        raise ValueError(f"up: got {up!r}, expected 'y' or 'z'")
    if not isinstance(mesh, dict):
        mesh = load_mesh(mesh)
    if mesh.get("type") == "scene":
        raise SceneError("mesh: got a scene; expected a shape, or call psdr.load_dict")
    shapes = describe_dict({"type": "scene", "mesh": mesh, "sky": {"type": "constant"}})
    if not shapes.shapes:
        raise error("mesh", f"a '{mesh.get('type')}' is no shape", "give a mesh file, or a shape's dictionary")
    points = np.concatenate([shape.vertices.astype(np.float64) for shape in shapes.shapes]) + shapes.origin
    low, high = points.min(axis=0), points.max(axis=0)
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    # y up -> z up: (x, y, z) becomes (x, -z, y).
    turn = np.eye(3) if up == "y" else np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    axis = turn @ [0.0, 1.0, 0.0]
    forward = turn @ (np.array(_FORWARD) / np.linalg.norm(_FORWARD))
    beam = turn @ (np.array(_LAMP) / np.linalg.norm(_LAMP))
    eye = center - forward * radius / math.sin(math.radians(0.5 * _FOV))
    ground = center + axis * (float(np.min(points @ axis)) - float(center @ axis) - _GAP * radius)
    return load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": max_depth},
            "camera": {
                "type": "perspective",
                "fov": _FOV,
                "near_clip": 1e-3 * radius,
                "to_world": Transform.look_at(origin=eye.tolist(), target=center.tolist(), up=axis.tolist()),
                "sampler": {"type": "independent", "sample_count": spp},
                "film": {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "gaussian"}},
            },
            "mesh": mesh,
            "floor": {
                "type": "rectangle",
                "to_world": Transform.look_at(
                    origin=ground.tolist(), target=(ground + axis).tolist(), up=(turn @ [0.0, 0.0, 1.0]).tolist()
                ).scale(_FLOOR * radius),
                "bsdf": two_sided({"type": "diffuse", "reflectance": 0.5}),
            },
            "sky": {"type": "constant", "radiance": _SKY},
            "lamp": {
                "type": "rectangle",
                "to_world": Transform.look_at(
                    origin=(center - _DISTANCE * radius * beam).tolist(), target=center.tolist(), up=forward.tolist()
                ).scale(_SIDE * radius),
                "emitter": {"type": "area", "radiance": _IRRADIANCE * (0.5 * _DISTANCE / _SIDE) ** 2},
            },
        },
        device=device,
    )
