"""Shapes: geometry in world space with its scattering model and its light."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.scene import sensors
from warp_psdr.scene.context import FileName
from warp_psdr.scene.description import EmitterDescription, ShapeDescription
from warp_psdr.scene.errors import ReportedError, error
from warp_psdr.scene.files.mesh_files import read_mesh
from warp_psdr.scene.files.mtl_pictures import first_picture
from warp_psdr.scene.kinds.kind import Geometry
from warp_psdr.scene.kinds.records import shape_of
from warp_psdr.scene.kinds.table import EXACT, TESSELLATED, kind_of
from warp_psdr.scene.lights import emitters
from warp_psdr.scene.materials import bsdfs
from warp_psdr.scene.materials.textures import check_attribute
from warp_psdr.scene.media import coefficients as media
from warp_psdr.scene.origin import collapses, moved
from warp_psdr.scene.plugins import Properties
from warp_psdr.scene.shapes.meshes import MeshData, check, check_flat, drop_flat_triangles, in_place, vertex_normals
from warp_psdr.scene.shapes.primitives import DEFAULT_RESOLUTION, MAX_RESOLUTION, MIN_RESOLUTION
from warp_psdr.scene.transforms import transform_normals, transform_points

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from warp_psdr.scene.context import Context

#: A mesh has a pose where its vertices are no farther than so many of its extents from the origin of its own
#: coordinates: float32 keeps their digits.
FARTHEST = 1.0e3
#: Formats whose texture coordinates count v from the bottom (glTF does so after trimesh's reader); the first row of a
#: bitmap lies at v = 0, so v is flipped unless ``flip_tex_coords`` says otherwise.
FLIP_TEX_COORDS = ("obj", "gltf", "glb")
#: Textures that are read by texture coordinates.
_READ_UV = ("bitmap", "checkerboard")


def build(node: dict, where: str, path: str, context: Context) -> ShapeDescription:
    """Return the shape that a plugin dictionary describes.

    Args:
        node: The dictionary, references resolved.
        where: Its place, for messages.
        path: The name under which its parameters are listed.
        context: The load in progress.

    Raises:
        ValueError: If a parameter or the geometry cannot be used.
        FileNotFoundError: If its file does not exist.
    """
    props = Properties(node, where, path, context)
    props.ignore("silhouette_sampling_weight", reason="boundary sampling is set up by the integrator")
    kind = context.attempt(lambda: kind_of(props), None)
    flip, flat = props.boolean("flip_normals", False), props.boolean("face_normals", False)
    geometry = context.attempt(lambda: _geometry(props, kind), None)
    lights = props.children("emitter")
    meters = props.children("sensor")
    bsdf = _bsdf(props, shines=bool(lights))
    carried = _carried_light(props, lights)
    emitter = None if carried else _light(props, lights)
    if geometry is not None and props.type == "obj":
        _note_picture(props, bsdf)
    sides = media.take_sides(props, bsdf)
    meter = None
    if meters:
        key, inner, place = meters[0]
        meter = context.attempt(lambda: sensors.build_meter(inner, place, f"{path}.{key}", context), None)
    props.finish()
    if geometry is None:
        raise ReportedError(where)
    data, to_world, place = geometry
    to_world = moved(to_world, context.origin)
    if isinstance(data, MeshData):
        shape = _triangles(props, data, to_world, place, bsdf, emitter, flat)
    else:
        shines = emitter is not None and not (data.shines and emitter.kind == "area")
        _refuse_beside(props, data, bsdf, shines, bool(meters), any(sides.values()))
        shape = shape_of(props, data, to_world, bsdf)
        if not data.has_uv:
            _refuse_textures(props, bsdf, data.instead)
    # A mirrored sphere is inside out in Mitsuba; its other shapes keep their side.
    mirrored_sphere = props.type == "sphere" and bool(np.linalg.det(to_world[:3, :3]) < 0.0)
    shape.flip_normals = flip != mirrored_sphere
    if emitter is not None and emitter.kind == "directionalarea":
        check_flat(shape, lights[0][2])
    shape.emitter, shape.carried = emitter, carried
    shape.sensor = meter
    shape.interior, shape.exterior = sides["interior"], sides["exterior"]
    if emitter is not None:
        check_attribute(emitter.radiance, shape.attributes, lights[0][2], 0.0, np.inf, False)
    has_uv = shape.texcoords is not None if shape.geometry is None else shape.geometry.has_uv
    bsdfs.check_shape(bsdf, shape.attributes, has_uv, where)
    return shape


def _triangles(
    props: Properties,
    data: MeshData,
    to_world: np.ndarray,
    place: str,
    bsdf: bsdfs.BsdfDescription,
    emitter: EmitterDescription | None,
    flat: bool,
) -> ShapeDescription:
    """Return the shape that a mesh makes in world space; ``place`` is the mesh's, for messages."""
    check(data, place)
    if emitter is not None and emitter.kind == "area" and props.type in EXACT:
        data.vertices = data.vertices * EXACT[props.type].widening(data.vertices, data.faces, to_world)
    flat |= data.face_normals and not props.has("face_normals")
    if flat:
        data.normals = None
    shape = _place(props, data, to_world, bsdf, flat=flat)
    shape.attributes = data.attributes
    if props.type in TESSELLATED:
        shape.to_world = to_world.astype(np.float32)
        shape.local_vertices = data.vertices.astype(np.float32)
        shape.local_normals = None if data.normals is None else data.normals.astype(np.float32)
    elif _has_pose(to_world, shape.vertices):
        shape.to_world = to_world.astype(np.float32)
    return shape


