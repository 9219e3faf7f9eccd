"""``sunsky``: the clear sky as an environment map and the sun as a directional light, which follow their parameters.

The map is the sky in the light's own coordinates, z up, whose poles lie on the horizon; the sun's direction is one of
the world, as in Mitsuba. Derivatives by turbidity, albedo, pose and the sun's direction are those of the map and of the
sun's irradiance and direction: central differences in double precision on the host (``_STEP``), and at whole
turbidities, where the tables have kinks, the mean of both sides.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.scene.description import EmitterDescription, SkyDescription, TextureDescription
from warp_psdr.scene.errors import error
from warp_psdr.scene.lights.sky_model import TURBIDITIES, sky_radiance, sun_at, sun_irradiance
from warp_psdr.scene.materials.textures import texture
from warp_psdr.scene.transforms import Transform

if TYPE_CHECKING:
    from warp_psdr.scene.layout import Parameter
    from warp_psdr.scene.plugins import Properties
    from warp_psdr.scene.scene import Scene

#: Rows and columns of the map: the horizon lies in the middle between columns.
ROWS, COLUMNS = 128, 256
#: Volume of a pose below which it has no inverse.
FLAT = 1.0e-6
#: Step of differences, of numbers of order one.
_STEP = 1.0e-5
#: Parameters of a time and a place, with Mitsuba's defaults, in place of the sun's direction.
_PLACE = {"latitude": 35.6894, "longitude": 139.6917, "timezone": 9.0}
_DATE = {"year": 2010, "month": 7, "day": 10}
_TIME = {"hour": 15.0, "minute": 0.0, "second": 0.0}


def build(props: Properties) -> list[EmitterDescription]:
    """Return the lights that the plugin stands for: the sky, and the sun unless its scale is 0."""
    to_world = props.transform("to_world").astype(np.float32)
    if abs(np.linalg.det(to_world[:3, :3])) < FLAT:
        raise error(props.place("to_world"), "it has no inverse", "give a rotation")
    direction = _sun_direction(props, to_world)
    length = float(np.linalg.norm(direction))
    if not length > 0.0:
        raise error(props.place("sun_direction"), "it has no length", "give a non-zero direction")
    if props.boolean("complex_sun", False):
        raise error(props.place("complex_sun"), "the darkening of the sun's limb", "leave it out: the sun has no disk")
    low, high = TURBIDITIES
    turbidity = props.number("turbidity", 3.0, minimum=low, maximum=high)
    albedo = texture(props, "albedo", 0.3, high=1.0)
    if albedo.kind != "constant":
        raise error(props.place("albedo"), f"a {albedo.kind} texture", "the ground has one albedo; give a colour")
    sky = SkyDescription(
        props.path,
        turbidity,
        albedo.value,
        direction / length,
        props.number("sun_scale", 1.0, minimum=0.0),
        props.number("sky_scale", 1.0, minimum=0.0),
    )
    props.number("sun_aperture", 0.5358, minimum=0.0, maximum=90.0, exclusive=True)  # of equal irradiance
    props.finish()
    values = values_of(sky, to_world)
    if not values.texels.any():
        place = props.place("sun_direction")
        props.context.note(f"{place}: the sun is below the horizon (z of to_world is up), so its sky is black")
    texels = TextureDescription(f"{props.path}.sky", "bitmap", values.texels.astype(np.float32))
    lights = [EmitterDescription(props.path, "envmap", texels, to_world=to_world, scale=sky.sky_scale, sky=sky)]
    if sky.sun_scale > 0.0:
        props.context.note(
            f"{props.where}: the sun is a 'directional' light here, which has no disk: its shadows are sharp, and "
            "neither cameras nor mirrors see it"
        )
        irradiance = TextureDescription(f"{props.path}.sun", "constant", values.irradiance.astype(np.float32))
        frame = values.frame.astype(np.float32)
        lights.append(EmitterDescription(props.path, "directional", irradiance, to_world=frame, sky=sky))
    return lights


def _sun_direction(props: Properties, to_world: np.ndarray) -> np.ndarray:
    """Take the sun's direction, (3,), world coordinates: itself, or that of a time and a place."""
    given = [name for name in (*_PLACE, *_DATE, *_TIME) if props.has(name)]
    if props.has("sun_direction"):
        if given:
            raise error(props.where, f"got both 'sun_direction' and '{given[0]}'", "give one of them")
        return props.vector("sun_direction", (0.0, 0.0, 1.0))
    place = {name: props.number(name, default) for name, default in _PLACE.items()}
    date = {name: props.integer(name, default) for name, default in _DATE.items()}
    hour, minute, second = (props.number(name, default) for name, default in _TIME.items())
    try:
        hours = datetime.timedelta(hours=hour - place["timezone"], minutes=minute, seconds=second)
        when = datetime.datetime(date["year"], date["month"], date["day"]) + hours
    except (ValueError, OverflowError) as problem:
        raise error(props.where, f"no such time: {problem}", "give a year, a month and a day of the calendar") from None
    return to_world[:3, :3].astype(np.float64) @ sun_at(when, place["latitude"], place["longitude"])


