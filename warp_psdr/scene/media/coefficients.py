"""Participating media and their phase functions (``volumes.py`` reads their coefficients)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from warp_psdr.scene.description import MediumDescription, PhaseDescription
from warp_psdr.scene.errors import ReportedError, error
from warp_psdr.scene.materials.bsdfs import lets_through, model_of
from warp_psdr.scene.materials.spectra import check_range
from warp_psdr.scene.media.volumes import flakes, volume
from warp_psdr.scene.plugins import Properties, category_of, unsupported_plugin

if TYPE_CHECKING:
    from warp_psdr.scene.context import Context
    from warp_psdr.scene.description import BsdfDescription

#: Defaults of Mitsuba's media and phase functions.
_SIGMA_T, _ALBEDO, _G = 1.0, 0.75, 0.8
#: Largest |g|: beyond it a lobe of light is narrower than float32 resolves.
MOST_G = 0.99
#: Most values of a ``tabphase``.
MOST_ENTRIES = 4096
#: Names of a shape's media.
_SIDES = ("interior", "exterior")


def build(node: dict, where: str, path: str, context: Context, *, shared: bool) -> MediumDescription:
    """Return the medium that a plugin dictionary describes.

    Args:
        node: The dictionary, references resolved.
        where: Its place, for messages.
        path: The name under which its parameters are listed if this is its first use.
        context: The load in progress.
        shared: Whether a reference led here; all references to a node give one object.

    Raises:
        ValueError: If the plugin or a parameter is not supported or out of range.
    """
    if category_of(node, where) != "medium":
        raise unsupported_plugin(node["type"], where, "medium")
    return context.build(node, where, "medium", lambda: _medium(Properties(node, where, path, context)), shared=shared)


def take_sides(props: Properties, bsdf: BsdfDescription) -> dict[str, MediumDescription | None]:
    """Take the media inside and outside of a shape; None: there is none."""
    found: dict[str, MediumDescription | None] = dict.fromkeys(_SIDES)
    for key, node, where, category in props.plugins():
        if category != "medium":
            continue
        if key not in _SIDES:
            problem = f"a medium as '{key}'" if not key.startswith("_arg_") else "a medium without a name"
            props.context.report(error(where, problem, "name it 'interior' or 'exterior'"))
            props.take(key)
            continue
        path = f"{props.path}.{key}_medium"
        found[key] = _nested(props, key, node, where, path)
    model = model_of(bsdf)
    # What stands in a medium names it as its exterior, whether light passes its surface or not; a sheet on both sides.
    hidden = found["interior"] is not None and found["interior"] is not found["exterior"]
    if hidden and not lets_through(model) and not model.has_null:
        props.context.note(
            f"{props.where}: the shape has a medium inside, but its BSDF ('{bsdf.model}') lets no light through; give "
            "it {'type': 'null'} if there is no surface, or name the medium 'exterior' if the shape stands in it"
        )
    return found


def take_medium(props: Properties) -> MediumDescription | None:
    """Take the medium that a sensor, or a light, is in."""
    nested = props.children("medium")
    if not nested:
        return None
    key, node, where = nested[0]
    return _nested(props, key, node, where, f"{props.path}.medium")


def _nested(props: Properties, key: str, node: dict, where: str, path: str) -> MediumDescription | None:
    # One that has an id is the same wherever it is referred to, also before and inside of another shape.
    shared = node is not props.node[key] or isinstance(node.get("id"), str)
    props.take(key)
    return props.context.attempt(lambda: build(node, where, path, props.context, shared=shared), None)


def _medium(props: Properties) -> MediumDescription:
    grids = props.type == "heterogeneous"
    sigma_t = volume(props, "sigma_t", _SIGMA_T, np.inf, grids=grids)
    albedo = volume(props, "albedo", _ALBEDO, 1.0, grids=True)
    scale = props.number("scale", 1.0, minimum=0.0)
    emission = None
    if props.has("emission"):
        emission = volume(props, "emission", 0.0, np.inf, grids=True)
    for hint in ("sample_emitters", "has_spectral_extinction"):
        if not props.boolean(hint, True):
            props.context.note(f"{props.place(hint)} is ignored: it changes noise, not the image")
    nested = props.children("phase")
    if nested:
        _key, node, where = nested[0]
        phase = _phase(Properties(node, where, f"{props.path}.phase_function", props.context))
    elif props.incomplete:
        raise ReportedError(props.where)
    else:
        phase = PhaseDescription(f"{props.path}.phase_function", "isotropic")
    props.finish()
    return MediumDescription(props.path, sigma_t, albedo, scale, phase, grids, emission)


def _phase(props: Properties) -> PhaseDescription:
    if props.type == "blendphase":
        return _blend(props)
    found = PhaseDescription(props.path, cast(Literal["isotropic", "hg", "rayleigh", "tabphase", "sggx"], props.type))
    if props.type == "hg":
        found.g = props.number("g", _G, minimum=-MOST_G, maximum=MOST_G)
    elif props.type == "tabphase":
        found.values = _table(props)
    elif props.type == "sggx":
        found.flakes = flakes(props)
    props.finish()
    return found


def _blend(props: Properties) -> PhaseDescription:
    """Take two phase functions and the share of the second."""
    if not props.has("weight"):
        raise error(props.where, "there is no 'weight'", "give the share of the second phase function, from 0 to 1")
    place = props.place("weight")
    weight = volume(props, "weight", 0.5, 1.0, grids=True)
    if weight.value.ndim == 4 and weight.value.shape[3] != 1:
        raise error(place, f"a grid of {weight.value.shape[3]} channels", "'weight' has one")
    if weight.value.ndim != 4 and weight.value.size != 1:
        raise error(place, f"got the colour {weight.value.tolist()}", "'weight' is one number")
    nested = props.children("phase", limit=2)
    for _key, node, where in nested:
        if node.get("type") in ("blendphase", "sggx"):
            problem = f"a {node['type']} inside a blendphase"
            raise error(where, problem, "blend two of isotropic, hg, rayleigh and tabphase")
    if len(nested) != 2:
        raise error(props.where, f"{len(nested)} phase functions in a 'blendphase'", "nest two")
    inner = [
        _phase(Properties(node, where, f"{props.path}.phase_{i}", props.context))
        for i, (_key, node, where) in enumerate(nested)
    ]
    props.finish()
    return PhaseDescription(props.path, "blendphase", weight=weight, nested=tuple(inner))


def _table(props: Properties) -> np.ndarray:
    """Take the values of a table: numbers, or a text of them, with commas or spaces between."""
    given, place = props.take("values"), props.place("values")
    try:
        plain = given.replace(",", " ").split() if isinstance(given, str) else given
        values = np.array(plain.numpy() if hasattr(plain, "numpy") else plain, dtype=np.float32)
    except (TypeError, ValueError):
        values = np.empty(0, np.float32)
    if values.ndim != 1 or not 2 <= values.size <= MOST_ENTRIES:
        raise error(place, f"got {given!r}", f"give from 2 to {MOST_ENTRIES} numbers, for cosines from -1 to 1")
    check_range(values, place, 0.0, np.inf, "'values'")
    if not values.any():
        raise error(place, "all values are 0", "give a value above 0")
    return values
