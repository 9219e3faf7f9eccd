"""From a scene description to device records and the flat array of values."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels import constants as c
from warp_psdr.kernels import structs
from warp_psdr.kernels.bsdf.dispatch import declaration_of, models_of, ordered
from warp_psdr.kernels.bsdf.model import GEOMETRY, GRADIENT, MadeTable, Value, key_of
from warp_psdr.kernels.bsdf.record import Slot, merge_values, slot_of
from warp_psdr.kernels.vertex import MediaConfig
from warp_psdr.scene.distortion import AFFINE, MODELS
from warp_psdr.scene.layout import (
    CAMERA,
    LIGHT_POSE,
    LIGHT_RADIANCE,
    MATERIAL,
    NORMALS,
    POSITIONS,
    RADIANCE,
    SHAPE_POSE,
    TEXCOORDS,
    Layout,
)
from warp_psdr.scene.lights.sky_model import TURBIDITIES
from warp_psdr.scene.lights.sunsky import SkyRecord
from warp_psdr.scene.materials.tables import PlacedTable
from warp_psdr.scene.materials.texture_records import TextureRecords, has_steps, reads_mesh
from warp_psdr.scene.media.medium_records import MediaRecords

if TYPE_CHECKING:
    from warp_psdr.scene.description import (
        BsdfDescription,
        EmitterDescription,
        SceneDescription,
        SensorDescription,
        ShapeDescription,
        SkyDescription,
    )

INF = float("inf")
RFILTERS = {"box": c.RFILTER_BOX, "tent": c.RFILTER_TENT, "gaussian": c.RFILTER_GAUSSIAN}
EMITTERS = {
    "area": c.EMITTER_AREA,
    "directionalarea": c.EMITTER_DIRECTIONAL_AREA,
    "constant": c.EMITTER_CONSTANT,
    "envmap": c.EMITTER_ENVMAP,
    "point": c.EMITTER_POINT,
    "spot": c.EMITTER_SPOT,
    "projector": c.EMITTER_PROJECTOR,
    "directional": c.EMITTER_DIRECTIONAL,
}
CAMERAS = {
    "perspective": c.CAMERA_PERSPECTIVE,
    "orthographic": c.CAMERA_ORTHOGRAPHIC,
    "thinlens": c.CAMERA_THINLENS,
    "radiancemeter": c.CAMERA_RADIANCEMETER,
    "irradiancemeter": c.CAMERA_IRRADIANCEMETER,
    "batch": c.CAMERA_BATCH,
}
DISTORTED = {
    ("perspective", "opencv"): c.CAMERA_PERSPECTIVE_OPENCV,
    ("thinlens", "opencv"): c.CAMERA_THINLENS_OPENCV,
    ("perspective", "fisheye"): c.CAMERA_PERSPECTIVE_FISHEYE,
    ("thinlens", "fisheye"): c.CAMERA_THINLENS_FISHEYE,
}


@dataclass(eq=False)
class Prototype:
    """A shape of a group: where its values start, and the numbers of the shapes that are copies of it."""

    description: ShapeDescription
    positions: int
    normals: int  #: -1: none
    texcoords: int  #: -1: none
    copies: list[int] = field(default_factory=list)


class Builder:
    """Lays a scene out; see the attributes for what it makes."""

    def __init__(self, description: SceneDescription):
        self.description = description
        self.layout = Layout()
        self.shapes: list = []  #: structs.Shape
        self.bsdfs: list = []  #: structs.Bsdf
        self.texture_records = TextureRecords(self.layout, description.shapes, self.shapes, description.origin)
        self.textures = self.texture_records.records
        self.texture_ranges = self.texture_records.ranges
        self.volume_poses = self.texture_records.poses
        self.emitters: list = []  #: structs.Emitter
        self.cameras: list = []  #: structs.Camera
        self.environment = -1
        self.sky: SkyRecord | None = None  #: of a sunsky
        self.models: tuple[str, ...] = ()  #: keys, ``ordered``
        self.bsdf_textures: list[dict[str, int]] = []  #: of each record: value name -> texture number
        self.tables: list[PlacedTable] = []
        self.slots = np.zeros(0, np.int32)  #: texture numbers, ``structs.Scene.slots``
        self.radiance_kinds: set[int] = set()
        self.two_sided = False
        self.anisotropic: set[int] = set()  #: numbers of materials that need dp/du
        self.bumped: set[int] = set()  #: numbers of materials that read how a texture rises
        self.heights: set[int] = set()  #: numbers of the bitmaps that bump maps read
        self.primitives: list[int] = []  #: numbers of the shapes without triangles, in the order of their records
        self.frames: dict[int, int] = {}  #: each of them -> flat offset of the matrix that its record holds
        self.prototypes: list[Prototype] = []
        self.pose_of: dict[int, str] = {}  #: shape with a pose -> name of the pose
        self._prototype_index: dict[int, int] = {}
        self._bsdf_keys: list[str] = []
        self._bsdf_index: dict[tuple[int, int], int] = {}
        self._geometry()
        for number, shape in enumerate(description.shapes):
            self.shapes[number].bsdf = self._bsdf(shape.bsdf, number)
        self._number_models()
        for emitter in description.emitters:
            self._emitter(emitter)
        self._media = MediaRecords(self.layout, self.textures, self.texture_ranges, self.volume_poses, description)
        self.media = self._media.records  #: structs.Medium
        self.medium_names = self._media.names
        self.super_grids = self._media.super_grids
        self.media_followers = self._media.followers
        #: Of each shape: medium outside and inside, ``medium.structs.Media.sides``; empty where there are no media.
        self.sides = [self._sides(shape) for shape in description.shapes]
        for sensor in description.sensors:
            self._camera(sensor)
        # Whatever reads an offset of an absent value must not leave the array.
        self.layout.add_values(np.zeros(16, np.float32))

    # -- shapes ----------------------------------------------------------------------------------------------------

    def _geometry(self) -> None:
        shapes = self.description.shapes
        vertex, face = 0, 0
        faces, face_shape = [np.zeros((0, 3), np.int32)], [np.zeros(0, np.int32)]
        # Positions of all shapes first and in one stretch: the ray structure reads them in place.
        self.positions = self.layout.add_values(np.zeros(0))
        for number, s in enumerate(shapes):
            if s.geometry is not None:
                self.primitives.append(number)
            if s.prototype is not None or s.geometry is not None:
                offset = self.layout.add_values(s.vertices)
            else:
                offset = self.layout.add(
                    f"{s.path}.vertex_positions", s.vertices, POSITIONS, dtype=wp.vec3, owner=number, placed=True
                )
            record = structs.Shape()
            record.emitter = -1
            record.orientation = -1.0 if s.flip_normals else 1.0
            record.first_face, record.face_count = face, len(s.faces)
            record.first_vertex, record.vertex_count = vertex, len(s.vertices)
            assert offset == self.positions + 3 * vertex
            faces.append(s.faces.astype(np.int32) + vertex)
            face_shape.append(np.full(len(s.faces), number, np.int32))
            vertex += len(s.vertices)
            face += len(s.faces)
            self.shapes.append(record)
        self.vertex_count = vertex
        self.indices = np.concatenate(faces)
        self.face_shape = np.concatenate(face_shape)
        for number, (s, record) in enumerate(zip(shapes, self.shapes, strict=True)):
            if s.prototype is not None:
                self._copy_values(s, s.prototype, record, number)
            else:
                self._shape_values(s, record, number)

    def _shape_values(self, s: ShapeDescription, record, number: int) -> None:
        if s.normals is not None:
            offset = self.layout.add(f"{s.path}.vertex_normals", s.normals, NORMALS, dtype=wp.vec3, owner=number)
            record.smooth = 1
            record.normal_offset = offset - 3 * record.first_vertex
        if s.texcoords is not None:
            offset = self.layout.add(f"{s.path}.vertex_texcoords", s.texcoords, TEXCOORDS, dtype=wp.vec2, owner=number)
            record.has_uv = 1
            record.uv_offset = offset - 2 * record.first_vertex
        if s.to_world is not None:
            self.pose_of[number] = f"{s.instance or s.path}.to_world"
            pose = self.layout.add(self.pose_of[number], s.to_world, SHAPE_POSE, owner=number, placed=True)
            if s.geometry is not None:
                self.frames[number] = s.geometry.lay(self.layout, s.path, number, pose)

    def _copy_values(self, s: ShapeDescription, source: ShapeDescription, record, number: int) -> None:
        """Lay out what a copy by an instance has of its own, and what it shares unless another copy has."""
        if id(source) not in self._prototype_index:
            self._prototype_index[id(source)] = len(self.prototypes)
            self.prototypes.append(self._prototype(source, len(self.prototypes), number))
        prototype = self.prototypes[self._prototype_index[id(source)]]
        prototype.copies.append(number)
        if s.normals is not None:
            record.smooth = 1
            record.normal_offset = self.layout.add_values(s.normals) - 3 * record.first_vertex
        if prototype.texcoords >= 0:
            record.has_uv = 1
            record.uv_offset = prototype.texcoords - 2 * record.first_vertex
        for kind in ("vertex_positions", "vertex_normals", "vertex_texcoords"):
            if f"{source.path}.{kind}" in self.layout.parameters:
                self.layout.parameters[f"{source.path}.{kind}"].copies += (number,)
        name = f"{s.instance}.to_world"
        if name not in self.layout.parameters:
            assert s.to_world is not None
            self.layout.add(name, s.to_world, SHAPE_POSE, owner=number, placed=True)
        self.layout.parameters[name].copies += (number,)
        self.pose_of[number] = name

    def _prototype(self, s: ShapeDescription, index: int, owner: int) -> Prototype:
        """Lay out a shape of a group."""
        offsets: list[int] = []
        for kind, values, use, dtype in (
            ("vertex_positions", s.vertices, POSITIONS, wp.vec3),
            ("vertex_normals", s.normals, NORMALS, wp.vec3),
            ("vertex_texcoords", s.texcoords, TEXCOORDS, wp.vec2),
        ):
            offsets.append(-1)
            if values is not None:
                name = f"{s.path}.{kind}"
                offsets[-1] = self.layout.add(name, values, use, dtype=dtype, owner=owner)
                self.layout.parameters[name].prototype = index
        positions, normals, texcoords = offsets
        return Prototype(s, positions, normals, texcoords)

    # -- materials -------------------------------------------------------------------------------------------------

    def _bsdf(self, b: BsdfDescription, shape: int) -> int:
        on_mesh = any(reads_mesh(t) for t in b.textures.values()) or (
            b.back is not None and any(reads_mesh(t) for t in b.back.textures.values())
        )
        key = (id(b), shape if on_mesh else -1)
        if key in self._bsdf_index:
            return self._bsdf_index[key]
        record = structs.Bsdf()
        record.two_sided = int(b.two_sided)
        self.two_sided |= b.two_sided
        textures = {}
        bsdf_key = key_of(b.model, b.variant, b.children)
        model = declaration_of(bsdf_key)[0]
        for value in model.values:
            if value.size or value.source in GEOMETRY:
                continue
            t = b.textures.get(value.name)
            bounds = (value.low, value.high)
            absent = b.fixed.get(value.name, 1.0)
            textures[value.name] = (
                self.texture_records.absent(absent)
                if t is None
                else self.texture_records.number(t, MATERIAL + value.name, bounds, shape)
            )
        for table in model.tables(b.variant):
            textures[table.name] = self._table(table, textures)
        number = len(self.bsdfs)
        if model.framed or model.brushed or any(textures[u] != textures[v] for u, v in model.axes):
            self.anisotropic.add(number)
        heights = {textures[value.name] for value in model.values if value.source == GRADIENT}
        if heights:
            self.bumped.add(number)
            self.heights |= {n for n in heights if self.textures[n].kind == c.TEXTURE_BITMAP}
        self.bsdfs.append(record)
        self.bsdf_textures.append(textures)
        self._bsdf_keys.append(bsdf_key)
        self._bsdf_index[key] = number
        record.back = number if b.back is None else self._bsdf(b.back, shape)
        return number

    def _table(self, table: MadeTable, textures: dict[str, int]) -> int:
        """Return the number of the record that says where a material's table lies; it is filled later."""
        record = structs.Texture()
        record.offset = self.layout.add_values(np.zeros(table.size))
        sources = tuple(self.textures[textures[name]].offset for name in table.of)
        self.tables.append(PlacedTable(table.maker, table.variant, record.offset, sources))
        return self.texture_records.add(record, (record.offset, table.size))

    def textures_of(self, shape: structs.Shape) -> list[structs.Texture]:
        """Return the records of all textures on a shape: of both sides, of its light, and those nested in them."""
        sides = (shape.bsdf, self.bsdfs[shape.bsdf].back)
        numbers = {number for side in sides for number in self.bsdf_textures[side].values()}
        if shape.emitter >= 0:
            numbers.add(self.emitters[shape.emitter].texture)
        found = [self.textures[n] for n in sorted(numbers)]
        for t in found:
            found += [self.textures[n] for n in self.texture_records.nested_in(t)]
        return found

    @functools.cached_property
    def stepped(self) -> dict[int, tuple[int, ...]]:
        """The numbers of the textures that jump inside of triangles, of every shape that has some."""
        number = {id(t): i for i, t in enumerate(self.textures) if has_steps(t)}
        if not number:
            return {}
        found = {i: {number.get(id(t), -1) for t in self.textures_of(shape)} for i, shape in enumerate(self.shapes)}
        return {i: tuple(sorted(numbers - {-1})) for i, numbers in found.items() if numbers - {-1}}

    def _number_models(self) -> None:
        """Number the models that occur, and lay out their textures alike: one number for each value that any has."""
        self.models = ordered(self._bsdf_keys)
        self.values: tuple[Value, ...] = merge_values(models_of(self.models))
        numbers = [[textures.get(value.name, -1) for value in self.values] for textures in self.bsdf_textures]
        self.slots = np.array(numbers, np.int32).reshape(-1)
        for i, (record, key) in enumerate(zip(self.bsdfs, self._bsdf_keys, strict=True)):
            record.model = self.models.index(key)
            record.slots = i * len(self.values)
            record.varied = int(
                any(self.textures[n].kind != c.TEXTURE_CONSTANT for n in self.bsdf_textures[i].values())
            )
            model = declaration_of(key)[0]
            record.lobes = sum(1 << lobe for lobe in (*model.lobes, *([c.LOBE_BEHIND] if model.passes else [])))

    @property
    def material(self) -> tuple[Slot, ...]:
        """Values of the materials and the kinds of their textures, as the path loop is compiled for them."""
        kinds = {value.name: set() for value in self.values}
        for textures in self.bsdf_textures:
            for name, number in textures.items():
                kinds[name] |= self.texture_records.kinds_of(number)
        return tuple(slot_of(value, tuple(sorted(kinds[value.name]))) for value in self.values)

    # -- lights and cameras ----------------------------------------------------------------------------------------

    def _emitter(self, e: EmitterDescription) -> None:
        record = structs.Emitter()
        record.kind = EMITTERS[e.kind]
        number = len(self.emitters)
        bounds = (0.0, INF)
        if e.kind in ("area", "directionalarea"):
            shape = next(i for i, s in enumerate(self.description.shapes) if s.emitter is e)
            record.shape = shape
            record.first_face, record.face_count = self.shapes[shape].first_face, self.shapes[shape].face_count
            if shape in self.primitives:  # its record stands behind those of the triangles
                record.first_face, record.face_count = len(self.indices) + self.primitives.index(shape), 1
        if e.sky is not None:
            self._light_of_sky(e, e.sky, record)
            self.emitters.append(record)
            return
        if e.kind == "area":
            self.shapes[shape].emitter = number  # what a ray can meet
            record.texture = self.texture_records.number(e.radiance, RADIANCE, bounds, shape)
            self.radiance_kinds |= self.texture_records.kinds_of(record.texture)
        else:
            record.texture = self.texture_records.number(e.radiance, LIGHT_RADIANCE, bounds)
        if e.kind in ("constant", "envmap"):
            self.environment = number
        if e.kind in ("envmap", "projector"):
            record.scale = self.layout.add(f"{e.path}.scale", np.array([e.scale]), LIGHT_RADIANCE, bounds=bounds)
        if e.to_world is not None:
            # Of the others only the directions count.
            placed = e.kind in ("spot", "projector")
            record.to_world = self.layout.add(f"{e.path}.to_world", e.to_world, LIGHT_POSE, placed=placed)
        if e.position is not None:
            record.to_world = self.layout.add(f"{e.path}.position", e.position, LIGHT_POSE, placed=True)
        if e.projected is not None:
            record.kind = c.EMITTER_TEXTURED_SPOT
            record.projected = self.texture_records.number(e.projected, LIGHT_RADIANCE, bounds)
        if e.kind == "projector":
            fov = np.array([e.x_fov])
            record.cutoff = self.layout.add(f"{e.path}.x_fov", fov, LIGHT_POSE, bounds=(1e-3, 179.0))
        if e.kind == "spot":
            # The kernels read both angles from one offset.
            record.cutoff = self.layout.add_values(np.array([e.cutoff_angle, e.beam_width]))
            for i, name in enumerate(("cutoff_angle", "beam_width")):
                self.layout.name(f"{e.path}.{name}", record.cutoff + i, (1,), LIGHT_POSE, bounds=(0.0, 90.0))
        self.emitters.append(record)

    def _light_of_sky(self, e: EmitterDescription, sky: SkyDescription, record: structs.Emitter) -> None:
        """Lay out the map of a clear sky, with its parameters, or its sun."""
        t = e.radiance
        record.texture = self.texture_records.derived(t)
        if e.kind == "envmap":
            assert e.to_world is not None
            self.environment = len(self.emitters)
            add, path, at = self.layout.add, sky.path, {}
            record.scale = add(f"{path}.sky_scale", np.array([sky.sky_scale]), LIGHT_RADIANCE, bounds=(0.0, INF))
            at["pose"] = record.to_world = add(f"{path}.to_world", e.to_world, LIGHT_POSE)
            self.layout.parameters[f"{path}.to_world"].uses.add(LIGHT_RADIANCE)
            turbidity = np.array([sky.turbidity])
            at["turbidity"] = add(f"{path}.turbidity", turbidity, LIGHT_RADIANCE, bounds=TURBIDITIES)
            at["albedo"] = add(f"{path}.albedo.value", sky.albedo, LIGHT_RADIANCE, bounds=(0.0, 1.0))
            at["direction"] = add(f"{path}.sun_direction", sky.sun_direction, LIGHT_RADIANCE)
            at["texels"] = self.textures[record.texture].offset
            self.sky = SkyRecord(path, channels=sky.albedo.size, sun_scale=-1, irradiance=-1, frame=-1, **at)
        else:
            assert e.to_world is not None and self.sky is not None
            scale = self.layout.add(
                f"{sky.path}.sun_scale", np.array([sky.sun_scale]), LIGHT_RADIANCE, bounds=(0.0, INF)
            )
            record.to_world = self.layout.add_values(e.to_world)
            irradiance = self.textures[record.texture].offset
            self.layout.parameters[f"{sky.path}.sun_direction"].uses.add(LIGHT_POSE)
            self.sky = replace(self.sky, sun_scale=scale, irradiance=irradiance, frame=record.to_world)

    # -- media -----------------------------------------------------------------------------------------------------

    def _sides(self, s: ShapeDescription) -> tuple[int, int]:
        if s.interior is None and s.exterior is None:
            return c.NO_INTERFACE, c.NO_INTERFACE
        return self._media.number(s.exterior), self._media.number(s.interior)

    @property
    def media_config(self) -> MediaConfig | None:
        """What the media need compiled; None: there are none."""
        return self._media.config

    def _camera(self, s: SensorDescription) -> None:
        record = structs.Camera()
        record.kind = CAMERAS[s.kind]
        record.medium = self._media.number(s.medium)
        f = s.film
        record.width, record.height = f.width, f.height
        record.crop_x, record.crop_y = f.crop_offset_x, f.crop_offset_y
        record.crop_width, record.crop_height = f.crop_width, f.crop_height
        record.filter = RFILTERS[f.filter]
        record.filter_radius, record.filter_stddev = f.filter_radius, f.filter_stddev
        record.sample_border = int(f.sample_border)
        record.near, record.far = s.near_clip, s.far_clip
        if s.kind == "batch":
            self.cameras.append(record)
            return
        if s.kind == "irradiancemeter":
            shape = self.shapes[next(i for i, held in enumerate(self.description.shapes) if held.sensor is s)]
            record.first_face, record.face_count = shape.first_face, shape.face_count
            self.cameras.append(record)
            return
        record.to_world = self.layout.add(f"{s.path}.to_world", s.to_world, CAMERA, placed=True)
        if s.kind not in ("orthographic", "radiancemeter"):
            record.x_fov = self.layout.add(f"{s.path}.x_fov", np.array([s.x_fov]), CAMERA, bounds=(1e-3, 179.0))
            record.principal = self.layout.add_values(np.asarray(s.principal_point_offset))
            for i, axis in enumerate("xy"):
                self.layout.name(f"{s.path}.principal_point_offset_{axis}", record.principal + i, (1,), CAMERA)
            if s.distortion:
                record.kind = DISTORTED[s.kind, s.distortion]
                record.distortion = self.layout.add_values(np.asarray(s.distortion_numbers))
                for i, name in enumerate((*AFFINE, *MODELS[s.distortion])):
                    bounds = (1e-3, 1e3) if name == "pixel_aspect" else (-INF, INF)
                    self.layout.name(f"{s.path}.{name}", record.distortion + i, (1,), CAMERA, bounds=bounds)
        if s.kind == "thinlens":
            for name, low in (("aperture_radius", 0.0), ("focus_distance", 1e-6)):
                value = np.array([getattr(s, name)])
                setattr(record, name, self.layout.add(f"{s.path}.{name}", value, CAMERA, bounds=(low, INF)))
        self.cameras.append(record)