@dataclass(frozen=True)
class SkyValues:
    """What follows the parameters, float64."""

    texels: np.ndarray  #: (ROWS, COLUMNS, 3)
    irradiance: np.ndarray  #: (3,)
    frame: np.ndarray  #: (4, 4), of the directional light: +z is the way that light travels

    def dot(self, other: SkyValues) -> float:
        """Return the inner product."""
        return float(
            (self.texels * other.texels).sum()
            + (self.irradiance * other.irradiance).sum()
            + (self.frame[:3, 2] * other.frame[:3, 2]).sum()
        )


def _directions() -> np.ndarray:
    """Return the directions of the texels, (ROWS, COLUMNS, 3), by the rule of ``kernels/emitter/envmap.py``."""
    theta = np.pi * np.arange(ROWS)[:, None] / (ROWS - 1)
    phi = 2.0 * np.pi * (np.arange(COLUMNS) + 0.5)[None, :] / COLUMNS
    x, y, z = np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def values_of(sky: SkyDescription, to_world: np.ndarray) -> SkyValues:
    """Return what follows from the parameters of a sky and its pose."""
    return _values(sky.turbidity, sky.albedo, sky.sun_direction, sky.sun_scale, np.asarray(to_world, np.float64))


def _values(turbidity: float, albedo: np.ndarray, sun: np.ndarray, sun_scale: float, pose: np.ndarray) -> SkyValues:
    travel = -sun / np.linalg.norm(sun)
    sun = np.linalg.solve(pose[:3, :3], sun)
    sun /= np.linalg.norm(sun)
    directions = _directions()
    above = directions[..., 2] > 0.0
    texels = np.zeros(directions.shape)
    texels[above] = sky_radiance(directions[above], sun, turbidity, np.broadcast_to(albedo, 3))
    helper = np.eye(3)[int(np.argmin(np.abs(travel)))]
    frame = Transform.look_at((0.0, 0.0, 0.0), travel, helper).matrix
    return SkyValues(texels, sun_scale * sun_irradiance(sun, turbidity), np.asarray(frame, np.float64))


@dataclass(frozen=True)
class SkyRecord:
    """Where the parameters of a sky are, and what follows them: flat offsets, -1 for what belongs to a sun that is not.

    The names of the parameters are ``path`` with those of the attributes down to ``pose``, in Mitsuba's words.
    """

    path: str
    turbidity: int
    albedo: int
    channels: int  #: of the albedo
    direction: int
    sun_scale: int
    pose: int
    texels: int
    irradiance: int
    frame: int

    @property
    def names(self) -> dict[str, str]:
        """Parameter -> attribute, of what moves the map, the sun's irradiance or its direction."""
        found = {"turbidity": "turbidity", "albedo.value": "albedo", "sun_direction": "direction", "to_world": "pose"}
        if self.sun_scale >= 0:
            found["sun_scale"] = "sun_scale"
        return {f"{self.path}.{name}": attribute for name, attribute in found.items()}

    def ranges(self) -> list[tuple[int, int]]:
        """Flat (offset, size) of what follows."""
        found = [(self.texels, ROWS * COLUMNS * 3), (self.irradiance, 3), (self.frame, 16)]
        return [(offset, size) for offset, size in found if offset >= 0]

    def rebuild(self, values: wp.array) -> None:
        """Let what follows follow the values.

        Raises:
            ValueError: one is none that it can have.
        """
        found = self.at(values, {})
        for (offset, size), part in zip(self.ranges(), (found.texels, found.irradiance, found.frame), strict=False):
            values[offset : offset + size].assign(part.astype(np.float32).reshape(-1))

    def at(self, values: wp.array, moved: dict[str, np.ndarray]) -> SkyValues:
        """Return what follows the values, with some attributes moved by vectors."""
        sizes = {"turbidity": 1, "albedo": self.channels, "direction": 3, "pose": 16, "sun_scale": 1}
        held = {name: np.zeros(size) for name, size in sizes.items()}
        for name, size in sizes.items():
            if getattr(self, name) >= 0:
                held[name] = _stretch(values, getattr(self, name), size) + moved.get(name, 0.0)
        if not moved:
            self._check(held)
        pose = held["pose"].reshape(4, 4)
        return _values(
            float(held["turbidity"][0]), held["albedo"], held["direction"], float(held["sun_scale"][0]), pose
        )

    def _check(self, held: dict[str, np.ndarray]) -> None:
        ends = {"turbidity": TURBIDITIES, "albedo": (0.0, 1.0)}
        for name, attribute in self.names.items():
            low, high = ends.get(attribute, (-np.inf, np.inf))
            value = held[attribute]
            if not (np.isfinite(value).all() and value.min() >= low and value.max() <= high):
                wanted = f"values from {low:g} to {high:g}"
                raise ValueError(f"{name} holds {value.tolist()} after an edit; write {wanted}")
            if attribute == "direction" and not value.any():
                raise ValueError(f"{name} has no length after an edit; write a direction towards the sun")
            if attribute == "pose" and abs(np.linalg.det(value.reshape(4, 4)[:3, :3])) < FLAT:
                raise ValueError(f"{name} has no inverse after an edit; write a rotation")


