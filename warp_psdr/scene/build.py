"""From a scene description to device records and the flat array of values."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels import constants as c
from warp_psdr.kernels import structs
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
    TO_UV,
    Layout,
)

if TYPE_CHECKING:
    from warp_psdr.scene.description import (
        BsdfDescription,
        EmitterDescription,
        SceneDescription,
        SensorDescription,
        ShapeDescription,
        TextureDescription,
    )

INF = float("inf")
SLOTS = ("c0", "c1", "c2", "s0", "s1")
#: Which property of a model sits in which slot of ``structs.Material``, and its valid range.
SLOT_OF = {
    "diffuse": {"reflectance": "c0"},
    "conductor": {"specular_reflectance": "c0", "eta": "c1", "k": "c2"},
    "roughconductor": {"specular_reflectance": "c0", "eta": "c1", "k": "c2", "alpha_u": "s0", "alpha_v": "s1"},
    "dielectric": {"specular_reflectance": "c0", "specular_transmittance": "c1", "eta": "s0"},
}
BOUNDS = {
    "reflectance": (0.0, 1.0),
    "specular_reflectance": (0.0, 1.0),
    "specular_transmittance": (0.0, 1.0),
    "alpha_u": (1e-3, 1.0),
    "alpha_v": (1e-3, 1.0),
    "eta": (0.0, INF),
    "k": (0.0, INF),
}
MODELS = {
    ("diffuse", None): c.BSDF_DIFFUSE,
    ("conductor", None): c.BSDF_CONDUCTOR,
    ("dielectric", None): c.BSDF_DIELECTRIC,
    ("roughconductor", "ggx"): c.BSDF_ROUGH_CONDUCTOR_GGX,
    ("roughconductor", "beckmann"): c.BSDF_ROUGH_CONDUCTOR_BECKMANN,
}
FILTERS = {"bilinear": c.FILTER_BILINEAR, "nearest": c.FILTER_NEAREST}
WRAPS = {"repeat": c.WRAP_REPEAT, "mirror": c.WRAP_MIRROR, "clamp": c.WRAP_CLAMP}
RFILTERS = {"box": c.RFILTER_BOX, "tent": c.RFILTER_TENT, "gaussian": c.RFILTER_GAUSSIAN}
EMITTERS = {
    "area": c.EMITTER_AREA,
    "constant": c.EMITTER_CONSTANT,
    "envmap": c.EMITTER_ENVMAP,
    "point": c.EMITTER_POINT,
    "spot": c.EMITTER_SPOT,
    "directional": c.EMITTER_DIRECTIONAL,
}
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


class Builder:
    """Lays a scene out; see the attributes for what it makes."""

    def __init__(self, description: SceneDescription):
        self.description = description
        self.layout = Layout()
        self.shapes: list = []  #: structs.Shape
        self.bsdfs: list = []  #: structs.Bsdf
        self.textures: list = []  #: structs.Texture
        self.texture_ranges: list[tuple[int, int]] = []  #: flat (offset, size) of a texture's values
        self.emitters: list = []  #: structs.Emitter
        self.cameras: list = []  #: structs.Camera
        self.environment = -1
        self.slot_kinds: dict[str, set[int]] = {s: set() for s in SLOTS}
        self.radiance_kinds: set[int] = set()
        self.two_sided = self.anisotropic = False
        self._texture_index: dict[tuple, int] = {}
        self._bsdf_index: dict[tuple, int] = {}
        self._identity = -1
        self._geometry()
        for number, shape in enumerate(description.shapes):
            self.shapes[number].bsdf = self._bsdf(shape.bsdf, number)
        for emitter in description.emitters:
            self._emitter(emitter)
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
            offset = self.layout.add(
                f"{s.path}.vertex_positions", s.vertices, POSITIONS, dtype=wp.vec3, owner=number
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
            self.layout.add(f"{s.path}.to_world", s.to_world, SHAPE_POSE, owner=number)

    # -- textures and materials ------------------------------------------------------------------------------------

    def _texture(
        self, t: TextureDescription | None, use: str, bounds: tuple[float, float], shape: int = -1, default: float = 1.0
    ) -> int:
        """Return the number of a texture's record; shared descriptions share it."""
        key = (id(t), shape if t is not None and t.kind == "mesh_attribute" else -1, default if t is None else 0.0)
        if key in self._texture_index:
            index = self._texture_index[key]
            self._name_use(t, use, shape)
            return index
        record = structs.Texture()
        if t is None:
            record.kind, record.channels = c.TEXTURE_CONSTANT, 1
            record.offset = self.layout.add_values(np.full(1, default))
            size = 1
        elif t.kind == "constant":
            values = np.asarray(t.value, np.float32).reshape(-1)
            record.kind, record.channels = c.TEXTURE_CONSTANT, values.size
            record.offset = self.layout.add(f"{t.path}.value", values, use, bounds=bounds)
            size = values.size
        elif t.kind == "bitmap":
            record.kind = c.TEXTURE_BITMAP
            record.height, record.width, record.channels = t.value.shape
            record.filter, record.wrap = FILTERS[t.filter], WRAPS[t.wrap]
            record.offset = self.layout.add(f"{t.path}.data", t.value, use, bounds=bounds)
            record.to_uv = self.layout.add(f"{t.path}.to_uv", t.to_uv, TO_UV)
            size = t.value.size
        else:
            size = self._attribute(t, record, use, bounds, shape)
        self.textures.append(record)
        self.texture_ranges.append((record.offset if t is None or t.kind != "mesh_attribute" else self._last, size))
        self._texture_index[key] = len(self.textures) - 1
        return len(self.textures) - 1

    def _attribute(self, t: TextureDescription, record, use: str, bounds, shape: int) -> int:
        s, device_shape = self.description.shapes[shape], self.shapes[shape]
        if t.attribute not in s.attributes:
            raise ValueError(
                f"texture {t.path!r} reads the mesh attribute {t.attribute!r}, which shape {s.path!r} does not have; "
                f"it has {sorted(s.attributes) or 'none'}"
            )
        values = np.asarray(s.attributes[t.attribute], np.float32)
        name = f"{s.path}.{t.attribute}"
        if name in self.layout.parameters:
            offset = self.layout.parameters[name].offset
            self.layout.parameters[name].uses.add(use)
        else:
            offset = self.layout.add(name, values, use, bounds=bounds, owner=shape)
        record.channels = values.shape[1]
        per_vertex = t.attribute.startswith("vertex_")
        record.kind = c.TEXTURE_VERTEX if per_vertex else c.TEXTURE_FACE
        first = device_shape.first_vertex if per_vertex else device_shape.first_face
        self._last = offset
        record.offset = offset - record.channels * first
        return values.size

    def _name_use(self, t: TextureDescription | None, use: str, shape: int) -> None:
        if t is None:
            return
        suffix = {"constant": ".value", "bitmap": ".data"}.get(t.kind)
        name = t.path + suffix if suffix else f"{self.description.shapes[shape].path}.{t.attribute}"
        self.layout.parameters[name].uses.add(use)

    def _bsdf(self, b: BsdfDescription, shape: int) -> int:
        reads_mesh = any(t.kind == "mesh_attribute" for t in b.textures.values()) or (
            b.back is not None and any(t.kind == "mesh_attribute" for t in b.back.textures.values())
        )
        key = (id(b), shape if reads_mesh else -1)
        if key in self._bsdf_index:
            return self._bsdf_index[key]
        record = structs.Bsdf()
        record.model = MODELS[b.model, b.distribution if b.model == "roughconductor" else None]
        record.two_sided = int(b.two_sided)
        self.two_sided |= b.two_sided
        for slot in SLOTS:
            setattr(record, slot, -1)
        for prop, slot in SLOT_OF[b.model].items():
            index = self._texture(b.textures.get(prop), MATERIAL + slot, BOUNDS[prop], shape)
            setattr(record, slot, index)
            self.slot_kinds[slot].add(self.textures[index].kind)
        if b.model == "roughconductor":
            self.anisotropic |= record.s0 != record.s1
        number = len(self.bsdfs)
        self.bsdfs.append(record)
        self._bsdf_index[key] = number
        record.back = number if b.back is None else self._bsdf(b.back, shape)
        return number

    # -- lights and cameras ----------------------------------------------------------------------------------------

    def _emitter(self, e: EmitterDescription) -> None:
        record = structs.Emitter()
        record.kind = EMITTERS[e.kind]
        number = len(self.emitters)
        bounds = (0.0, INF)
        if e.kind == "area":
            shape = next(i for i, s in enumerate(self.description.shapes) if s.emitter is e)
            record.shape = shape
            record.first_face, record.face_count = self.shapes[shape].first_face, self.shapes[shape].face_count
            self.shapes[shape].emitter = number
            record.texture = self._texture(e.radiance, RADIANCE, bounds, shape)
            self.radiance_kinds.add(self.textures[record.texture].kind)
        else:
            record.texture = self._texture(e.radiance, LIGHT_RADIANCE, bounds)
        if e.kind in ("constant", "envmap"):
            if self.environment >= 0:
                raise ValueError(f"emitter {e.path!r}: a scene holds one environment light (constant or envmap), not two")
            self.environment = number
        if e.kind == "envmap":
            record.scale = self.layout.add(f"{e.path}.scale", np.array([e.scale]), LIGHT_RADIANCE, bounds=bounds)
        if e.to_world is not None:
            record.to_world = self.layout.add(f"{e.path}.to_world", e.to_world, LIGHT_POSE)
        if e.position is not None:
            record.to_world = self.layout.add(f"{e.path}.position", e.position, LIGHT_POSE)
        if e.kind == "spot":
            record.cutoff = self.layout.add_values(np.array([e.cutoff_angle, e.beam_width]))
            for i, name in enumerate(("cutoff_angle", "beam_width")):
                self.layout.name(f"{e.path}.{name}", record.cutoff + i, (1,), LIGHT_POSE, bounds=(0.0, 90.0))
        self.emitters.append(record)

    def _camera(self, s: SensorDescription) -> None:
        record = structs.Camera()
        f = s.film
        record.width, record.height = f.width, f.height
        record.crop_x, record.crop_y = f.crop_offset_x, f.crop_offset_y
        record.crop_width, record.crop_height = f.crop_width, f.crop_height
        record.filter = RFILTERS[f.filter]
        record.filter_radius, record.filter_stddev = f.filter_radius, f.filter_stddev
        record.near, record.far = s.near_clip, s.far_clip
        record.to_world = self.layout.add(f"{s.path}.to_world", s.to_world, CAMERA)
        record.x_fov = self.layout.add(f"{s.path}.x_fov", np.array([s.x_fov]), CAMERA, bounds=(1e-3, 179.0))
        record.principal = self.layout.add_values(np.asarray(s.principal_point_offset))
        for i, axis in enumerate("xy"):
            self.layout.name(f"{s.path}.principal_point_offset_{axis}", record.principal + i, (1,), CAMERA)
        self.cameras.append(record)

    # -- light power -----------------------------------------------------------------------------------------------

    def emitter_mean(self, e, values: np.ndarray) -> float:
        """Mean luminance of a light's radiance, intensity or irradiance."""
        offset, size = self.texture_ranges[e.texture]
        channels = self.textures[e.texture].channels
        v = values[offset : offset + size].reshape(-1, channels)
        return float(np.mean(v @ LUMINANCE if channels == 3 else v, dtype=np.float64))

    def emitter_power(self, e, values: np.ndarray, radius: float) -> float:
        """Power of a light in watts, up to a constant; ``radius`` is the scene's (for lights at infinity and area 0)."""
        mean = self.emitter_mean(e, values)
        if e.kind == c.EMITTER_POINT:
            return 4.0 * np.pi * mean
        if e.kind == c.EMITTER_SPOT:
            return 2.0 * np.pi * (1.0 - np.cos(np.radians(float(values[e.cutoff])))) * mean
        if e.kind == c.EMITTER_DIRECTIONAL:
            return np.pi * radius**2 * mean
        scale = float(values[e.scale]) if e.kind == c.EMITTER_ENVMAP else 1.0
        return np.pi * np.pi * radius**2 * mean * scale
