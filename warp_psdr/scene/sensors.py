"""Cameras, films, reconstruction filters and samplers."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from warp_psdr.kernels.constants import FAR
from warp_psdr.scene.description import FilmDescription, SensorDescription, TimeBins
from warp_psdr.scene.distortion import FilmPlane, fault, take_distortion
from warp_psdr.scene.errors import error
from warp_psdr.scene.media.coefficients import take_medium
from warp_psdr.scene.origin import moved
from warp_psdr.scene.pinhole import rigid_pose, x_fov
from warp_psdr.scene.plugins import PLUGINS, Properties, unsupported_plugin
from warp_psdr.scene.transforms import Transform

if TYPE_CHECKING:
    from warp_psdr.scene.context import Context

#: Degrees, of the camera of a scene without one.
_DEFAULT_FOV = 45.0
#: Parameters of a film that matter when Mitsuba writes an image.
_WRITTEN = {"file_format": ("openexr", "exr", "rgbe", "pfm"), "component_format": ("float16", "float32", "uint32")}
_FILM_MAX = 65536
#: Pixels of a film, 3 GB: images and their gradients are kept as a whole.
_PIXELS_MAX = 1 << 28
#: Sensors of a batch, and their kinds.
_SENSORS_MAX = 1024
_IN_BATCH = ("perspective", "orthographic", "thinlens")
#: Shapes of the light's pulse before a transient film.
_PULSES = ("box", "gaussian")
#: Radius of a reconstruction filter, pixels: the film grows by it on every side.
_RADIUS_MAX = 64.0


_Filter = tuple[Literal["box", "tent", "gaussian"], float, float]
_Sampler = tuple[Literal["default", "independent", "sobol"], int]
#: Name, radius and standard deviation of the filter of a film that names none.
_GAUSSIAN: _Filter = ("gaussian", 2.0, 0.5)
#: Sampler and samples of a camera that names none.
_NO_SAMPLER: _Sampler = ("default", 4)


def build(node: dict, where: str, path: str, context: Context) -> SensorDescription:
    """Return the camera that a plugin dictionary describes.

    Raises:
        ValueError: If a parameter is not supported or out of range.
    """
    props = Properties(node, where, path, context)
    if props.type not in PLUGINS["sensor"]:
        raise unsupported_plugin(props.type, where, "sensor")
    if props.type == "irradiancemeter":
        raise error(
            where, "an 'irradiancemeter' outside of a shape", "nest it in the shape whose irradiance it measures"
        )
    if props.type == "radiancemeter":
        return _radiance_meter(props)
    if props.type == "batch":
        return _batch(props)
    kind = cast(Literal["perspective", "orthographic", "thinlens"], props.type)
    film = context.attempt(lambda: _film(props), FilmDescription())
    sampler, sample_count = context.attempt(lambda: _sampler(props), _NO_SAMPLER)
    near = props.number("near_clip", 1e-2, minimum=0.0, exclusive=True)
    far = props.number("far_clip", 1e4, minimum=0.0, exclusive=True)
    if near >= far:
        raise error(where, f"near_clip is {near:g} and far_clip {far:g}", "near_clip must be the smaller one")
    props.ignore("shutter_open", "shutter_close", reason="there is no motion blur")
    medium = take_medium(props)
    parallel = kind == "orthographic"
    to_world = props.transform("to_world") if parallel else rigid_pose(props)
    result = SensorDescription(
        path=path,
        kind=kind,
        to_world=moved(to_world, context.origin).astype(np.float32),
        near_clip=near,
        far_clip=far,
        film=film,
        sampler=sampler,
        sample_count=sample_count,
        medium=medium,
    )
    if kind == "thinlens":
        result.aperture_radius = props.number("aperture_radius", None, minimum=0.0)
        result.focus_distance = props.number("focus_distance", far, minimum=0.0, exclusive=True)
    else:
        props.ignore("focus_distance", reason="without a lens the image is sharp everywhere")
    if not parallel:
        result.distortion, result.distortion_numbers = take_distortion(props)
        aspect = result.distortion_numbers[0] if result.distortion else 1.0
        result.x_fov = x_fov(props, aspect * film.width / film.height)
        result.principal_point_offset = (
            props.number("principal_point_offset_x", 0.0),
            props.number("principal_point_offset_y", 0.0),
        )
        if result.distortion:
            plane = FilmPlane.of(film, result.x_fov, result.principal_point_offset)
            problem = fault(result.distortion, result.distortion_numbers, plane)
            if problem:
                raise error(where, *problem)
    props.finish()
    return result


def _batch(props: Properties) -> SensorDescription:
    """Return sensors side by side on one film, whose filter, samples and height they have."""
    film = props.context.attempt(lambda: _film(props), FilmDescription())
    sampler, sample_count = props.context.attempt(lambda: _sampler(props), _NO_SAMPLER)
    props.ignore("shutter_open", "shutter_close", reason="there is no motion blur")
    props.ignore("to_world", reason="every sensor of a batch has its own")
    nested = []
    for key, node, where in props.children("sensor", _SENSORS_MAX):
        if node.get("type") not in _IN_BATCH:
            problem = f"a '{node.get('type')}' in a 'batch'"
            raise error(where, problem, f"give it cameras: {', '.join(_IN_BATCH)}")
        if node is not props.node[key]:
            raise error(where, "a reference in a 'batch'", "nest the sensor itself, for its film becomes another one")
        name = node["id"] if isinstance(node.get("id"), str) else key
        nested.append(build(node, where, f"{props.path}.{name}", props.context))
    props.finish()
    if not nested:
        raise error(props.where, "a 'batch' without sensors", "nest one or more")
    if film.times is not None:
        raise error(props.where, "a 'transient_hdr_film' in a 'batch'", "give each camera a film, and no 'batch'")
    if (film.crop_width, film.crop_height) != (film.width, film.height):
        raise error(props.where, "a film with a crop window in a 'batch'", "leave the crop out")
    width, rest = divmod(film.width, len(nested))
    if rest:
        problem = f"a film {film.width} pixels wide for {len(nested)} sensors"
        raise error(props.where, problem, f"give it a width that {len(nested)} divides")
    for part in nested:
        part.film = dataclasses.replace(film, width=width, crop_width=width)
        part.sampler, part.sample_count = sampler, sample_count
    return SensorDescription(
        props.path,
        "batch",
        np.eye(4, dtype=np.float32),
        film=film,
        sampler=sampler,
        sample_count=sample_count,
        nested=tuple(nested),
    )


def build_meter(node: dict, where: str, path: str, context: Context) -> SensorDescription:
    """Return the irradiance meter of a shape.

    Raises:
        ValueError: If it is of another kind or a parameter is out of range.
    """
    props = Properties(node, where, path, context)
    if props.type != "irradiancemeter":
        raise error(where, f"a '{props.type}' inside a shape", "shapes take 'irradiancemeter'; move it to the scene")
    return _meter(props, "irradiancemeter", np.eye(4))


def _radiance_meter(props: Properties) -> SensorDescription:
    """Return the meter of one ray, from ``origin`` along ``direction`` or along +z of ``to_world``."""
    given = [name for name in ("origin", "direction") if props.has(name)]
    if given and props.has("to_world"):
        raise error(
            props.where, f"got both '{given[0]}' and 'to_world'", "give 'origin' and 'direction', or 'to_world'"
        )
    if len(given) == 1:
        raise error(props.where, f"got '{given[0]}' alone", "give 'origin' and 'direction'")
    to_world = props.transform("to_world")
    origin, direction = props.vector("origin", (0.0, 0.0, 0.0)), props.vector("direction", (0.0, 0.0, 1.0))
    if given:
        helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
        if not direction.any():
            raise error(props.place("direction"), "it has no length", "give a non-zero direction")
        to_world = Transform.look_at(origin, origin + direction, helper).matrix
    return _meter(props, "radiancemeter", moved(to_world, props.context.origin))


def _meter(props: Properties, kind: Literal["radiancemeter", "irradiancemeter"], pose: np.ndarray) -> SensorDescription:
    """Return a sensor of one pixel, which is a mean over rays without a pixel filter."""
    film = props.context.attempt(lambda: _film(props), FilmDescription(1, 1, 0, 0, 1, 1))
    if film.times is not None:
        raise error(props.where, f"a 'transient_hdr_film' of a '{kind}'", "give it to a camera")
    if (film.width, film.height) != (1, 1):
        size = f"a film of {film.width}x{film.height} pixels"
        raise error(props.where, size, f"a '{kind}' shows one number; give its film a width and a height of 1")
    if film.filter != "box" or film.filter_radius != 0.5:
        props.context.note(f"{props.where}: a '{kind}' has no pixel filter; 'box' replaces '{film.filter}'")
    film.filter, film.filter_radius = "box", 0.5
    sampler, sample_count = props.context.attempt(lambda: _sampler(props), _NO_SAMPLER)
    props.ignore("shutter_open", "shutter_close", reason="there is no motion blur")
    medium = take_medium(props)
    props.finish()
    return SensorDescription(
        path=props.path,
        kind=kind,
        to_world=pose.astype(np.float32),
        near_clip=0.0,
        far_clip=FAR,
        film=film,
        sampler=sampler,
        sample_count=sample_count,
        medium=medium,
    )


def default(low: np.ndarray, high: np.ndarray, where: str, path: str, context: Context) -> SensorDescription:
    """Return the camera of a scene that has none: it looks along +z and sees all of the scene, 45 degrees wide.

    It is the one that Mitsuba has made in this case (until 2022; its later versions render no scene without a sensor).

    Args:
        low: (3,) least coordinates of the scene, world units; not finite where it has no shapes.
        high: (3,) largest ones.
        where: Place of the scene, for messages.
        path: Name under which its parameters are listed.
        context: The load in progress.
    """
    node: dict = {"type": "perspective", "fov": _DEFAULT_FOV}
    place = "the origin"
    if np.isfinite(low).all():
        largest = float((high - low).max())
        distance = largest / (2.0 * math.tan(0.5 * math.radians(_DEFAULT_FOV)))
        eye = (*(0.5 * (low + high))[:2], low[2] - distance)
        place = str([round(float(x), 4) for x in eye])
        node |= {
            "near_clip": distance / 100.0,
            "far_clip": 5.0 * largest + distance,
            "to_world": Transform.translate(eye),
        }
    context.note(
        f"{where}: there is no sensor; one at {place} that looks along +z, {_DEFAULT_FOV:g} degrees wide, is used"
    )
    return build(node, where, path, context)


def _film(sensor: Properties) -> FilmDescription:
    nested = sensor.children("film")
    if not nested:
        return FilmDescription()
    key, node, where = nested[0]
    props = Properties(node, where, f"{sensor.path}.{key}", sensor.context)
    width, height = (props.integer(n, d, minimum=1) for n, d in (("width", 768), ("height", 576)))
    if max(width, height) > _FILM_MAX:
        raise error(where, f"the film has {width}x{height} pixels", f"give at most {_FILM_MAX} in each direction")
    if width * height > _PIXELS_MAX:
        raise error(where, f"the film has {width}x{height} pixels", f"give at most {_PIXELS_MAX} altogether")
    crop_x, crop_y = props.integer("crop_offset_x", 0, minimum=0), props.integer("crop_offset_y", 0, minimum=0)
    crop_width = props.integer("crop_width", width, minimum=1)
    crop_height = props.integer("crop_height", height, minimum=1)
    if crop_x + crop_width > width or crop_y + crop_height > height:
        raise error(
            where,
            f"the crop {crop_width}x{crop_height} at ({crop_x}, {crop_y}) leaves the film {width}x{height}",
            "offset and size together must not exceed the film",
        )
    pixel_format = _format(props, "pixel_format", ("rgb", "rgba", "luminance", "luminance_alpha", "xyz", "xyza"))
    if pixel_format != "rgb":
        props.context.note(f"{props.place('pixel_format')}: '{pixel_format}' is ignored; images are RGB")
    for name, choices in _WRITTEN.items():
        if props.has(name):
            _format(props, name, choices)
            props.context.note(f"{props.place(name)} is ignored: it is chosen when an image is written")
        props.take(name)
    props.take("banner")  # Mitsuba 3 draws none either
    sample_border = props.boolean("sample_border", False)
    props.ignore("high_quality_edges", "compensate", reason="it does not apply to this film")
    name, radius, stddev = props.context.attempt(lambda: _filter(props), _GAUSSIAN)
    times = _time_bins(props, crop_width * crop_height) if props.type == "transient_hdr_film" else None
    props.finish()
    return FilmDescription(
        width, height, crop_x, crop_y, crop_width, crop_height, name, radius, stddev, sample_border, times
    )


def _time_bins(film: Properties, pixels: int) -> TimeBins:
    """Return the bins of a transient film, by mitransient's names, and the pulse that they are convolved with."""
    count = film.integer("temporal_bins", 2048, minimum=1)
    if count * pixels > _PIXELS_MAX:
        problem = f"{pixels} pixels with {count} bins each"
        raise error(film.where, problem, f"give at most {_PIXELS_MAX} altogether")
    width = film.number("bin_width_opl", 0.003, minimum=0.0, exclusive=True)
    start = film.number("start_opl", 0.0)
    pulse = film.string("pulse", "box", _PULSES)
    names = {"box": "pulse_width_opl", "gaussian": "pulse_stddev_opl"}
    given = {kind: name for kind, name in names.items() if film.has(name)}
    if set(given) - {pulse}:
        other = next(name for kind, name in given.items() if kind != pulse)
        raise error(film.place(other), f"the pulse is '{pulse}'", f"give '{names[pulse]}' instead")
    length = film.number(names[pulse], width if pulse == "box" else 0.5 * width, minimum=0.0)
    unwarp = film.boolean("camera_unwarp", False)
    return TimeBins(count, width, start, cast(Literal["box", "gaussian"], pulse), length, unwarp)