def _has_pose(to_world: np.ndarray, vertices: np.ndarray) -> bool:
    """Return whether a mesh's own coordinates can be found from the world's, with their digits."""
    extent = float(np.ptp(vertices, axis=0).max())
    return float(np.abs(vertices - to_world[:3, 3]).max()) <= FARTHEST * extent


def _refuse_beside(
    props: Properties, geometry: Geometry, bsdf: bsdfs.BsdfDescription, shines: bool, measures: bool, encloses: bool
) -> None:
    """Raise for what shapes without triangles do not do yet.

    Raises:
        ValueError: with what does.
    """
    found = {
        "an emitter but 'area'" if geometry.shines else "an emitter": shines,
        "a sensor": measures,
        "a medium": encloses and not geometry.bounds_media,
        "a 'bumpmap'": any("bumpmap" in (side.model, *side.children) for side in bsdf.sides),
    }
    for what in (what for what, there in found.items() if there):
        raise error(props.where, f"{what} on {geometry.title}", geometry.instead)


def _refuse_textures(props: Properties, bsdf: bsdfs.BsdfDescription, instead: str) -> None:
    """Raise for a material that reads texture coordinates, which there are none of.

    Raises:
        ValueError: with ``instead``.
    """
    for side in bsdf.sides:
        for name, texture in side.textures.items():
            if texture.kind in _READ_UV:
                problem = f"a '{texture.kind}' for '{name}' on a '{props.type}', which has no texture coordinates"
                raise error(props.where, problem, f"give a number, a colour or a 'volume', or {instead}")
        if any(side.textures.get(u) is not side.textures.get(v) for u, v in bsdfs.model_of(side).axes):
            problem = f"two roughnesses on a '{props.type}', which has no texture coordinates to align them with"
            raise error(props.where, problem, "give one 'alpha'")


def _geometry(props: Properties, kind: type[Geometry] | None) -> tuple[MeshData | Geometry, np.ndarray, str]:
    """Return the object-space geometry, the transformation to world space, and the mesh's place for messages."""
    to_world = props.transform("to_world")
    if kind is not None:
        return *kind.read(props, to_world), props.where
    if props.type in TESSELLATED:
        resolution, frame = DEFAULT_RESOLUTION, np.eye(4)
        if props.type in EXACT:
            resolution = props.integer("resolution", DEFAULT_RESOLUTION, minimum=MIN_RESOLUTION, maximum=MAX_RESOLUTION)
            frame = EXACT[props.type].frame(props)
        source = TESSELLATED[props.type](resolution)
        data = MeshData(source.vertices, source.faces, source.normals, source.texcoords)
        return data, to_world @ frame, props.where
    if props.type == "mesh":
        return in_place(props), to_world, props.where
    name = props.take("filename")
    if name is None:
        raise error(props.where, f"a '{props.type}' without 'filename'", "name the mesh file")
    file = props.context.file(name, props.place("filename"))
    index = props.integer("shape_index", 0, minimum=0) if props.type == "serialized" else 0
    data = read_mesh(props.type, file, props.where, props.context.note, index, _finder(props, file))
    place = f"{props.where}, file '{file}'"
    if props.type in ("gltf", "glb"):
        props.context.note(f"{place}: materials of glTF files are ignored; the shape's bsdf is used")
    props.context.count(data.vertices.size + data.faces.size, props.where)
    # Only serialized meshes have no such parameter.
    if (
        props.type != "serialized"
        and props.boolean("flip_tex_coords", props.type in FLIP_TEX_COORDS)
        and data.texcoords is not None
    ):
        data.texcoords = np.stack([data.texcoords[:, 0], 1.0 - data.texcoords[:, 1]], axis=1)
    return data, to_world, place


