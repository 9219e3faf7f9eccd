"""Scattering models."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.kernels.bsdf.composite import Composite, nested_name
from warp_psdr.kernels.bsdf.dispatch import COMPOSITES, MODELS, declaration_of
from warp_psdr.kernels.bsdf.model import (
    MIN_INDEX,
    Accepted,
    Choice,
    Color,
    ComplexIndex,
    Flag,
    HeightTexture,
    Measured,
    Model,
    NormalTexture,
    Number,
    PlainNumber,
    Rate,
    RelativeIndex,
    Roughness,
    SpecularIndex,
    Table,
    UniformRoughness,
    key_of,
    variant_of,
)
from warp_psdr.scene.description import BsdfDescription, TextureDescription
from warp_psdr.scene.errors import ReportedError, did_you_mean, error, listing
from warp_psdr.scene.materials.conductors import CONDUCTORS
from warp_psdr.scene.materials.textures import check_attribute, constant, texture
from warp_psdr.scene.plugins import Properties, category_of, unsupported_plugin

if TYPE_CHECKING:
    from warp_psdr.scene.context import Context

#: Indices of refraction at 589 nm, under Mitsuba's names.
IORS = {
    "vacuum": 1.0, "helium": 1.000036, "hydrogen": 1.000132, "air": 1.000277, "carbon dioxide": 1.00045,
    "water": 1.3330, "acetone": 1.36, "ethanol": 1.361, "carbon tetrachloride": 1.461, "glycerol": 1.4729,
    "benzene": 1.501, "silicone oil": 1.52045, "bromine": 1.661, "water ice": 1.31, "fused quartz": 1.458,
    "pyrex": 1.470, "acrylic glass": 1.49, "polypropylene": 1.49, "bk7": 1.5046, "sodium chloride": 1.544,
    "amber": 1.55, "pet": 1.5750, "diamond": 2.419,
}  # fmt: skip

#: Of a difference of two numbers near 1, relative to a thousandth.
_ROUNDING = 1e-6


def model_of(bsdf: BsdfDescription) -> Model:
    """Return the declaration of a scattering model."""
    return declaration_of(_key(bsdf))[0]


def _key(bsdf: BsdfDescription) -> str:
    return key_of(bsdf.model, bsdf.variant, bsdf.children)


def lets_through(model: Model) -> bool:
    """Return whether light passes the surface, in a delta lobe or in a smooth one."""
    return model.transmits or model.passes


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


def check_shape(bsdf: BsdfDescription, attributes: dict[str, np.ndarray], has_texcoords: bool, where: str) -> None:
    """Raise if a shape lacks what the model needs: texture coordinates, or a mesh attribute that a texture names.

    Raises:
        ValueError: With the attributes that the shape has.
    """
    if model_of(bsdf).framed and not has_texcoords:
        problem = f"a '{bsdf.model}' turns normals by dp/du, and the shape has no texture coordinates"
        raise error(where, problem, "give it some")
    values = {value.name: value for value in model_of(bsdf).values}
    for name, t in bsdf.textures.items():
        value = values[name]
        check_attribute(t, attributes, where, value.low, value.high, not value.color)
    if bsdf.back is not None:
        check_shape(bsdf.back, attributes, has_texcoords, where)


def _build(props: Properties) -> BsdfDescription:
    if props.type == "twosided":
        result = _twosided(props)
    elif any(composite.plugin == props.type for composite in COMPOSITES):
        result = _nest(props, next(composite for composite in COMPOSITES if composite.plugin == props.type))
    else:
        result = _declared(props, _serving(props))
    props.finish()
    return result


def _serving(props: Properties) -> Model:
    """Return the model that serves the plugin, see ``Model.when``."""
    served = [model for model in MODELS if model.plugin == props.type]
    for model in [model for model in served if model.when]:
        given = props.node.get(model.when)
        if given is not None and not (np.isscalar(given) and given == 0):
            return model
        props.take(model.when)
    return next(model for model in served if not model.when)


def _declared(props: Properties, model: Model | Composite) -> BsdfDescription:
    """Read what a model declares, of a composite what is its own."""
    chosen: list[str] = [model.when] if isinstance(model, Model) else []
    values: dict[str, TextureDescription | float] = {}
    for parameter in model.parameters:
        if isinstance(parameter, Table):
            continue
        if isinstance(parameter, Choice):
            chosen.append(props.string(parameter.name, parameter.default, parameter.options))
        elif isinstance(parameter, Flag):
            chosen.append(parameter.options[props.boolean(parameter.name, parameter.default) != parameter.default])
        elif isinstance(parameter, Accepted):
            if props.boolean(parameter.name, parameter.default) != parameter.default:
                props.context.note(f"{props.place(parameter.name)} is ignored: {parameter.reason}")
        elif not isinstance(parameter, Measured):
            values.update(READERS[type(parameter)](props, parameter))
    textures = {name: value for name, value in values.items() if isinstance(value, TextureDescription)}
    fixed = {name: value for name, value in values.items() if not isinstance(value, TextureDescription)}
    return BsdfDescription(props.path, model.plugin, textures, variant_of(chosen), fixed)


def _color(props: Properties, parameter: Color) -> dict[str, TextureDescription]:
    return {parameter.name: texture(props, parameter.name, parameter.default, high=parameter.high)}


def _number(props: Properties, parameter: Number) -> dict[str, TextureDescription]:
    if parameter.default is None and not props.has(parameter.name):
        raise error(props.where, f"a '{props.type}' without '{parameter.name}'", "give a number or a texture")
    default = parameter.low if parameter.default is None else parameter.default
    low, high = parameter.low, parameter.high
    number = texture(props, parameter.name, default, low=low, high=high, scalar=True, clamped=True)
    return {value.name: number for value in parameter.values}


def _plain_number(props: Properties, parameter: PlainNumber) -> dict[str, TextureDescription]:
    number = props.number(parameter.name, parameter.default, minimum=parameter.low, maximum=parameter.high)
    return {parameter.name: dataclasses.replace(constant(f"{props.path}.{parameter.name}", number), plain=True)}


def _normal_texture(props: Properties, parameter: NormalTexture) -> dict[str, TextureDescription]:
    name = parameter.name
    if not props.has(name):
        raise error(props.where, f"a '{props.type}' without '{name}'", "give a texture of normals, with raw = true")
    node = props.node[name]
    if isinstance(node, dict):
        node, where = props.context.resolve(node, props.context.inside(props.where, name, node))
        if node.get("type") == "bitmap" and node.get("raw") is not True and not _is_linear(node):
            props.context.note(f"{where}: the normals are decoded as sRGB colours; say raw = true")
    return {name: texture(props, name, 0.5)}


def _height_texture(props: Properties, parameter: HeightTexture) -> dict[str, TextureDescription]:
    found = [key for key, _, _, category in props.plugins() if category == "texture"]
    if len(found) != 1:
        got = f"{len(found)} textures ({listing(found)})" if found else "no texture"
        if not found and props.incomplete:
            raise ReportedError(props.where)
        raise error(props.where, f"a '{props.type}' with {got}", "nest exactly one, of heights")
    heights = texture(props, found[0], 0.0, low=-np.inf, scalar=True, path=f"{props.path}.nested_texture")
    if heights.kind in ("mesh_attribute", "volume") or heights.nested:
        raise error(props.place(found[0]), f"a {heights.kind} has no slopes", "give a bitmap")
    if heights.kind == "bitmap" and heights.filter == "nearest":
        raise error(props.place(found[0]), "a bitmap with filter_type 'nearest' has no slopes", "use 'bilinear'")
    return {parameter.name: heights}


def _is_linear(bitmap: dict) -> bool:
    """Whether a bitmap holds numbers as they are, whatever ``raw`` says."""
    if "filename" in bitmap:
        return str(bitmap["filename"]).lower().endswith((".exr", ".hdr", ".pfm"))
    values: Any = bitmap.get("bitmap", bitmap.get("data"))
    return bool(np.asarray(values.numpy() if hasattr(values, "numpy") else values).dtype.kind == "f")


def _complex_index(props: Properties, parameter: ComplexIndex) -> dict[str, TextureDescription]:
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
    defaults = {"eta": eta, "k": k}
    return {value.name: texture(props, value.name, defaults[value.name], high=value.high) for value in parameter.values}


def _roughness(props: Properties, parameter: Roughness) -> dict[str, TextureDescription]:
    anisotropic = props.has("alpha_u", "alpha_v")
    if anisotropic and props.has("alpha"):
        raise error(props.where, "got 'alpha' besides 'alpha_u' or 'alpha_v'", "give either alpha or both others")
    if anisotropic and not (props.has("alpha_u") and props.has("alpha_v")):
        raise error(props.where, "got only one of 'alpha_u' and 'alpha_v'", "give both, or 'alpha'")
    u = texture(props, "alpha_u" if anisotropic else "alpha", parameter.default, low=parameter.low, scalar=True)
    v = texture(props, "alpha_v", parameter.default, low=parameter.low, scalar=True) if anisotropic else u
    for name in ("alpha", "alpha_u", "alpha_v"):
        props.take(name)
    return {"alpha_u": u, "alpha_v": v}


def _uniform_roughness(props: Properties, parameter: UniformRoughness) -> dict[str, TextureDescription]:
    """Take ``alpha``; of ``alpha_u`` and ``alpha_v``, which Mitsuba reads too, equal ones."""
    for name in ("alpha", "alpha_u", "alpha_v"):
        if isinstance(props.node.get(name), dict):
            raise error(
                props.place(name),
                f"a texture for the roughness of a '{props.type}'",
                "give a number: what passes its coat is tabulated for one roughness",
            )
    low = parameter.low
    alpha = props.number("alpha", parameter.default, minimum=low)
    if props.has("alpha_u", "alpha_v"):
        u, v = (props.number(name, alpha, minimum=low) for name in ("alpha_u", "alpha_v"))
        if u != v or props.has("alpha"):
            raise error(props.where, f"alpha_u {u:g} and alpha_v {v:g}", f"a '{props.type}' is isotropic: give 'alpha'")
        alpha = u
    return {"alpha": dataclasses.replace(constant(f"{props.path}.alpha", alpha), plain=True)}


def _relative_index(props: Properties, parameter: RelativeIndex) -> dict[str, TextureDescription]:
    inside, outside = _ior(props, "int_ior", parameter.interior), _ior(props, "ext_ior", parameter.exterior)
    if not parameter.low <= inside / outside <= parameter.high:
        raise error(
            props.where,
            f"int_ior / ext_ior is {inside / outside:g}",
            f"a '{props.type}' takes ratios from {parameter.low:g} to {parameter.high:g}",
        )
    if _near_one(inside / outside, parameter.gap):
        raise error(
            props.where,
            f"int_ior / ext_ior is {inside / outside:g}",
            f"both sides of a '{props.type}' have to differ"
            + (f", by a ratio of {parameter.gap:g} or more" if parameter.gap else "")
            + "; where nothing is refracted, leave the surface out, or give a 'diffuse' one",
        )
    # Mitsuba keeps the ratio as a number, not as a texture, so its name has no ".value".
    eta = dataclasses.replace(constant(f"{props.path}.eta", inside / outside), plain=True)
    return {value.name: eta for value in parameter.values}


def _near_one(ratio: float, gap: float) -> bool:
    """Return whether a ratio is nearer to 1 than the gap, or 1 where that is 0; 1.001 is a thousandth away."""
    return abs(ratio - 1.0) < gap * (1.0 - _ROUNDING) or (gap == 0.0 and ratio == 1.0)


def _specular_index(props: Properties, parameter: SpecularIndex) -> dict[str, TextureDescription | float]:
    """Take ``eta`` or ``specular``."""
    if props.has("eta") and props.has("specular"):
        raise error(props.where, "got 'eta' and 'specular'", "give one: each tells the other")
    name = "eta" if props.has("eta") else "specular"
    if name == "eta":
        number = eta = props.number("eta", None, minimum=MIN_INDEX)
    else:
        number = props.number("specular", parameter.default, minimum=0.0, maximum=1.0)
        props.take("eta")
        eta = 2.0 / (1.0 - np.sqrt(0.08 * number)) - 1.0
    if _near_one(eta, parameter.gap):
        raise error(
            props.where,
            f"{name} {number:g}, an index of refraction of {eta:g}, beside 'spec_trans'",
            f"what is refracted needs one that differs from 1 by {parameter.gap:g} or more",
        )
    listed = dataclasses.replace(constant(f"{props.path}.{name}", number), plain=True)
    return {"ior": listed, "specular": 0.0} if name == "eta" else {"ior": 0.0, "specular": listed}


def _rate(props: Properties, parameter: Rate) -> dict[str, float]:
    return {parameter.name: props.number(parameter.name, parameter.default, minimum=parameter.low)}


#: How each kind of parameter is read: ``(props, parameter) -> values`` by their names, bare numbers if not listed.
READERS: dict[type, Any] = {
    Color: _color,
    Number: _number,
    PlainNumber: _plain_number,
    NormalTexture: _normal_texture,
    HeightTexture: _height_texture,
    ComplexIndex: _complex_index,
    RelativeIndex: _relative_index,
    Roughness: _roughness,
    UniformRoughness: _uniform_roughness,
    SpecularIndex: _specular_index,
    Rate: _rate,
}


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


def _nest(props: Properties, composite: Composite) -> BsdfDescription:
    """Read a model made of models: what is its own and what is nested in it, of which its own record holds copies.

    Sides of nested models become sides of the whole: a blend of two-sided models is two-sided, a blend on either side.
    """
    own = _declared(props, composite)
    count = len(composite.prefixes)
    nested = props.children("bsdf", limit=count)
    if len(nested) < count and props.incomplete:
        raise ReportedError(props.where)
    if len(nested) < count:
        wanted = "two" if count == 2 else "one"
        raise error(props.where, f"a '{props.type}' with {len(nested)} nested bsdf", f"nest exactly {wanted}")
    children = []
    for (key, node, where), place in zip(nested, composite.places, strict=True):
        shared = node is not props.node[key]
        children.append(build(node, where, f"{props.path}.{place}", props.context, shared=shared))
    sided = [child.two_sided for child in children]
    if any(sided) and not all(sided):
        raise error(props.where, "one nested bsdf is two-sided, the other is not", "put 'twosided' around both")
    front = _joined(props, composite, own, children)
    if not any(sided):
        return front
    back = None
    if composite.behind or any(child.back is not None for child in children):
        behind = dataclasses.replace(own, variant=variant_of((own.variant, composite.behind)))
        back = _joined(props, composite, behind, [child.back or child for child in children])
    return dataclasses.replace(front, two_sided=True, back=back)


def _joined(
    props: Properties, composite: Composite, own: BsdfDescription, children: list[BsdfDescription]
) -> BsdfDescription:
    """Return one side of a composite."""
    keys = tuple(map(_key, children))
    reason = composite.refusal(tuple(declaration_of(key) for key in keys))
    if reason:
        raise error(props.where, f"'{props.type}' of {listing(keys)}", reason)
    textures, fixed = dict(own.textures), dict(own.fixed)
    for prefix, child in zip(composite.prefixes, children, strict=True):
        textures |= {nested_name(prefix, name): t for name, t in child.textures.items()}
        fixed |= {nested_name(prefix, name): number for name, number in child.fixed.items()}
    return dataclasses.replace(own, textures=textures, fixed=fixed, children=keys)


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
        if lets_through(model_of(side)) or side.two_sided:
            raise error(where, f"a '{node['type']}' inside 'twosided'", "nest a bsdf that reflects only")
        sides.append(side)
    front = sides[0]
    return dataclasses.replace(front, two_sided=True, back=sides[1] if len(sides) == 2 else None)
