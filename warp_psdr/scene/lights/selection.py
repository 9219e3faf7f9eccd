"""The data for light sampling: selection by power, cumulative triangle areas, and the environment map's cells."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import warp as wp

from warp_psdr.kernels import constants as c
from warp_psdr.kernels import structs
from warp_psdr.scene.build import Builder
from warp_psdr.scene.kinds.kind import geometry_of
from warp_psdr.scene.layout import struct_array
from warp_psdr.scene.lights.light_sampling import build_env_distribution, cumulative, with_guide
from warp_psdr.scene.materials.spectra import LUMINANCE

#: Share of the light selection that is uniform, so that a light of zero radiance is still sampled and its derivative
#: is not lost.
UNIFORM_SELECTION = 0.1


class Lights:
    """Device arrays that light sampling reads; each ``update_*`` follows one kind of edit.

    Attributes:
        emitters: ``structs.Emitter`` of every light.
        emitter_cdf: cumulative selection probabilities.
        face_cdf: cumulative triangle areas of every area light, and of every irradiance meter's shape, one behind the
            other.
    """

    def __init__(self, builder: Builder, device: wp.Device):
        self._builder = builder
        self._device = device
        self._areas = np.zeros(len(builder.emitters))
        self._area_cdfs: dict[int, np.ndarray] = {}
        self._texels = np.zeros((0, 0, 0), np.float32)
        self._cells: dict[bool, tuple[wp.array, wp.array]] = {}

    @property
    def environment(self) -> structs.Emitter | None:
        """The environment light; None: there is none."""
        number = self._builder.environment
        return self._builder.emitters[number] if number >= 0 else None

    def environment_data(self) -> tuple[int, int]:
        """Flat (offset, size) of the environment map's texels; size 0: there is no map."""
        e = self.environment
        return self._builder.texture_ranges[e.texture] if e and e.kind == c.EMITTER_ENVMAP else (0, 0)

    def of_shapes(self, shapes: Iterable[int]) -> list[int]:
        """Numbers of the area lights of the given shapes."""
        return [e for e in (self._builder.shapes[s].emitter for s in shapes) if e >= 0]

    def metered(self, shapes: Iterable[int]) -> bool:
        """Whether any of the given shapes holds an irradiance meter."""
        return any(self._builder.description.shapes[s].sensor is not None for s in shapes)

    def depend_on_size(self) -> bool:
        """Whether the power of any light depends on the size of the scene."""
        at_infinity = {c.EMITTER_CONSTANT, c.EMITTER_ENVMAP, c.EMITTER_DIRECTIONAL}
        return any(e.kind in at_infinity for e in self._builder.emitters)

    def update_areas(self, numbers: Iterable[int], points: np.ndarray) -> None:
        """Follow the geometry of area lights; ``points``: vertex positions of the scene, (N, 3)."""
        for number in numbers:
            e = self._builder.emitters[number]
            areas = self._shape_area(e, points) if e.shape in self._builder.primitives else self._face_areas(e, points)
            self._areas[number] = areas.sum()
            self._area_cdfs[number] = cumulative(areas)
        meters = [camera for camera in self._builder.cameras if camera.kind == c.CAMERA_IRRADIANCEMETER]
        cdfs = [*self._area_cdfs.values(), *(cumulative(self._face_areas(m, points)) for m in meters)]
        offset = 0
        for record, cdf in zip([*(self._builder.emitters[i] for i in self._area_cdfs), *meters], cdfs, strict=True):
            record.cdf_offset = offset
            offset += len(cdf)
        self.face_cdf = self._array(np.concatenate([*cdfs, np.zeros(1)]))

    def _shape_area(self, e: structs.Emitter, points: np.ndarray) -> np.ndarray:
        """Area (1,) of an exact shape that shines."""
        record = self._builder.shapes[e.shape]
        box = points[record.first_vertex : record.first_vertex + record.vertex_count]
        return np.array([geometry_of(self._builder.description.shapes[e.shape]).area(box)])

    def _face_areas(self, record: structs.Emitter | structs.Camera, points: np.ndarray) -> np.ndarray:
        """Areas of the triangles of a light or a meter."""
        faces = self._builder.indices[record.first_face : record.first_face + record.face_count]
        p0, p1, p2 = (points[faces[:, k]].astype(np.float64) for k in range(3))
        return 0.5 * np.linalg.norm(np.cross(p1 - p0, p2 - p0), axis=1)

    def update_environment(self, values: np.ndarray) -> None:
        """Follow the texels of the environment map; ``values``: the scene's flat values."""
        e = self.environment
        if e is None or e.kind != c.EMITTER_ENVMAP:
            return
        t = self._builder.textures[e.texture]
        texels = values[t.offset : t.offset + t.height * t.width * t.channels]
        self._texels = texels.reshape(t.height, t.width, t.channels).copy()
        self._cells = {True: self._built(True)}

    def cells(self, compensated: bool) -> tuple[wp.array, wp.array]:
        """Return the arrays of ``build_env_distribution``, flat, with guides; an entry each where there is no map."""
        found = self._cells.get(compensated)
        if found is None:
            found = self._cells[compensated] = self._built(compensated)
        return found

    def _built(self, compensated: bool) -> tuple[wp.array, wp.array]:
        if not self._texels.size:
            return self._array(np.zeros(1)), self._array(np.zeros(1))
        marginal, conditional = build_env_distribution(self._texels, compensated)
        return self._array(with_guide(marginal)), self._array(with_guide(conditional))

    def update_selection(self, values: np.ndarray, radius: float) -> None:
        """Select lights by their power, now that radiances, areas or the size of the scene have changed.

        Args:
            values: the scene's flat values.
            radius: of the scene's bounding sphere.
        """
        emitters = self._builder.emitters
        cdf = np.array([0.0, 1.0])
        if emitters:
            power = np.array([self._power(i, values, radius) for i in range(len(emitters))])
            p = np.full(len(power), 1.0 / len(power))
            if power.sum() > 0.0:
                p = (1.0 - UNIFORM_SELECTION) * power / power.sum() + UNIFORM_SELECTION * p
            cdf = cumulative(p)
            for e, probability in zip(emitters, np.diff(cdf.astype(np.float64)), strict=True):
                e.probability = float(probability)
        self.emitters = struct_array(structs.Emitter, emitters, self._device)
        self.emitter_cdf = self._array(cdf)

    def _power(self, number: int, values: np.ndarray, radius: float) -> float:
        """Power of a light in watts, up to a factor near one; negative values count as zero."""
        e = self._builder.emitters[number]
        mean = self._mean(e.texture, values)
        if e.kind == c.EMITTER_AREA:
            return np.pi * self._areas[number] * mean
        if e.kind == c.EMITTER_DIRECTIONAL_AREA:
            first = self._builder.positions
            points = values[first : first + 3 * self._builder.vertex_count].reshape(-1, 3)
            return mean * float(self._face_areas(e, points).sum())
        if e.kind == c.EMITTER_POINT:
            return 4.0 * np.pi * mean
        if e.kind in c.SPOTS:
            share = self._mean(e.projected, values) if e.kind == c.EMITTER_TEXTURED_SPOT else 1.0
            return 2.0 * np.pi * (1.0 - np.cos(np.radians(float(values[e.cutoff])))) * mean * share
        if e.kind == c.EMITTER_PROJECTOR:
            return np.pi * mean * max(float(values[e.scale]), 0.0) * self._frame_area(e, values)
        if e.kind == c.EMITTER_DIRECTIONAL:
            return np.pi * radius**2 * mean
        scale = max(float(values[e.scale]), 0.0) if e.kind == c.EMITTER_ENVMAP else 1.0
        return np.pi * np.pi * radius**2 * mean * scale

    def _frame_area(self, e: structs.Emitter, values: np.ndarray) -> float:
        """Area of a projector's frame at distance 1."""
        t = self._builder.textures[e.texture]
        width = 2.0 * np.tan(np.radians(0.5 * float(values[e.cutoff])))
        return width * width * max(t.height, 1) / max(t.width, 1)

    def _mean(self, texture: int, values: np.ndarray) -> float:
        """Mean luminance of a texture, at least 0."""
        record = self._builder.textures[texture]
        if record.kind == c.TEXTURE_CHECKERBOARD:
            return 0.5 * (self._mean(record.first, values) + self._mean(record.second, values))
        if record.kind == c.TEXTURE_SCALED:
            return max(float(values[record.offset]), 0.0) * self._mean(record.first, values)
        offset, size = self._builder.texture_ranges[texture]
        channels = self._builder.textures[texture].channels
        v = values[offset : offset + size].reshape(-1, channels)
        return max(float(np.mean(v @ LUMINANCE if channels == 3 else v, dtype=np.float64)), 0.0)

    def _array(self, values: np.ndarray) -> wp.array:
        return wp.array(values.astype(np.float32), dtype=wp.float32, device=self._device)
