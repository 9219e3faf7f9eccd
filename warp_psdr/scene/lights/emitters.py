"""Light sources."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.scene.description import EmitterDescription, TextureDescription
from warp_psdr.scene.errors import SceneError, error
from warp_psdr.scene.materials.textures import bitmap_values, texture
from warp_psdr.scene.media.coefficients import take_medium
from warp_psdr.scene.origin import moved
from warp_psdr.scene.pinhole import rigid_pose, x_fov
from warp_psdr.scene.plugins import Properties
from warp_psdr.scene.transforms import Transform

if TYPE_CHECKING:
    from warp_psdr.scene.context import Context


#: Lights that are in a place, and may name the medium there.
IN_MEDIA = ("point", "spot", "projector")
#: Lights that a shape may have, as in Mitsuba: they stay where their own pose has them, and its surface does not shine.
CARRIED = (*IN_MEDIA, "directional")


def build(node: dict, where: str, path: str, context: Context) -> EmitterDescription:
    """Return the light that a plugin dictionary of the scene describes; an area light is ``build_area``'s.

    Raises:
        ValueError: If a parameter is not supported or out of range.
        FileNotFoundError: If its image does not exist.
    """
    builders = {
        "constant": _constant,
        "envmap": _envmap,
        "point": _point,
        "spot": _spot,
        "projector": _projector,
        "directional": _directional,
    }
    props = Properties(node, where, path, context)
    _ignore_weights(props)
    result = builders[props.type](props)
    if props.type in IN_MEDIA:
        result.medium = take_medium(props)
    for _key, _node, place in props.children("medium"):
        raise error(place, f"a medium of a '{props.type}' light, which is around the scene", "name it for the 'sensor'")
    props.finish()
    return result


def build_area(node: dict, where: str, path: str, context: Context, *, shared: bool) -> EmitterDescription:
    """Return the area light of a shape.

    Args:
        node: The dictionary, references resolved.
        where: Its place, for messages.
        path: The name under which its radiance is listed if this is its first use.
        context: The load in progress.
        shared: Whether a reference led here.

    Raises:
        ValueError: If it is of another kind or a parameter is out of range.
    """
    return context.build(node, where, "area", lambda: _area(Properties(node, where, path, context)), shared=shared)


def _area(props: Properties) -> EmitterDescription:
    if props.type not in ("area", "directionalarea"):
        remedy = (
            f"shapes take 'area', 'directionalarea' and {', '.join(map(repr, CARRIED))} in place; move it to the scene"
        )
        raise error(props.where, f"a '{props.type}' emitter inside a shape", remedy)
    _ignore_weights(props)
    if props.type == "directionalarea":
        light = EmitterDescription(
            props.path, "directionalarea", _uniform(props, "radiance"), medium=take_medium(props)
        )
        props.finish()
        return light
    radiance = texture(props, "radiance", 1.0, emissive=True)
    if any(leaf.kind == "volume" for leaf in radiance.leaves):
        raise error(props.place("radiance"), "a 'volume'", "lights take colours, bitmaps and mesh attributes; give one")
    medium = take_medium(props)
    props.finish()
    return EmitterDescription(props.path, "area", radiance, medium=medium)


def _ignore_weights(props: Properties) -> None:
    props.ignore("sampling_weight", reason="lights are selected by their power")


def _constant(props: Properties) -> EmitterDescription:
    radiance = texture(props, "radiance", 1.0, emissive=True)
    if radiance.kind != "constant":
        raise error(props.place("radiance"), "a texture", "a constant light has one radiance; use 'envmap' for images")
    return EmitterDescription(props.path, "constant", radiance)


def _envmap(props: Properties) -> EmitterDescription:
    texels = bitmap_values(props, raw=False)
    if texels.shape[2] == 1:
        texels = np.repeat(texels, 3, axis=2)
    if not np.isfinite(texels).all():
        count = int((~np.isfinite(texels)).sum())
        raise error(props.where, f"{count} values of the environment map are NaN or infinite", "repair the image")
    negative = int((texels < 0.0).sum())
    if negative:
        texels = np.maximum(texels, 0.0)
        props.context.note(f"{props.where}: {negative} negative values of the environment map were set to 0")
    if texels.shape[0] < 2 or texels.shape[1] < 2:
        size = f"{texels.shape[1]}x{texels.shape[0]}"
        raise error(props.where, f"the environment map has {size} texels", "give at least 2x2, or use 'constant'")
    props.ignore("mis_compensation", reason="it is done wherever the map has contrast")
    return EmitterDescription(
        props.path,
        "envmap",
        TextureDescription(props.path, "bitmap", np.ascontiguousarray(texels)),
        to_world=_rotation(props),
        scale=props.number("scale", 1.0, minimum=0.0),
    )


def _point(props: Properties) -> EmitterDescription:
    if props.has("position", "to_world") and props.has("position") == props.has("to_world"):
        raise error(props.where, "got both 'position' and 'to_world'", "give one of them")
    position = props.vector("position", (0.0, 0.0, 0.0))
    position = props.transform("to_world")[:3, 3] if props.has("to_world") else position
    props.take("to_world")
    position = (position - props.context.origin).astype(np.float32)
    return EmitterDescription(props.path, "point", _uniform(props, "intensity"), position=position)


def _spot(props: Properties) -> EmitterDescription:
    cutoff = props.number("cutoff_angle", 20.0, minimum=0.0, maximum=90.0)
    beam = props.number("beam_width", 0.75 * cutoff, minimum=0.0)
    if beam > cutoff or cutoff == 0.0:
        angles = f"beam_width is {beam:g} and cutoff_angle {cutoff:g}"
        raise error(props.where, angles, "give 0 <= beam_width <= cutoff_angle and a positive cutoff_angle")
    return EmitterDescription(
        props.path,
        "spot",
        _uniform(props, "intensity"),
        to_world=moved(props.transform("to_world"), props.context.origin).astype(np.float32),
        cutoff_angle=cutoff,
        beam_width=beam,
        projected=_projected(props),
    )


def _projected(props: Properties) -> TextureDescription | None:
    """Take the bitmap that a spot projects; it is a parameter of its own even if something else refers to it, too."""
    if not props.has("texture"):
        props.take("texture")
        return None
    reported = len(props.context.problems)
    result = texture(props, "texture", 1.0)
    if len(props.context.problems) > reported:
        return None
    if result.kind != "bitmap":
        raise error(props.place("texture"), f"a {result.kind} texture", "give a bitmap; the intensity has the colour")
    if result.filter != "bilinear":
        # Its texels would have edges that move with what they fall on.
        raise error(props.place("texture"), f"a filter_type of '{result.filter}'", "a spot projects 'bilinear' bitmaps")
    return dataclasses.replace(result, path=f"{props.path}.texture")


def _projector(props: Properties) -> EmitterDescription:
    irradiance = texture(props, "irradiance", 1.0, emissive=True)
    if irradiance.kind not in ("constant", "bitmap"):
        place = props.place("irradiance")
        raise error(place, f"a {irradiance.kind} texture", "a projector throws a bitmap or a colour")
    aspect = 1.0
    if irradiance.kind == "bitmap":
        height, width = irradiance.value.shape[:2]
        aspect = width / height
        # A parameter of its own even if something else refers to it, too.
        irradiance = dataclasses.replace(irradiance, path=f"{props.path}.irradiance")
    return EmitterDescription(
        props.path,
        "projector",
        irradiance,
        to_world=moved(rigid_pose(props), props.context.origin).astype(np.float32),
        scale=props.number("scale", 1.0, minimum=0.0),
        x_fov=x_fov(props, aspect),
    )


def _directional(props: Properties) -> EmitterDescription:
    to_world = _rotation(props)
    if props.has("direction"):
        if props.has("to_world"):
            raise error(props.where, "got both 'direction' and 'to_world'", "give one of them")
        to_world = _frame_along(props)
    props.take("direction")
    return EmitterDescription(props.path, "directional", _uniform(props, "irradiance"), to_world=to_world)


def _frame_along(props: Properties) -> np.ndarray:
    """Return a frame whose +z is ``direction``, the way that the light travels."""
    direction = props.vector("direction", (0.0, 0.0, 1.0))
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    try:
        return Transform.look_at((0.0, 0.0, 0.0), direction, helper).matrix.astype(np.float32)
    except SceneError:
        raise error(props.place("direction"), "it has no length", "give a non-zero direction") from None


def _uniform(props: Properties, name: str) -> TextureDescription:
    result = texture(props, name, 1.0, emissive=True)
    if result.kind != "constant":
        raise error(props.place(name), "a texture", f"a {props.type} light has one {name}; give a colour")
    return result


def _rotation(props: Properties) -> np.ndarray:
    return props.transform("to_world").astype(np.float32)
