"""Device records of media and of their grids, and the layout of their values."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.medium.coefficients import ALBEDO, EMISSION, PHASE, POSE, SCALE, SIGMA_T
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.structs import Medium, Texture
from warp_psdr.kernels.vertex import MediaConfig
from warp_psdr.scene.errors import SceneError
from warp_psdr.scene.layout import MEDIUM, Layout
from warp_psdr.scene.media.coefficients import MOST_G
from warp_psdr.scene.media.collisions import Tracking, area_of, null_collisions, too_many
from warp_psdr.scene.media.super_grid import (
    FlakeCheck,
    Follower,
    PhaseTable,
    SuperGrid,
    flake_areas,
    integrals,
    super_grid,
)
from warp_psdr.scene.media.volume_pose import VolumePose, box_around, extent_of, inverse_of
from warp_psdr.scene.origin import moved

if TYPE_CHECKING:
    from warp_psdr.scene.description import MediumDescription, PhaseDescription, SceneDescription, VolumeDescription

PHASES = {
    "isotropic": c.PHASE_ISOTROPIC,
    "hg": c.PHASE_HG,
    "rayleigh": c.PHASE_RAYLEIGH,
    "tabphase": c.PHASE_TABLE,
    "blendphase": c.PHASE_BLEND,
    "sggx": c.PHASE_SGGX,
}


class MediaRecords:
    """Records of the media of a scene.

    Args:
        layout: Takes their values.
        textures: Records of the scene's textures, which grids join.
        texture_ranges: Flat (offset, size) of their values.
        poses: Of the scene's volumes, which those of grids join.
        description: Of the scene.

    Attributes:
        records: ``structs.Medium``, by number.
        names: Of them.
        super_grids: Of the extinction of heterogeneous media, and of those in which it varies with microflakes.
        followers: What follows edits of values: those, and the integrals of tables of phase functions.
    """

    def __init__(
        self,
        layout: Layout,
        textures: list,
        texture_ranges: list[tuple[int, int]],
        poses: list[VolumePose],
        description: SceneDescription,
    ):
        self.records: list = []
        self.names: list[str] = []
        self.super_grids: list[SuperGrid] = []
        self.followers: list[Follower] = []
        self._layout = layout
        self._textures = textures
        self._texture_ranges = texture_ranges
        self._poses = poses
        self._origin = description.origin
        #: A box around all that rays meet, which a homogeneous medium fills where it is tracked.
        self._around = box_around(description.shapes)
        self._extent = extent_of(description.shapes)
        self._most = description.max_collisions
        self._numbers: dict[int, int] = {}
        self._phases: set[int] = set()  # PHASE_* that occur, those in blends included

    def number(self, m: MediumDescription | None) -> int:
        """Return the number of a medium's record; shared descriptions share it."""
        if m is None:
            return c.NO_MEDIUM
        if id(m) not in self._numbers:
            self._numbers[id(m)] = len(self.records)
            self.records.append(self._record(m))
            self.names.append(m.path)
        return self._numbers[id(m)]

    @property
    def config(self) -> MediaConfig | None:
        """What the media need compiled; None: there are none."""
        if not self.records:
            return None
        phases = tuple(sorted(self._phases))
        grids = [self._textures[m.sigma_t] for m in self.records if m.sigma_t_channels == GRID]
        chromatic = any(m.sigma_t_channels == 3 for m in self.records) or any(g.channels == 3 for g in grids)
        emissive = any(m.emission >= 0 for m in self.records)
        return MediaConfig(phases, chromatic, bool(grids), emissive)

    def _record(self, m: MediumDescription) -> Medium:
        add, record = self._layout.add, Medium()
        for coefficient, high in ((m.sigma_t, np.inf), (m.albedo, 1.0)):
            kind = ALBEDO if coefficient is m.albedo else SIGMA_T
            place = self._values(coefficient, MEDIUM + kind, (0.0, high))
            channels = coefficient.value.size
            placed = m.grids or coefficient.value.ndim == 4
            if coefficient.value.ndim == 4 or (kind == SIGMA_T and m.tracked):
                place, channels = self._grid(coefficient, place, tracked=kind == SIGMA_T, placed=placed), GRID
            setattr(record, kind, place)
            setattr(record, f"{kind}_channels", channels)
        record.scale = add(f"{m.path}.scale", np.array([m.scale]), MEDIUM + SCALE, bounds=(0.0, np.inf))
        record.emission = -1
        if m.emission is not None:
            place = self._values(m.emission, MEDIUM + EMISSION, (0.0, np.inf))
            channels = m.emission.value.size
            if m.emission.value.ndim == 4:
                place, channels = self._grid(m.emission, place), GRID
            record.emission, record.emission_channels = place, channels
        record.phase, record.g = self._phase(m.phase)
        if record.sigma_t_channels == GRID:
            self._bound(m, record.scale)
        return record

    def _bound(self, m: MediumDescription, scale: int) -> None:
        """Bound what flights through a tracked medium cost, on load and after edits; ``scale``: its flat offset.

        Raises:
            ValueError: They take too many collisions.
        """
        v, flakes, grid = m.sigma_t, m.phase.flakes, self.super_grids[-1]
        to_world = self._around if v.to_world is None else v.to_world
        factor = m.scale if flakes is None else m.scale * area_of(flakes.value)
        values = v.value.reshape(grid.shape)
        count = null_collisions(values, v.wrap, factor, to_world, self._extent, self._most)
        if count > self._most:
            raise SceneError(too_many(m.path, v.parameter, factor * float(values.max()), count))
        known = self._layout.parameters
        pose = known[_pose_of(v)].offset if _pose_of(v) in known else -1
        matrices = (0, 0) if flakes is None else (known[flakes.parameter].offset, flakes.value.size)
        names = [v.parameter, f"{m.path}.scale", _pose_of(v), "" if flakes is None else flakes.parameter]
        self.followers += [
            Tracking(name, m.path, grid, scale, pose, to_world, matrices, self._extent, self._most)
            for name in names
            if name in known
        ]

    def _phase(self, p: PhaseDescription) -> tuple[int, int]:
        """Return the kind of a phase function (PHASE_*), and where its values are (``Medium.g``)."""
        kind, place = PHASES[p.kind], 0
        if p.weight is not None and p.weight.value.ndim == 4:
            kind = c.PHASE_BLEND_GRID
        if p.flakes_vary:
            kind = c.PHASE_SGGX_GRID
        self._phases.add(kind)
        if p.kind == "hg":
            bounds = (-MOST_G, MOST_G)
            place = self._layout.add(f"{p.path}.g", np.array([p.g]), MEDIUM + PHASE, bounds=bounds)
        if p.values is not None:
            place = self._table(f"{p.path}.values", p.values)
        if p.nested:
            place = self._blend(p)
        if p.flakes is not None:
            place = self._flakes(p.flakes, p.flakes_vary)
        return kind, place

    def _blend(self, p: PhaseDescription) -> int:
        """Return the number of the record of a blend: its weight, kinds and places of both phase functions."""
        assert p.weight is not None
        record, weight = Texture(), p.weight
        record.kind = c.TEXTURE_GRID
        place = self._values(weight, MEDIUM + PHASE, (0.0, 1.0))
        # In place of a number's flat offset, the number of a grid.
        record.offset = self._grid(weight, place, placed=False) if weight.value.ndim == 4 else place
        (record.width, record.first), (record.height, record.second) = (self._phase(inner) for inner in p.nested)
        record.channels = 1
        self._textures.append(record)
        self._texture_ranges.append((place, weight.value.size))
        return len(self._textures) - 1

    def _flakes(self, v: VolumeDescription, vary: bool) -> int:
        """Return the flat offset of the matrix of microflakes, or the number of the record of a grid of them."""
        place, most = self._values(v, MEDIUM + PHASE, (-np.inf, np.inf)), -1
        number = place
        if vary:
            number = self._grid(v, place, placed=False)
            most = self._layout.add_values(np.array([flake_areas(v.value)[0]], np.float32))
            self._textures[number].second = most
        self.followers.append(FlakeCheck(v.parameter, place, v.value.shape, most))
        return number

    def _table(self, name: str, values: np.ndarray) -> int:
        """Return the number of the record of a table of a phase function."""
        record = Texture()
        record.kind = c.TEXTURE_GRID
        record.offset = self._layout.add(name, values, MEDIUM + PHASE, bounds=(0.0, np.inf))
        record.width, record.height, record.first, record.channels = values.size, 1, 1, 1
        record.second = self._layout.add_values(integrals(values))
        self.followers.append(PhaseTable(name, record.offset, values.size, record.second))
        self._textures.append(record)
        self._texture_ranges.append((record.offset, values.size))
        return len(self._textures) - 1

    def _values(self, v: VolumeDescription, use: str, bounds: tuple[float, float]) -> int:
        """Lay out the values of a volume; return their flat offset."""
        offset = self._layout.add(v.parameter, v.value, use, bounds=bounds)
        self._layout.hold(v, "value", offset)
        return offset

    def _grid(self, v: VolumeDescription, offset: int, *, tracked: bool = False, placed: bool = True) -> int:
        """Return the number of the record of a volume whose values are at a flat offset; a constant is one voxel.

        ``tracked``: it has majorants; ``placed``: its pose is a parameter.
        """
        to_world = self._around if v.to_world is None else v.to_world
        shape = v.value.shape if v.value.ndim == 4 else (1, 1, 1, v.value.size)
        record = Texture()
        record.kind = c.TEXTURE_GRID
        record.offset = offset
        record.first, record.height, record.width, record.channels = shape
        record.filter = c.FILTER_NEAREST if v.filter == "nearest" else c.FILTER_BILINEAR
        record.wrap = {"repeat": c.WRAP_REPEAT, "mirror": c.WRAP_MIRROR, "clamp": c.WRAP_CLAMP}[v.wrap]
        pose = moved(to_world, self._origin)
        if placed:
            name = _pose_of(v)
            self._poses.append(VolumePose(name, self._layout.add(name, pose, MEDIUM + POSE, placed=True)))
        record.to_uv = self._layout.add_values(inverse_of(pose))
        if tracked:
            record.second = self._layout.add_values(super_grid(v.value.reshape(shape), v.wrap))
            self.super_grids.append(SuperGrid(v.parameter, offset, shape, v.wrap, record.second))
            self.followers.append(self.super_grids[-1])
        self._textures.append(record)
        self._texture_ranges.append((offset, v.value.size))
        return len(self._textures) - 1


def _pose_of(v: VolumeDescription) -> str:
    """Return the name of a volume's pose, where that is a parameter."""
    return f"{v.parameter.removesuffix('.data').removesuffix('.value.value')}.to_world"