def _place(
    props: Properties, data: MeshData, to_world: np.ndarray, bsdf: bsdfs.BsdfDescription, *, flat: bool
) -> ShapeDescription:
    """Move the mesh to world space, repair it and give it its normals."""
    repairs: dict[str, int] = {}
    normals = data.normals
    if (normals is not None or props.type in TESSELLATED) and np.linalg.det(to_world[:3, :3]) < 0.0:
        # Mirroring turns the triangles over but not the given normals; turn the triangles back to agree with them.
        data.faces = data.faces[:, ::-1]
    data.faces = np.ascontiguousarray(data.faces, dtype=np.int32)
    local = data.vertices
    world = transform_points(to_world, local)
    # Far away float32 collapses triangles; that is put right once the scene's place is known (``origin``).
    with np.errstate(over="ignore"):  # what overflows becomes infinite, which the check reports
        data.vertices = world if collapses(world) else world.astype(np.float32)
    check(data, f"{props.where}, after to_world")
    dropped = drop_flat_triangles(data, props.where)
    if dropped:
        repairs["zero-area triangles dropped"] = dropped
    computed = normals is None and not flat
    world_normals = None
    if computed:
        world_normals = vertex_normals(data.vertices, data.faces)
    elif normals is not None:
        lengths = np.linalg.norm(normals, axis=1)
        world_normals = transform_normals(to_world, normals)
        missing = lengths < 1e-12
        if missing.any():
            world_normals[missing] = vertex_normals(data.vertices, data.faces)[missing]
            repairs["vertex normals of length zero replaced"] = int(missing.sum())
    for what, count in repairs.items():
        props.context.note(f"{props.where}: {count} {what}")
    shape = ShapeDescription(
        path=props.path,
        kind=props.type,
        vertices=world.astype(np.float32),
        faces=data.faces,
        bsdf=bsdf,
        normals=None if world_normals is None else world_normals.astype(np.float32),
        # A cube's normals are those of its sides, so they follow when its vertices are moved, as Mitsuba's do.
        normals_computed=computed or (props.type == "cube" and normals is not None),
        texcoords=None if data.texcoords is None else np.ascontiguousarray(data.texcoords, dtype=np.float32),
        repairs=repairs,
    )
    data.vertices = local
    return shape


def _bsdf(props: Properties, *, shines: bool) -> bsdfs.BsdfDescription:
    nested = props.children("bsdf")
    plain = bsdfs.default(f"{props.path}.bsdf", shines)
    if not nested:
        return plain
    key, node, where = nested[0]
    shared = node is not props.node[key]
    return props.context.attempt(
        lambda: bsdfs.build(node, where, f"{props.path}.bsdf", props.context, shared=shared), plain
    )


def _finder(props: Properties, file: Path) -> Callable[[str], Path]:
    """Return what finds the files that a mesh file names, as all others of a scene are found."""
    return lambda name: props.context.file(FileName(name, file.parent), f"{props.where}, file '{file}'")


def _note_picture(props: Properties, bsdf: bsdfs.BsdfDescription) -> None:
    """Note that the pictures of a file's own materials are left out, unless the shape has one of its own."""
    if any(leaf.kind == "bitmap" for side in bsdf.sides for t in side.textures.values() for leaf in t.leaves):
        return
    file = props.context.file(props.node["filename"], props.place("filename"))
    name = first_picture(file, _finder(props, file))
    if name:
        props.context.note(
            f"{props.where}: the materials of the mesh are ignored, and with them pictures such as '{name}' (map_Kd); "
            "name it in the shape's bsdf, {'type': 'diffuse', 'reflectance': {'type': 'bitmap', 'filename': "
            f"'{name}'}}}}, or take the materials over with psdr.load_mesh"
        )


def _carried_light(props: Properties, nested: list[tuple[str, dict, str]]) -> EmitterDescription | None:
    """Return the light that a shape has, but whose surface does not shine; None: there is none."""
    if not nested or nested[0][1]["type"] not in emitters.CARRIED:
        return None
    key, node, where = nested[0]
    if node is not props.node[key]:  # a reference: it is in the scene already
        return None
    return props.context.attempt(lambda: emitters.build(node, where, f"{props.path}.emitter", props.context), None)


def _light(props: Properties, nested: list[tuple[str, dict, str]]) -> EmitterDescription | None:
    if not nested:
        return None
    key, node, where = nested[0]
    shared = node is not props.node[key]

    def build_light() -> EmitterDescription:
        light = emitters.build_area(node, where, f"{props.path}.emitter", props.context, shared=shared)
        props.context.attach(light, props.path, where)
        return light

    return props.context.attempt(build_light, None)
