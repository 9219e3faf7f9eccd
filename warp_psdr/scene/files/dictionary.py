"""Turn a scene dictionary, Mitsuba's ``load_dict`` form, into a validated ``SceneDescription``."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from warp_psdr.scene import sensors
from warp_psdr.scene.aovs import parse_aovs
from warp_psdr.scene.context import Context, Outside
from warp_psdr.scene.description import SceneDescription
from warp_psdr.scene.errors import SceneError, error, limit
from warp_psdr.scene.lights import emitters, sunsky
from warp_psdr.scene.materials import bsdfs, textures
from warp_psdr.scene.materials.nesting import DEPTH_MAX, DICTIONARIES_MAX, check_nesting
from warp_psdr.scene.media.medium_notes import note_media
from warp_psdr.scene.origin import find_origin
from warp_psdr.scene.plugins import Properties, category_of
from warp_psdr.scene.shapes import groups

#: Depths of those that have a limit where none is given, as in Mitsuba.
_DEPTHS = {"prb": 6, "prb_basic": 6, "prb_projective": 6, "prbvolpath": 6}


def describe_dict(
    scene: dict, base: str | os.PathLike[str] | None = None, *, allow_outside: Outside = False
) -> SceneDescription:
    """Return the description of a scene given as nested dictionaries.

    Args:
        scene: ``{"type": "scene", name: {"type": plugin, parameter: value, ...}, ...}``.
        base: Folder that relative file names start from, and in or below which files have to lie. Default: the current
            folder, and anywhere: the names in a dictionary are the program's own.
        allow_outside: With ``base``, where else files may lie; see ``describe_file``.

    Raises:
        TypeError: If ``scene`` is no dictionary.
        ValueError: If a plugin, a parameter or a value is not supported; the message names its place.
        FileNotFoundError: If a file that the scene names does not exist.
    """
    if not isinstance(scene, dict):
        raise TypeError(f"a scene is a dict {{'type': 'scene', ...}}; got {type(scene).__name__}")
    context = Context("dict", Path.cwd(), True) if base is None else Context("dict", Path(base), allow_outside)
    return describe(scene, "scene", context)


def describe(scene: dict, where: str, context: Context) -> SceneDescription:
    """Return the description of a scene's dictionary; relative files and notes go through ``context``.

    Raises:
        ValueError: If anything in the scene cannot be used.
        FileNotFoundError: If a file does not exist.
    """
    if scene.get("type") != "scene":
        raise error(where, f"the outermost type is {scene.get('type')!r}", "wrap the scene in {'type': 'scene', ...}")
    _register(scene, where, context, [], itertools.count(1))
    check_nesting(scene, where, context)
    _survey(scene, where, context)
    again = context.fresh()
    result = _build(scene, where, context)
    if not context.problems:
        context.attempt(lambda: _check(result, where), None)
    context.raise_problems()
    origin = find_origin(result.shapes)
    if not origin.any():
        return result
    again.origin = origin
    again.note(f"{where}: the scene is far from the origin of the world; the device's coordinates start at {origin}")
    return _build(scene, where, again)


def describe_integrator(node: dict) -> tuple[dict[str, Any], list[str]]:
    """Return what ``SceneDescription.integrator`` holds for an integrator's dictionary, and the notes on it.

    Raises:
        ValueError: If it is no integrator that is supported.
    """
    context = Context("integrator", Path.cwd(), True)
    found = category_of(node, "integrator")
    if found != "integrator":
        raise error("integrator", f"'{node.get('type')}' is a {found}", "give {'type': 'path', 'max_depth': 4}")
    described = _integrator(node, "integrator", context)
    context.raise_problems()
    return described, context.notes


def _build(scene: dict, where: str, context: Context) -> SceneDescription:
    """Build every plugin, with all positions relative to the context's origin; problems are reported."""
    result = SceneDescription(shapes=[], emitters=[], sensors=[], source=context.source, notes=context.notes)
    result.origin = context.origin
    for key, value in scene.items():
        if key not in ("type", "id"):
            context.attempt(functools.partial(_top, result, str(key), value, where, context), None)
    if context.problems:
        return result
    for light, place in context.area_lights:
        if not context.is_attached(light):
            context.note(f"{place}: no shape refers to this emitter, so it does not shine")
    if not result.sensors:
        corners = [shape.vertices.astype(np.float64) + context.origin for shape in result.shapes]
        low = np.min([points.min(axis=0) for points in corners], axis=0, initial=np.inf)
        high = np.max([points.max(axis=0) for points in corners], axis=0, initial=-np.inf)
        name = "sensor" if "sensor" not in scene else "default_sensor"
        result.sensors.append(sensors.default(low, high, where, name, context))
    result.sensors += [part for sensor in result.sensors for part in sensor.nested]
    note_media(result)
    return result