def _stretch(values: wp.array, offset: int, size: int) -> np.ndarray:
    return values[offset : offset + size].numpy().astype(np.float64)


def follow_sky(scene: Scene, changed: Iterable[Parameter]) -> bool:
    """Let the sky follow its parameters, if any has changed; return whether one has."""
    sky = scene.builder.sky
    if sky is None or not {p.name for p in changed} & set(sky.names):
        return False
    sky.rebuild(scene.values)
    return True


def sky_ranges(scene: Scene, names: list[str]) -> list[tuple[int, int]]:
    """Flat (offset, size) of what follows the named parameters."""
    sky = scene.builder.sky
    return sky.ranges() if sky is not None and set(names) & set(sky.names) else []


def pull_sky(scene: Scene, names: list[str], grad: wp.array) -> None:
    """Add the gradients of a sky's parameters that arrive through what follows them; ``grad``: flat, in place."""
    sky = scene.builder.sky
    if sky is None or not sky_ranges(scene, names):
        return
    parts = [_stretch(grad, offset, size) for offset, size in sky.ranges()]
    parts += [np.zeros(3), np.zeros(16)][len(parts) - 1 :]
    adjoint = SkyValues(parts[0].reshape(ROWS, COLUMNS, 3), parts[1], parts[2].reshape(4, 4))
    for name in sorted(set(names) & set(sky.names)):
        attribute, p = sky.names[name], scene.parameters[name]
        pulled = [_slope(scene, sky, attribute, unit, adjoint) for unit in np.eye(p.size)]
        own = grad[p.offset : p.offset + p.size]
        own.assign((own.numpy() + np.array(pulled)).astype(np.float32))


def _slope(scene: Scene, sky: SkyRecord, attribute: str, along: np.ndarray, adjoint: SkyValues) -> float:
    ahead, behind = (sky.at(scene.values, {attribute: sign * _STEP * along}) for sign in (1.0, -1.0))
    return (ahead.dot(adjoint) - behind.dot(adjoint)) / (2.0 * _STEP)


def push_sky(scene: Scene, names: list[str], tangent: wp.array) -> None:
    """Add the tangents of what follows the named parameters; ``tangent``: flat, in place."""
    sky = scene.builder.sky
    if sky is None or not sky_ranges(scene, names):
        return
    named = [(sky.names[name], scene.parameters[name]) for name in set(names) & set(sky.names)]
    along = {attribute: _stretch(tangent, p.offset, p.size) for attribute, p in named}
    ahead, behind = (
        sky.at(scene.values, {attribute: sign * _STEP * v for attribute, v in along.items()}) for sign in (1.0, -1.0)
    )
    for offset, size in sky.ranges():
        part = {sky.texels: "texels", sky.irradiance: "irradiance", sky.frame: "frame"}[offset]
        slope = (getattr(ahead, part) - getattr(behind, part)).reshape(-1) / (2.0 * _STEP)
        own = tangent[offset : offset + size]
        own.assign((own.numpy() + slope).astype(np.float32))
