"""A scene as plain values: what the readers produce and what the device build consumes.

Everything is NumPy, float32, world space and validated; nothing here knows Warp. ``path`` fields hold the name under
which ``psdr.traverse`` lists the values of an object (Mitsuba 3's names), for example ``"wall.reflectance"``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from warp_psdr.scene.kinds.kind import Geometry


@dataclass(eq=False)
class TextureDescription:
    """A value that may vary over a surface (or over directions, for environment maps)."""

    path: str  #: e.g. "wall.reflectance"
    kind: Literal["constant", "bitmap", "mesh_attribute", "checkerboard", "volume"]
    #: constant: (1,) or (3,); bitmap: (H, W, 1 or 3), linear, top row first; volume: (Z, Y, X, 1 or 3); others: (0,)
    value: np.ndarray
    filter: Literal["bilinear", "trilinear", "nearest"] = "bilinear"
    wrap: Literal["repeat", "mirror", "clamp"] = "repeat"
    to_uv: np.ndarray = field(default_factory=lambda: np.eye(3, dtype=np.float32))  #: (3, 3), bitmaps, checkerboards
    attribute: str = ""  #: mesh_attribute: "vertex_color", "face_albedo", ...
    scale: float | None = None  #: mesh_attribute: what multiplies it; None: not given
    plain: bool = False  #: constant: a bare number of its plugin, listed under ``path`` itself
    to_world: np.ndarray | None = None  #: (4, 4), volume: where the unit cube that it fills is
    #: checkerboard: the textures of its fields, that of the field at the origin of texture coordinates first
    nested: tuple[TextureDescription, ...] = ()

    @property
    def leaves(self) -> tuple[TextureDescription, ...]:
        """The textures that hold values: those nested in this one, or itself."""
        return self.nested or (self,)

    def holds(self, parameter: str) -> bool:
        """Whether a parameter of this name holds values of the texture."""
        return any(parameter in (t.parameter, t.scale_parameter) for t in self.leaves)

    @property
    def scale_parameter(self) -> str:
        """Name under which the scale of a mesh attribute is listed; empty: it has none."""
        return "" if self.scale is None else f"{self.path}.scale"

    @property
    def parameter(self) -> str:
        """Name under which the values are listed; those of a mesh attribute belong to the shapes that read it."""
        if self.kind == "constant":
            return self.path if self.plain else f"{self.path}.value"
        return f"{self.path}.data" if self.kind in ("bitmap", "volume") else ""


@dataclass(eq=False)
class BsdfDescription:
    """One scattering model with its textures; shared by identity between the shapes that reference it."""

    path: str
    model: str  #: plugin name
    #: One for each value that the model declares (``kernels/bsdf/model.py``), by its name there; the same object twice
    #: for alpha_u and alpha_v of an isotropic model.
    textures: dict[str, TextureDescription]
    variant: str = ""  #: of the model, for example "ggx"
    #: Values that are no parameters, such as sampling rates, by their names; they are not listed.
    fixed: dict[str, float] = field(default_factory=dict)
    #: Keys (``kernels/bsdf/model.py``) of the models nested in it, whose textures are among its own.
    children: tuple[str, ...] = ()
    two_sided: bool = False
    back: BsdfDescription | None = None  #: two_sided with a different model behind

    @property
    def sides(self) -> tuple[BsdfDescription, ...]:
        """This model, and a different one behind."""
        return (self,) if self.back is None else (self, self.back)

    def reads(self, parameter: str) -> bool:
        """Whether a texture of this side holds a parameter."""
        return any(t.holds(parameter) for t in self.textures.values())


@dataclass(eq=False)
class SkyDescription:
    """A clear sky and its sun; what its lights have follows from it."""

    path: str
    turbidity: float
    albedo: np.ndarray  #: (1,) or (3,), of the ground
    sun_direction: np.ndarray  #: (3,) unit, towards the sun, z up
    sun_scale: float
    sky_scale: float


@dataclass(eq=False)
class EmitterDescription:
    """A light source. The shape holds area and directional area lights."""

    path: str
    kind: Literal["area", "directionalarea", "constant", "envmap", "point", "spot", "projector", "directional"]
    radiance: TextureDescription  #: area, constant: radiance; envmap: data; point, spot: intensity; others: irradiance
    to_world: np.ndarray | None = None  #: (4, 4): envmap, spot, projector, directional
    position: np.ndarray | None = None  #: (3,): point
    scale: float = 1.0  #: envmap, projector
    cutoff_angle: float = 20.0  #: spot, degrees
    beam_width: float = 15.0  #: spot, degrees
    x_fov: float = 0.0  #: projector, degrees, horizontal
    projected: TextureDescription | None = None  #: spot: a bitmap that the cone projects
    sky: SkyDescription | None = None  #: envmap, directional: the clear sky whose map, or sun, it is
    medium: MediumDescription | None = None  #: that it names as the one that it is in; what bounds media decides


@dataclass(eq=False)
class VolumeDescription:
    """A coefficient of a medium."""

    parameter: str  #: name under which it is listed
    value: np.ndarray  #: (1,) or (3,); a grid: (Z, Y, X, 1 or 3)
    to_world: np.ndarray | None = None  #: (4, 4): where the unit cube that it fills is; None: it is everywhere
    filter: Literal["trilinear", "nearest"] = "trilinear"
    wrap: Literal["clamp", "repeat", "mirror"] = "clamp"


@dataclass(eq=False)
class PhaseDescription:
    """A phase function."""

    path: str
    kind: Literal["isotropic", "hg", "rayleigh", "tabphase", "blendphase", "sggx"]
    g: float = 0.0  #: hg: mean cosine, more than 0 scatters forward
    values: np.ndarray | None = None  #: tabphase: (N,), at equal distances of the cosine from backwards to forwards
    weight: VolumeDescription | None = None  #: blendphase: share of the second one of ``nested``
    nested: tuple[PhaseDescription, ...] = ()  #: blendphase: two
    flakes: VolumeDescription | None = None  #: sggx: (6,) or (Z, Y, X, 6): S_xx, S_yy, S_zz, S_xy, S_xz, S_yz

    @property
    def flakes_vary(self) -> bool:
        """Whether microflakes differ from place to place."""
        return self.flakes is not None and self.flakes.value.size > 6


@dataclass(eq=False)
class MediumDescription:
    """A medium; shared by identity between the shapes and sensors that reference it."""

    path: str
    sigma_t: VolumeDescription  #: per unit length, before ``scale``
    albedo: VolumeDescription
    scale: float
    phase: PhaseDescription
    grids: bool = False  #: heterogeneous
    emission: VolumeDescription | None = None  #: radiance per unit length

    @property
    def tracked(self) -> bool:
        """Whether the medium differs from place to place: flights through it are tracked."""
        varying = [v for v in (self.albedo, self.emission) if v is not None and v.value.ndim == 4]
        return self.grids or self.phase.flakes_vary or bool(varying)


@dataclass(eq=False)
class ShapeDescription:
    """A triangle mesh, world space, or a shape without triangles (``geometry``)."""

    path: str
    kind: str  #: plugin name
    vertices: np.ndarray  #: (N, 3)
    faces: np.ndarray  #: (M, 3) int32
    bsdf: BsdfDescription
    normals: np.ndarray | None = None  #: (N, 3) unit, world space; None: flat shading
    normals_computed: bool = False  #: True: derived from the positions, and follow them when those are edited
    texcoords: np.ndarray | None = None  #: (N, 2)
    flip_normals: bool = False
    attributes: dict[str, np.ndarray] = field(default_factory=dict)  #: "vertex_*": (N, C), "face_*": (M, C)
    emitter: EmitterDescription | None = None  #: its surface shines
    carried: EmitterDescription | None = None  #: a light that it has, but whose place is its own
    #: ``to_world`` is a parameter: vertices = to_world @ local_vertices, normals by the inverse transpose. None: the
    #: matrix has no inverse, or the shape is part of a group.
    to_world: np.ndarray | None = None  #: (4, 4)
    local_vertices: np.ndarray | None = None  #: (N, 3) object space; None: found from the vertices (``scene/poses.py``)
    local_normals: np.ndarray | None = None  #: (N, 3)
    sensor: SensorDescription | None = None  #: an irradiance meter
    interior: MediumDescription | None = None  #: medium behind the triangles, against their normals
    exterior: MediumDescription | None = None  #: medium before them
    #: A copy of a shape of a group: that shape, in the group's space, whose values all copies share; and the path of
    #: the instance, whose ``to_world`` they have. A grid of signed distances is no copy: it is where its instance is.
    prototype: ShapeDescription | None = None
    instance: str = ""
    geometry: Geometry | None = None  #: of a shape without triangles; ``vertices`` are corners of a box around it
    repairs: dict[str, int] = field(default_factory=dict)  #: e.g. {"zero-area triangles dropped": 3}

    @property
    def source(self) -> str:
        """Path under which its vertices and attributes are listed."""
        return self.path if self.prototype is None else self.prototype.path


#: What a call takes as ``sensor``: a number, an id, or several of them.
Sensor = int | str | Sequence[int | str]


@dataclass(frozen=True)
class Views:
    """What a call's ``sensor`` names.

    Attributes:
        sensors: their numbers, from left to right or from first to last.
        batch: number of the ``batch`` on whose film they stand side by side; None: there is none.
        stacked: they were given as a list: their images are stacked, (B, H, W).
    """

    sensors: tuple[int, ...]
    batch: int | None = None
    stacked: bool = False

    @property
    def several(self) -> bool:
        """Whether the call puts images together."""
        return self.stacked or self.batch is not None


@dataclass(frozen=True)
class TimeBins:
    """The time bins of a transient film; lengths are optical path lengths, world units."""

    count: int
    width: float  #: of a bin
    start: float  #: of the first bin
    pulse: Literal["box", "gaussian"]  #: shape of the light's pulse
    pulse_length: float  #: box: its width; gaussian: its standard deviation; 0: all light leaves at once
    unwarp: bool  #: lengths count from the first surface on, not from the camera


@dataclass(eq=False)
class FilmDescription:
    """The image raster."""

    width: int = 768
    height: int = 576
    crop_offset_x: int = 0
    crop_offset_y: int = 0
    crop_width: int = 768
    crop_height: int = 576
    filter: Literal["box", "tent", "gaussian"] = "gaussian"
    filter_radius: float = 2.0  #: pixels
    filter_stddev: float = 0.5  #: pixels, gaussian
    sample_border: bool = False  #: whether pixels see what lies beyond the crop window, under wide filters
    times: TimeBins | None = None  #: of a transient film


@dataclass(eq=False)
class SensorDescription:
    """A camera or a meter. Space convention as in Mitsuba: looks along +z, +y up, +x to the left of the image."""

    path: str
    kind: Literal["perspective", "orthographic", "thinlens", "radiancemeter", "irradiancemeter", "batch"]
    #: (4, 4); perspective, thinlens: rigid with optional uniform scale removed; orthographic: any invertible matrix, of
    #: which the first column is half the film's width and the third the direction of view; radiancemeter: the third and
    #: fourth column are those of its ray; irradiancemeter: not used, the shape that holds it counts
    to_world: np.ndarray
    x_fov: float = 0.0  #: degrees, horizontal field of view of the whole film (fov_axis already resolved)
    principal_point_offset: tuple[float, float] = (0.0, 0.0)
    distortion: Literal["", "opencv", "fisheye"] = ""  #: perspective, thinlens; "": none, and square pixels
    #: (10,) with distortion: fy / fx, skew, and the coefficients, see ``kernels/sensor/distortion.py``
    distortion_numbers: tuple[float, ...] = ()
    aperture_radius: float = 0.0  #: thinlens, world units
    focus_distance: float = 1.0  #: thinlens, world units along the viewing axis
    near_clip: float = 1e-2
    far_clip: float = 1e4
    film: FilmDescription = field(default_factory=FilmDescription)
    sampler: Literal["default", "independent", "sobol"] = "default"
    sample_count: int = 4
    medium: MediumDescription | None = None  #: that it is in
    nested: tuple[SensorDescription, ...] = ()  #: batch: the sensors that share its film, from the left to the right


@dataclass(eq=False)
class SceneDescription:
    """All of a scene."""

    shapes: list[ShapeDescription]
    emitters: list[EmitterDescription]  #: every light, area lights included
    sensors: list[SensorDescription]  #: those of batches after all others
    #: Properties of the integrator that the file names: {"type": "path", "max_depth": 8, "rr_depth": 5,
    #: "hide_emitters": False}; empty when there is none. An ``aov`` is the one nested in it, or {"type": "aov"}, with
    #: "aovs": {name: type}.
    integrator: dict = field(default_factory=dict)
    source: str = ""  #: file name or "dict", for messages
    #: (3,) float64: what was subtracted from all positions, those of matrices included; see ``origin``.
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    notes: list[str] = field(default_factory=list)  #: reported repairs and ignored cosmetic properties
    max_collisions: float = 1e7  #: tentative collisions that a flight through a medium may take, see ``collisions``

    def views(self, sensor: Sensor) -> Views:
        """Return what a call's ``sensor`` names.

        Args:
            sensor: a number, an id, or several of them in a list.

        Raises:
            ValueError: There is no such sensor, the list is empty, or it holds a batch.
        """
        if isinstance(sensor, Sequence) and not isinstance(sensor, str):
            if not sensor:
                raise ValueError("sensor: got an empty list; name at least one sensor")
            numbers = tuple(self.camera_number(one) for one in sensor)
            if len(set(numbers)) < len(numbers):
                raise ValueError(f"sensor: got {list(sensor)}, which names a sensor twice; name each once")
            return Views(numbers, stacked=True)
        number = self.sensor_number(sensor)
        nested = self.sensors[number].nested
        if not nested:
            return Views((number,))
        return Views(tuple(next(i for i, s in enumerate(self.sensors) if s is part) for part in nested), batch=number)

    def camera_number(self, sensor: int | str) -> int:
        """Return the number of a sensor that is no batch; as ``sensor_number``.

        Raises:
            ValueError: There is no such sensor, or it is a batch.
        """
        number = self.sensor_number(sensor)
        names = ", ".join(repr(s.path) for s in self.sensors[number].nested)
        if names:
            raise ValueError(
                f"sensor {self.sensors[number].path!r} is a 'batch', which cannot be given here; give its sensors, or "
                f"one of them: {names}"
            )
        return number

    def sensor_number(self, sensor: int | str) -> int:
        """Return the number of a sensor, which is given by its number, from the end if negative, or by its id.

        Raises:
            ValueError: There is no such sensor.
        """
        names, count = [s.path for s in self.sensors], len(self.sensors)
        if isinstance(sensor, str) and sensor in names:
            return names.index(sensor)
        whole = isinstance(sensor, (int, np.integer)) and not isinstance(sensor, bool)
        if not whole or not -count <= int(sensor) < count:
            known = ", ".join(map(repr, names))
            raise ValueError(f"sensor {sensor!r}: the scene has sensors 0 to {count - 1}, with the ids {known}")
        return int(sensor) % count