def _top(result: SceneDescription, key: str, value: Any, where: str, context: Context) -> None:
    """Build what the scene holds under a key."""
    if not isinstance(value, dict):
        raise error(f"{where}[{key!r}]", f"got {value!r}", "a scene holds plugins; give {'type': plugin, ...}")
    node, place = context.resolve(value, context.inside(where, key, value))
    if id(node) in context.broken:
        return
    # As in Mitsuba an explicit id wins over the dictionary key.
    name = node.get("id") if isinstance(node.get("id"), str) else key
    _add(result, node, place, str(name), context)


def _survey(node: dict, where: str, context: Context) -> None:
    """Report every plugin that is not supported, wherever it is nested."""
    for key, value in node.items():
        if not isinstance(value, dict) or value.get("type") == "ref" or not isinstance(value.get("type"), str):
            continue
        place = context.inside(where, key, value)
        if id(value) not in context.broken:
            try:
                category_of(value, place)
            except SceneError as problem:
                context.broken.add(id(value))
                context.report(problem)
        _survey(value, place, context)


def _add(result: SceneDescription, node: dict, where: str, name: str, context: Context) -> None:
    """Build one top-level plugin and file it."""
    category = category_of(node, where)
    if category == "shape":
        for shape in groups.build(node, where, name, context):
            result.shapes.append(shape)
            result.emitters += [light for light in (shape.emitter, shape.carried) if light is not None]
            if shape.sensor is not None:
                result.sensors.append(shape.sensor)
    elif category == "emitter" and node["type"] in ("area", "directionalarea"):
        light = emitters.build_area(node, where, name, context, shared=True)
        context.area_lights.append((light, where))  # shines from the shape that refers to it
    elif category == "emitter" and node["type"] == "sunsky":
        result.emitters += sunsky.build(Properties(node, where, name, context))
    elif category == "emitter":
        result.emitters.append(emitters.build(node, where, name, context))
    elif category == "sensor":
        result.sensors.append(sensors.build(node, where, name, context))
    elif category == "integrator":
        if result.integrator:
            raise error(where, "a second integrator", "give one")
        result.integrator = _integrator(node, where, context)
    elif category == "bsdf":
        bsdfs.build(node, where, name, context, shared=False)
    elif category == "texture":
        kind = textures.variant(node, False)
        context.build(node, where, kind, lambda: textures.build(node, where, name, context), shared=False)
    elif category == "scene":
        raise error(where, "a scene in the scene", "give its plugins instead")
    # What is left belongs to a sensor, a shape, a film or a medium that refers to it.


