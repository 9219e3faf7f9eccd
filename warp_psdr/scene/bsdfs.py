"""Scattering models."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA

from .description import BsdfDescription, TextureDescription
from .errors import ReportedError, did_you_mean, error, listing
from .materials import CONDUCTORS
from .plugins import Properties, category_of, unsupported_plugin
from .textures import check_attribute, constant, texture

if TYPE_CHECKING:
    from .context import Context

#: Indices of refraction at 589 nm, under Mitsuba's names.
IORS = {
    "vacuum": 1.0, "helium": 1.000036, "hydrogen": 1.000132, "air": 1.000277, "carbon dioxide": 1.00045,
    "water": 1.3330, "acetone": 1.36, "ethanol": 1.361, "carbon tetrachloride": 1.461, "glycerol": 1.4729,
    "benzene": 1.501, "silicone oil": 1.52045, "bromine": 1.661, "water ice": 1.31, "fused quartz": 1.458,
    "pyrex": 1.470, "acrylic glass": 1.49, "polypropylene": 1.49, "bk7": 1.5046, "sodium chloride": 1.544,
    "amber": 1.55, "pet": 1.5750, "diamond": 2.419,
}  # fmt: skip

#: Admissible range of each texture slot; eta and k only have to be non-negative.
RANGES = {"reflectance": 1.0, "specular_reflectance": 1.0, "specular_transmittance": 1.0}
_SCALARS = ("alpha", "alpha_u", "alpha_v")


def build(node: dict, where: str, path: str, context: Context, *, shared: bool) -> BsdfDescription:
    """Return the scattering model of a plugin dictionary.

    Args:
        node: The dictionary, references resolved.
        where: Its place, for messages.
        path: The name under which its parameters are listed if this is its first use.
        context: The load in progress.
        shared: Whether a reference led here; all references to a node give one object.

    Raises:
        ValueError: If the plugin or a parameter is not supported or out of range.
    """
    category = category_of(node, where)
    if category != "bsdf":
        raise unsupported_plugin(node["type"], where, "bsdf")
    return context.build(node, where, "bsdf", lambda: _build(Properties(node, where, path, context)), shared=shared)


def default(path: str, shines: bool) -> BsdfDescription:
    """Return what a shape without a BSDF gets: diffuse, reflectance 0.5, or 0 for an area light."""
    return BsdfDescription(path, "diffuse", {"reflectance": constant(f"{path}.reflectance", 0.0 if shines else 0.5)})


def check_attributes(bsdf: BsdfDescription, attributes: dict[str, np.ndarray], where: str) -> None:
    """Raise if a texture of the model names a mesh attribute that does not fit the shape.

    Raises:
        ValueError: With the attributes that the shape has.
    """
    for slot, value in bsdf.textures.items():
        low = MIN_ALPHA if slot in _SCALARS else 0.0
        check_attribute(value, attributes, where, low, RANGES.get(slot, np.inf), slot in _SCALARS)
    if bsdf.back is not None:
        check_attributes(bsdf.back, attributes, where)


def _build(props: Properties) -> BsdfDescription:
    builders = {
        "diffuse": _diffuse,
        "conductor": _conductor,
        "roughconductor": _roughconductor,
        "dielectric": _dielectric,
        "twosided": _twosided,
    }
    result = builders[props.type](props)
    props.finish()
    return result


def _slot(props: Properties, name: str, value: Any = 1.0) -> TextureDescription:
    return texture(props, name, value, high=RANGES.get(name, np.inf))


def _diffuse(props: Properties) -> BsdfDescription:
    return BsdfDescription(props.path, "diffuse", {"reflectance": _slot(props, "reflectance", 0.5)})


def _conductor(props: Properties) -> BsdfDescription:
    return BsdfDescription(props.path, "conductor", _metal(props))


def _metal(props: Properties) -> dict[str, TextureDescription]:
    """Take ``material`` or ``eta`` and ``k``."""
    if props.has("eta", "k") and props.has("material"):
        raise error(props.where, "got 'material' besides 'eta' or 'k'", "give either the material or eta and k")
    name = props.string("material", "none")
    if name == "none":
        # A perfect mirror: zero index of refraction, Fresnel reflectance 1 at every angle.
        eta, k = np.zeros(1), np.ones(1)
    else:
        found = CONDUCTORS.get(name) or CONDUCTORS.get(name.removesuffix("_palik"))
        if found is None:
            raise error(
                props.place("material"),
                f"unknown material '{name}'{did_you_mean(name, CONDUCTORS)}",
                f"give 'none' or one of: {listing(CONDUCTORS)}",
            )
        eta, k = (np.array(v) for v in found)
    if props.has("eta") != props.has("k"):
        raise error(props.where, "got only one of 'eta' and 'k'", "give both")
    return {
        "specular_reflectance": _slot(props, "specular_reflectance"),
        "eta": _slot(props, "eta", eta),
        "k": _slot(props, "k", k),
    }


def _roughconductor(props: Properties) -> BsdfDescription:
    textures = _metal(props)
    anisotropic = props.has("alpha_u", "alpha_v")
    if anisotropic and props.has("alpha"):
        raise error(props.where, "got 'alpha' besides 'alpha_u' or 'alpha_v'", "give either alpha or both others")
    if anisotropic and not (props.has("alpha_u") and props.has("alpha_v")):
        raise error(props.where, "got only one of 'alpha_u' and 'alpha_v'", "give both, or 'alpha'")
    for slot, name in (("alpha_u", "alpha_u"), ("alpha_v", "alpha_v")) if anisotropic else (("alpha_u", "alpha"),):
        textures[slot] = texture(props, name, 0.1, low=MIN_ALPHA, scalar=True)
    textures.setdefault("alpha_v", textures["alpha_u"])
    for name in _SCALARS:
        props.take(name)
    distribution = props.string("distribution", "beckmann", ("ggx", "beckmann"))
    if not props.boolean("sample_visible", True):
        props.context.note(f"{props.place('sample_visible')} is ignored: visible normals are always sampled")
    return BsdfDescription(
        props.path, "roughconductor", textures, distribution=cast(Literal["ggx", "beckmann"], distribution)
    )


def _dielectric(props: Properties) -> BsdfDescription:
    inside, outside = _ior(props, "int_ior", "bk7"), _ior(props, "ext_ior", "air")
    textures = {name: _slot(props, name) for name in ("specular_reflectance", "specular_transmittance")}
    # Mitsuba keeps the ratio as a number, not as a texture, so its name has no ".value".
    textures["eta"] = dataclasses.replace(constant(f"{props.path}.eta", inside / outside), plain=True)
    return BsdfDescription(props.path, "dielectric", textures)


def _ior(props: Properties, name: str, preset: str) -> float:
    value = props.node.get(name, preset)
    if not isinstance(value, str):
        return props.number(name, None, minimum=0.0, exclusive=True)
    key = props.string(name, preset).lower()
    if key not in IORS:
        raise error(
            props.place(name),
            f"unknown material '{value}'{did_you_mean(key, IORS)}",
            f"give a number or one of: {listing(IORS)}",
        )
    return IORS[key]


def _twosided(props: Properties) -> BsdfDescription:
    nested = props.children("bsdf", limit=2)
    if not nested and props.incomplete:
        raise ReportedError(props.where)
    if not nested:
        raise error(props.where, "a 'twosided' without a nested bsdf", "nest one, or two for front and back")
    sides = []
    for i, (key, node, where) in enumerate(nested):
        shared = node is not props.node[key]
        side = build(node, where, f"{props.path}.brdf_{i}", props.context, shared=shared)
        if side.model == "dielectric" or side.two_sided:
            raise error(where, f"a '{node['type']}' inside 'twosided'", "nest a bsdf that reflects only")
        sides.append(side)
    front = sides[0]
    return dataclasses.replace(front, two_sided=True, back=sides[1] if len(sides) == 2 else None)
