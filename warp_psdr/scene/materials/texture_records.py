"""Device records of textures, and the layout of their values."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels import constants as c
from warp_psdr.kernels import structs
from warp_psdr.scene.layout import LIGHT_RADIANCE, TO_UV, Layout
from warp_psdr.scene.media.volume_pose import VolumePose, inverse_of
from warp_psdr.scene.origin import moved

if TYPE_CHECKING:
    from warp_psdr.scene.description import ShapeDescription, TextureDescription

FILTERS = {"bilinear": c.FILTER_BILINEAR, "trilinear": c.FILTER_BILINEAR, "nearest": c.FILTER_NEAREST}
WRAPS = {"repeat": c.WRAP_REPEAT, "mirror": c.WRAP_MIRROR, "clamp": c.WRAP_CLAMP}
#: A texture's record and the flat (offset, size) of its values.
Placed = tuple[structs.Texture, tuple[int, int]]


def reads_mesh(t: TextureDescription) -> bool:
    """Whether a texture reads an attribute of the shape that it is on."""
    return any(leaf.kind == "mesh_attribute" for leaf in t.leaves)


def has_steps(texture: structs.Texture) -> bool:
    """Whether a texture jumps inside of triangles."""
    return texture.kind == c.TEXTURE_CHECKERBOARD or (
        texture.kind in (c.TEXTURE_BITMAP, c.TEXTURE_GRID) and texture.filter == c.FILTER_NEAREST
    )


class TextureRecords:
    """Records of the textures of a scene.

    Args:
        layout: Takes their values.
        shapes: Of the scene, whose attributes they may read.
        placed: ``structs.Shape`` of those.
        origin: (3,) float64: where the device's coordinates start.

    Attributes:
        records: ``structs.Texture``, by number.
        ranges: Flat (offset, size) of their values.
        poses: Of textures that are volumes.
    """

    def __init__(self, layout: Layout, shapes: list[ShapeDescription], placed: list, origin: np.ndarray):
        self.records: list = []
        self.ranges: list[tuple[int, int]] = []
        self.poses: list[VolumePose] = []
        self._layout = layout
        self._shapes = shapes
        self._placed = placed
        self._origin = origin
        self._numbers: dict[tuple[int, int], int] = {}
        self._absent: dict[float, int] = {}

    def number(self, t: TextureDescription, use: str, bounds: tuple[float, float], shape: int = -1) -> int:
        """Return the number of a texture's record; shared descriptions share it.

        Args:
            t: the texture.
            use: what the values are used as; see ``layout``.
            bounds: valid range of the values.
            shape: the shape whose attributes a mesh attribute reads.
        """
        attribute = t.kind == "mesh_attribute"
        key = (id(t), shape if reads_mesh(t) else -1)
        nested = [self.number(inner, use, bounds, shape) for inner in t.nested]
        if key not in self._numbers:
            if nested:
                placed = self._checkerboard(t, nested)
            else:
                placed = self._attribute(t, use, bounds, shape) if attribute else self._image(t, use, bounds)
            number = self.add(*placed)
            self._numbers[key] = number if t.scale is None else self._scaled(t, number, use)
        if not nested:
            self._layout.parameters[self._attribute_name(t, shape) if attribute else t.parameter].uses.add(use)
        if t.scale is not None:
            self._layout.parameters[t.scale_parameter].uses.add(use)
        return self._numbers[key]

    def derived(self, t: TextureDescription) -> int:
        """Return the number of the record of a constant or a bitmap whose values are no parameter."""
        record = structs.Texture()
        record.offset = self._layout.add_values(t.value)
        record.kind, record.channels = c.TEXTURE_CONSTANT, t.value.shape[-1]
        if t.kind == "bitmap":
            record.kind = c.TEXTURE_BITMAP
            record.height, record.width = t.value.shape[:2]
            record.to_uv = self._layout.add_values(t.to_uv)
        return self.add(record, (record.offset, t.value.size))

    def _checkerboard(self, t: TextureDescription, nested: list[int]) -> Placed:
        """Lay out a checkerboard whose two textures have these numbers; return its record and no values."""
        record = structs.Texture()
        record.kind = c.TEXTURE_CHECKERBOARD
        record.first, record.second = nested
        name = f"{t.path}.to_uv"
        # A checkerboard that is read as a scalar, too, has a second record, and one transformation.
        if name not in self._layout.parameters:
            self._layout.add(name, t.to_uv, TO_UV)
        record.to_uv = self._layout.parameters[name].offset
        return record, (0, 0)

    def _scaled(self, t: TextureDescription, inner: int, use: str) -> int:
        """Return the number of the record of a texture, which has a number, times its scale."""
        assert t.scale is not None
        name = t.scale_parameter
        if name not in self._layout.parameters:  # one of a material that several shapes have is theirs
            self._layout.add(name, np.array([t.scale]), use)
        record = structs.Texture()
        record.kind, record.first = c.TEXTURE_SCALED, inner
        record.offset = self._layout.parameters[name].offset
        return self.add(record, (0, 0))

    def nested_in(self, t: structs.Texture) -> tuple[int, ...]:
        """Return the numbers of the textures that a texture is made of."""
        if t.kind == c.TEXTURE_SCALED:
            return (t.first,)
        return (t.first, t.second) if t.kind == c.TEXTURE_CHECKERBOARD else ()

    def kinds_of(self, texture: int) -> set[int]:
        """Return the kinds of a texture and of those nested in it."""
        t = self.records[texture]
        return {t.kind}.union(*(self.kinds_of(number) for number in self.nested_in(t)))

    def absent(self, value: float) -> int:
        """Return the number of the unnamed constant texture that stands in for one that is not given."""
        if value not in self._absent:
            record = structs.Texture()
            record.kind, record.channels = c.TEXTURE_CONSTANT, 1
            record.offset = self._layout.add_values(np.full(1, value))
            self._absent[value] = self.add(record, (record.offset, 1))
        return self._absent[value]

    def add(self, record: structs.Texture, values: tuple[int, int]) -> int:
        """Take a record, with the flat (offset, size) of its values, and return its number."""
        self.records.append(record)
        self.ranges.append(values)
        return len(self.records) - 1

    def _image(self, t: TextureDescription, use: str, bounds: tuple[float, float]) -> Placed:
        """Lay out a constant, a bitmap or a volume; return its record and the flat (offset, size) of its values."""
        record = structs.Texture()
        # Bitmaps may exceed the range; an optimiser then keeps to what the file has.
        low, high = bounds
        bounds = (low, max(high, float(t.value.max())))
        record.offset = self._layout.add(t.parameter, t.value, use, bounds=bounds)
        self._layout.hold(t, "value", record.offset)
        if t.kind == "constant":
            record.kind, record.channels = c.TEXTURE_CONSTANT, t.value.size
        elif t.kind == "volume":
            record.kind = c.TEXTURE_GRID
            record.first, record.height, record.width, record.channels = t.value.shape
            record.filter, record.wrap = FILTERS[t.filter], WRAPS[t.wrap]
            record.to_uv = self._volume_pose(t)
        else:
            record.kind = c.TEXTURE_BITMAP
            record.height, record.width, record.channels = t.value.shape
            record.filter, record.wrap = FILTERS[t.filter], WRAPS[t.wrap]
            if use == LIGHT_RADIANCE:  # no parameter: an environment map is read by direction, and others have none
                record.to_uv = self._layout.add_values(t.to_uv)
            else:
                record.to_uv = self._layout.add(f"{t.path}.to_uv", t.to_uv, TO_UV)
        return record, (record.offset, t.value.size)

    def _volume_pose(self, t: TextureDescription) -> int:
        """Return the flat offset of the matrix by which a volume is read; what is read as a scalar, too, shares it."""
        name = f"{t.path}.to_world"
        if name not in self._layout.parameters:
            assert t.to_world is not None
            pose = moved(t.to_world, self._origin)
            self.poses.append(VolumePose(name, self._layout.add(name, pose, TO_UV, placed=True)))
            self._layout.add_values(inverse_of(pose))
        return next(p.inverse for p in self.poses if p.parameter == name)

    def _attribute(self, t: TextureDescription, use: str, bounds: tuple[float, float], shape: int) -> Placed:
        """Lay out a shape's attribute, unless another texture has; return as ``_image`` does."""
        s, placed = self._shapes[shape], self._placed[shape]
        values = s.attributes[t.attribute]
        name = self._attribute_name(t, shape)
        if name not in self._layout.parameters:
            self._layout.add(name, values, use, bounds=bounds, owner=shape)
        offset = self._layout.parameters[name].offset
        per_vertex = t.attribute.startswith("vertex_")
        record = structs.Texture()
        record.channels = values.shape[1]
        record.kind = c.TEXTURE_VERTEX if per_vertex else c.TEXTURE_FACE
        # Biased, so that it takes global numbers.
        record.offset = offset - record.channels * (placed.first_vertex if per_vertex else placed.first_face)
        return record, (offset, values.size)

    def _attribute_name(self, t: TextureDescription, shape: int) -> str:
        return f"{self._shapes[shape].source}.{t.attribute}"
