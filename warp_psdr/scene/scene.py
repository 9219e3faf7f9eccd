"""A scene on a device: records for the kernels, and what has to be refreshed when values change."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.acceleration import Accelerator
from warp_psdr.device import launch
from warp_psdr.kernels import structs
from warp_psdr.kernels.constants import EMITTER_AREA, EMITTER_ENVMAP
from warp_psdr.kernels.distribution import cumulative
from warp_psdr.kernels.emitter.envmap import build_env_distribution
from warp_psdr.kernels.shape.normals import normalize_sums, sum_normals
from warp_psdr.kernels.shape.transform import pose_shape
from warp_psdr.kernels.surface import update_triangles
from warp_psdr.scene.build import Builder
from warp_psdr.scene.layout import (
    LIGHT_POSE,
    LIGHT_RADIANCE,
    NORMALS,
    POSITIONS,
    RADIANCE,
    SHAPE_POSE,
    Parameter,
    struct_array,
)

if TYPE_CHECKING:
    from warp_psdr.scene.description import SceneDescription

#: A ray's origin leaves its surface by this fraction of the largest coordinate: some 80 float32 steps there.
RAY_EPSILON = 1.0e-5
#: Share of the light selection that is uniform, so that a light of zero radiance is still sampled and its derivative
#: is not lost.
UNIFORM_SELECTION = 0.1


class Scene:
    """A loaded scene.

    Attributes:
        description: The validated values it was built from.
        device: Warp device.
        values: Flat float32 array of every continuous value.
        parameters: Named stretches of ``values``.
        indices: Flat int32 vertex numbers, three a triangle, over all shapes.
    """

    def __init__(self, description: SceneDescription, device: str | wp.Device = "cpu"):
        """Build the device records.

        Args:
            description: What the readers produced.
            device: Warp device name, "cpu" or "cuda:0".
        """
        self.description = description
        self.device = wp.get_device(device)
        builder = Builder(description)
        self.builder = builder
        self.parameters: dict[str, Parameter] = builder.layout.parameters
        self.values = wp.array(builder.layout.values(), dtype=wp.float32, device=self.device)
        self.indices = wp.array(builder.indices.reshape(-1), dtype=wp.int32, device=self.device)
        self.face_count = len(builder.indices)
        self.vertex_count = builder.vertex_count
        self._points = self._view_points()
        self._face_shape = wp.array(builder.face_shape, dtype=wp.int32, device=self.device)
        self._orientation = wp.array(
            np.array([s.orientation for s in builder.shapes] or [1.0], np.float32), dtype=wp.float32, device=self.device
        )
        self._local = {
            i: tuple(
                wp.array(a if a is not None else np.zeros((1, 3)), dtype=wp.vec3, device=self.device)
                for a in (s.local_vertices, s.local_normals)
            )
            for i, s in enumerate(description.shapes)
            if s.to_world is not None
        }
        self.triangles = wp.zeros(max(self.face_count, 1), dtype=structs.Triangle, device=self.device)
        self._shapes = struct_array(structs.Shape, builder.shapes, self.device)
        self._bsdfs = struct_array(structs.Bsdf, builder.bsdfs, self.device)
        self._textures = struct_array(structs.Texture, builder.textures, self.device)
        for shape in self._local:
            self._pose(shape)
        self._update_triangles(range(len(description.shapes)))
        self.accelerator = Accelerator(self._points, self.indices, self.device)
        self._update_bounds()
        self._update_environment()
        self._update_lights()

    # -- views and constants ---------------------------------------------------------------------------------------

    def _view_points(self) -> wp.array:
        points = Parameter("", self.builder.positions, (self.vertex_count,), wp.vec3, (-np.inf, np.inf))
        return points.view(self.values)

    @property
    def positions(self) -> int:
        """Flat offset of the vertex positions of all shapes."""
        return self.builder.positions

    def camera(self, sensor: int) -> structs.Camera:
        """Return the camera record of a sensor.

        Raises:
            ValueError: There is no such sensor.
        """
        cameras = self.builder.cameras
        if not isinstance(sensor, (int, np.integer)) or not -len(cameras) <= sensor < len(cameras):
            raise ValueError(f"sensor {sensor!r}: the scene has sensors 0 to {len(cameras) - 1}")
        return cameras[sensor]

    def data(self) -> structs.Scene:
        """Return the kernel argument."""
        s = structs.Scene()
        s.accel = self.accelerator.data
        s.values = self.values
        s.positions = self.positions
        s.triangles = self.triangles
        s.shapes = self._shapes
        s.bsdfs = self._bsdfs
        s.textures = self._textures
        s.emitters = self._emitters
        s.emitter_cdf = self._emitter_cdf
        s.face_cdf = self._face_cdf
        s.environment = self.builder.environment
        s.env_marginal = self._env_marginal
        s.env_conditional = self._env_conditional
        s.center = wp.vec3(*self.center.tolist())
        s.radius = self.radius
        s.ray_epsilon = self.ray_epsilon
        return s

    # -- refreshing ------------------------------------------------------------------------------------------------

    def refresh(self, names: list[str]) -> None:
        """Recompute what depends on the named parameters: normals, triangles, ray structure, light sampling."""
        posed, moved, light = set(), set(), False
        environment = False
        for name in names:
            p = self.parameters[name]
            if SHAPE_POSE in p.uses:
                posed.add(p.owner)
            if POSITIONS in p.uses:
                moved.add(p.owner)
            if p.uses & {RADIANCE, LIGHT_RADIANCE, LIGHT_POSE}:
                light = True
                environment |= LIGHT_RADIANCE in p.uses
        for shape in sorted(posed):
            self._pose(shape)
        moved |= posed
        for shape in sorted(moved):
            description = self.description.shapes[shape]
            if description.normals_computed and f"{description.path}.vertex_normals" not in names:
                self.normal_sums(shape, write=True)
        if moved:
            self._update_triangles(sorted(moved))
            self.accelerator.update()
            self._update_bounds()
        if environment:
            self._update_environment()
        if light or any(self.description.shapes[s].emitter is not None for s in moved) or (moved and self.builder.environment >= 0):
            self._update_lights()

    def _pose(self, shape: int) -> None:
        record = self.builder.shapes[shape]
        vertices, normals = self._local[shape]
        launch(
            pose_shape,
            dim=record.vertex_count,
            inputs=[vertices, normals, *self.pose_offsets(shape)],
            outputs=[self.values],
            device=self.device,
        )

    def pose_offsets(self, shape: int) -> tuple[int, int, int]:
        """Flat offsets of a posed shape's matrix, of its first position and of its first normal (-1: flat)."""
        record = self.builder.shapes[shape]
        to_world = self.parameters[f"{self.description.shapes[shape].path}.to_world"].offset
        normals = record.normal_offset + 3 * record.first_vertex if record.smooth else -1
        return to_world, self.positions + 3 * record.first_vertex, normals

    def local_geometry(self, shape: int) -> tuple[wp.array, wp.array]:
        """Object-space vertices and normals of a posed shape."""
        return self._local[shape]

    def normal_sums(self, shape: int, *, write: bool) -> wp.array:
        """Return the unnormalised vertex normals of a shape; ``write``: update its normals from them."""
        record = self.builder.shapes[shape]
        sums = wp.zeros(3 * record.vertex_count, dtype=wp.float32, device=self.device)
        launch(
            sum_normals,
            dim=record.face_count,
            inputs=[self.values, self.positions, self.indices, record.first_face, record.first_vertex],
            outputs=[sums],
            device=self.device,
        )
        if write:
            launch(
                normalize_sums,
                dim=record.vertex_count,
                inputs=[sums, record.normal_offset + 3 * record.first_vertex],
                outputs=[self.values],
                device=self.device,
            )
        return sums

    def _update_triangles(self, shapes) -> None:
        for shape in shapes:
            record = self.builder.shapes[shape]
            launch(
                update_triangles,
                dim=record.face_count,
                inputs=[
                    self.values,
                    self.positions,
                    self.indices,
                    self._face_shape,
                    self._orientation,
                    record.first_face,
                ],
                outputs=[self.triangles],
                device=self.device,
            )

    def _update_bounds(self) -> None:
        points = self._points.numpy() if self.vertex_count else np.zeros((1, 3), np.float32)
        low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise ValueError(
                "vertex positions hold NaN or infinity after the last edit; restore finite values "
                "(an optimiser that got here took too long a step: lower its learning rate)"
            )
        self.center = 0.5 * (low + high)
        self.radius = float(max(0.5 * np.linalg.norm(high - low), 1e-30))
        self.ray_epsilon = float(RAY_EPSILON * max(np.abs(low).max(), np.abs(high).max(), 1e-30))

    def _update_lights(self) -> None:
        """Light selection probabilities by power, and the cumulative triangle areas of area lights."""
        records, power, cdfs = self.builder.emitters, [], []
        offset = 0
        points = self._points.numpy() if self.vertex_count else None
        values = self.values.numpy()
        for e in records:
            if e.kind == EMITTER_AREA:
                faces = self.builder.indices[e.first_face : e.first_face + e.face_count]
                p0, p1, p2 = (points[faces[:, k]].astype(np.float64) for k in range(3))
                areas = 0.5 * np.linalg.norm(np.cross(p1 - p0, p2 - p0), axis=1)
                e.cdf_offset = offset
                cdf = cumulative(areas)
                cdfs.append(cdf)
                offset += len(cdf)
                power.append(np.pi * float(areas.sum()) * max(self.builder.emitter_mean(e, values), 0.0))
            else:
                power.append(max(self.builder.emitter_power(e, values, self.radius), 0.0))
        if records:
            p = np.asarray(power, np.float64)
            uniform = np.full(len(p), 1.0 / len(p))
            p = (1.0 - UNIFORM_SELECTION) * p / p.sum() + UNIFORM_SELECTION * uniform if p.sum() > 0.0 else uniform
            cdf = cumulative(p)
            for e, probability in zip(records, np.diff(cdf.astype(np.float64)), strict=True):
                e.probability = float(probability)
        else:
            cdf = np.array([0.0, 1.0], np.float32)
        self._emitters = struct_array(structs.Emitter, records, self.device)
        self._emitter_cdf = wp.array(cdf, dtype=wp.float32, device=self.device)
        flat = np.concatenate(cdfs) if cdfs else np.zeros(1, np.float32)
        self._face_cdf = wp.array(flat, dtype=wp.float32, device=self.device)

    def _update_environment(self) -> None:
        marginal = conditional = np.zeros(1, np.float32)
        if self.builder.environment >= 0:
            e = self.builder.emitters[self.builder.environment]
            if e.kind == EMITTER_ENVMAP:
                t = self.builder.textures[e.texture]
                size = t.height * t.width * t.channels
                data = self.values.numpy()[t.offset : t.offset + size].reshape(t.height, t.width, t.channels)
                marginal, conditional = build_env_distribution(data)
        self._env_marginal = wp.array(marginal, dtype=wp.float32, device=self.device)
        self._env_conditional = wp.array(conditional.reshape(-1), dtype=wp.float32, device=self.device)

    def derived_normals(self, names: list[str]) -> list[int]:
        """Shapes whose normals follow their positions and whose positions, or pose, are among the named parameters."""
        shapes = set()
        for name in names:
            p = self.parameters[name]
            if POSITIONS in p.uses and self.description.shapes[p.owner].normals_computed:
                shapes.add(p.owner)
        return sorted(shapes)

    def has_use(self, names: list[str], *uses: str) -> bool:
        """Whether any of the named parameters has one of the uses."""
        return any(self.parameters[n].uses & set(uses) for n in names)

    def moves_normals(self, names: list[str]) -> bool:
        """Whether shading normals depend on any of the named parameters."""
        return self.has_use(names, NORMALS, SHAPE_POSE) or bool(self.derived_normals(names))