def _integrator(node: dict, where: str, context: Context) -> dict[str, Any]:
    """Return ``{"type", "max_depth", "rr_depth", "hide_emitters"}``; max_depth -1 stands for unlimited."""
    props = Properties(node, where, "integrator", context)
    if props.type == "aov":
        return _aov(props, context)
    if props.type == "moment":
        return _moment(props, context)
    direct = "direct" in props.type
    max_depth = 2 if direct else props.integer("max_depth", _DEPTHS.get(props.type, -1), minimum=-1)
    result = {
        "type": props.type,
        "max_depth": max_depth,
        "rr_depth": 5 if direct else props.integer("rr_depth", 5, minimum=1),
        "hide_emitters": props.boolean("hide_emitters", False),
    }
    others = [name for name in node if name not in (*result, "id") and not isinstance(node[name], dict)]
    props.ignore(*others, reason="it is an option of psdr's integrator objects")
    return result


def _aov(props: Properties, context: Context) -> dict[str, Any]:
    """Return the description of the integrator nested in an ``aov``, if there is one, with what ``aovs`` lists."""
    where = props.place("aovs")
    if not props.has("aovs"):
        raise error(where, "there is none", "give pairs of a name and a type, such as 'dd.y:depth,nn:sh_normal'")
    listed = parse_aovs(props.string("aovs", ""), where)
    nested = props.children("integrator")
    if len(nested) > 1:
        raise error(nested[1][2], "a second integrator in 'aov'", "give one")
    props.finish()
    inner = _integrator(nested[0][1], nested[0][2], context) if nested else {"type": "aov"}
    if "aovs" in inner:
        raise error(nested[0][2], "an 'aov' in an 'aov'", "list its channels in the outer one")
    return {**inner, "aovs": listed}


def _moment(props: Properties, context: Context) -> dict[str, Any]:
    """Return the description of the integrator nested in a ``moment``."""
    nested = props.children("integrator")
    if len(nested) != 1:
        raise error(props.where, f"{len(nested)} integrators in 'moment'", "nest one")
    props.finish()
    return _integrator(nested[0][1], nested[0][2], context)


def _register(node: dict, where: str, context: Context, open_nodes: list[int], count: Iterator[int]) -> None:
    """Collect the names that references can use: keys of the scene, and every ``id``; ``count``: of dictionaries.

    Raises:
        ValueError: If a name is taken, a dictionary contains itself, or there are too many or too deep ones.
    """
    if id(node) in open_nodes:
        raise error(where, f"the dictionary of this '{node.get('type')}' contains itself", "break the cycle")
    if len(open_nodes) >= DEPTH_MAX:
        raise limit(where, f"dictionaries are nested more than {DEPTH_MAX} deep", "nest fewer")
    if next(count) > DICTIONARIES_MAX:
        problem = f"more than {DICTIONARIES_MAX} dictionaries, each counted wherever it stands"
        raise limit(where, problem, "refer to it by its id: {'type': 'ref', 'id': ...}")
    for key, value in node.items():
        if not isinstance(value, dict):
            continue
        place = context.inside(where, key, value)
        if value.get("type") == "ref":
            if not open_nodes:
                context.named.setdefault(str(key), value)
            continue
        for name in {*([str(key)] if not open_nodes else []), value.get("id", "")}:
            if isinstance(name, str) and name and context.named.setdefault(name, value) is not value:
                other = getattr(context.named[name], "where", "") or "another plugin"
                raise error(place, f"the id '{name}' is taken by {other}", "give every plugin an id of its own")
        _register(value, place, context, [*open_nodes, id(node)], count)


def _check(result: SceneDescription, where: str) -> None:
    """Raise if there is nothing to see; note what is merely suspicious."""
    environments = [light for light in result.emitters if light.kind in ("constant", "envmap")]
    if len(environments) > 1:
        names = ", ".join(f"'{light.path}'" for light in environments)
        raise error(where, f"{len(environments)} environment lights ({names})", "keep one 'constant' or 'envmap'")
    if not result.shapes and not environments:
        raise error(where, "there are no shapes and no environment light", "add a shape; nothing is visible")
    media = [m for shape in result.shapes for m in (shape.interior, shape.exterior)]
    if not result.emitters and all(m is None or m.emission is None for m in media):
        result.notes.append(f"{where}: there is no light; images are black")