def _format(props: Properties, name: str, choices: tuple[str, ...]) -> str:
    """Take one of the film's formats, in upper or lower case; the first one is the default."""
    value = props.node.get(name, choices[0])
    lower = value.lower() if isinstance(value, str) else value
    if lower not in choices:
        raise error(props.place(name), f"got {value!r}", f"give one of: {', '.join(choices)}")
    props.take(name)
    return str(lower)


def _filter(film: Properties) -> _Filter:
    """Return a reconstruction filter's name, radius and standard deviation, in pixels."""
    nested = film.children("rfilter")
    if not nested:
        return _GAUSSIAN
    _, node, where = nested[0]
    props = Properties(node, where, film.path, film.context)
    stddev = 0.5
    if props.type == "gaussian":
        # It is cut at four standard deviations, as in Mitsuba, wherever it is sampled or evaluated.
        stddev = props.number("stddev", 0.5, minimum=0.0, exclusive=True)
        radius = 4.0 * stddev
    else:
        radius = props.number("radius", 0.5 if props.type == "box" else 1.0, minimum=0.0, exclusive=True)
    if radius > _RADIUS_MAX:
        name, share = ("stddev", 0.25) if props.type == "gaussian" else ("radius", 1.0)
        raise error(props.place(name), f"got {share * radius:g}", f"give at most {share * _RADIUS_MAX:g} pixels")
    props.finish()
    return cast(Literal["box", "tent", "gaussian"], props.type), radius, stddev


def _sampler(sensor: Properties) -> _Sampler:
    nested = sensor.children("sampler")
    if not nested:
        return _NO_SAMPLER
    _, node, where = nested[0]
    props = Properties(node, where, sensor.path, sensor.context)
    count = props.integer("sample_count", 4, minimum=1)
    props.ignore("seed", reason="the seed is an argument of render()")
    if props.type != "independent":
        props.ignore("jitter", reason="the Sobol sampler is scrambled")
        if props.type != "sobol":
            props.context.note(f"{where}: the sampler '{props.type}' is replaced by a scrambled Sobol sequence")
    props.finish()
    return ("independent" if props.type == "independent" else "sobol"), count
