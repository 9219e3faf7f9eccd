"""Textures: constants, bitmaps, mesh attributes, volumes, and checkerboards of them.

Bitmaps keep their rows as stored, top row first; as in Mitsuba the first row lies at v = 0, and loaders of meshes whose
format counts v from the bottom flip v instead (``flip_tex_coords``).
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from warp_psdr.image_io import read_image, srgb_to_linear
from warp_psdr.scene.description import TextureDescription
from warp_psdr.scene.errors import ReportedError, SceneError, error
from warp_psdr.scene.materials.spectra import COLOR_TYPES, LUMINANCE, check_range, color
from warp_psdr.scene.media.volumes import volume
from warp_psdr.scene.plugins import Properties, category_of
from warp_psdr.scene.transforms import as_matrix, singular

if TYPE_CHECKING:
    from warp_psdr.scene.context import Context

_FILTERS = ("bilinear", "nearest")
_WRAPS = ("repeat", "mirror", "clamp")


def texture(
    props: Properties,
    name: str,
    default: float | np.ndarray,
    *,
    low: float = 0.0,
    high: float = np.inf,
    emissive: bool = False,
    scalar: bool = False,
    clamped: bool = False,
    path: str = "",
) -> TextureDescription:
    """Take a plugin's parameter that may vary over the surface.

    Args:
        props: The plugin.
        name: The parameter.
        default: Its value when it is not given.
        low: Smallest admissible value.
        high: Largest admissible value.
        emissive: Whether it is emitted light.
        scalar: Whether it is one number; colour bitmaps are reduced to their luminance.
        clamped: Whether device code takes texels beyond ``high`` for ``high``; otherwise they are noted. Of a colour
            the luminance counts, which is noted.
        path: The name under which it is listed; default: the parameter's.

    Returns:
        The texture; the default, with a report to the context, if the value cannot be used.
    """
    return props.context.attempt(
        lambda: _texture(props, name, default, low, high, emissive, scalar, clamped, path),
        constant(path or f"{props.path}.{name}", default),
    )


def _texture(
    props: Properties,
    name: str,
    default: float | np.ndarray,
    low: float,
    high: float,
    emissive: bool,
    scalar: bool,
    clamped: bool,
    path: str,
) -> TextureDescription:
    result, place = _read(props, name, path or f"{props.path}.{name}", default, high, emissive, scalar)
    if clamped and result.kind == "constant" and result.value.size == 3:
        result = dataclasses.replace(result, value=np.atleast_1d(result.value @ LUMINANCE))
        props.context.note(f"{place}: '{name}' is one number, the luminance of the colour that is given")
    for leaf in result.leaves:
        if leaf is not result or leaf.kind in ("bitmap", "volume"):
            _raise_to(leaf, name, place, props.context, low)
        _check_values(leaf, name, place, props.context, (low, high), scalar, clamped)
    return result


def _read(
    props: Properties, name: str, path: str, default: float | np.ndarray, high: float, emissive: bool, scalar: bool
) -> tuple[TextureDescription, str]:
    """Take a texture; returns it with its place."""
    value = props.take(name)
    place = props.place(name)
    if value is None:
        result = constant(path, default)
    elif isinstance(value, dict):
        node, where = props.context.resolve(value, props.context.inside(props.where, name, value))
        if id(node) in props.context.broken:
            raise ReportedError(where)
        place = where if node is not value else place
        result = props.context.build(
            node,
            where,
            variant(node, emissive),
            lambda: build(node, where, path, props.context, emissive, high),
            shared=node is not value,
        )
        if scalar:
            result = _as_scalar(result, path)
    else:
        result = constant(path, color(value, place, props.context, emissive=emissive, high=high))
    return result, place


def _as_scalar(t: TextureDescription, path: str) -> TextureDescription:
    """Return what a texture is where it is read as one number."""
    if t.kind == "bitmap" and t.value.shape[2] == 3:
        return dataclasses.replace(t, path=path, value=(t.value @ LUMINANCE)[..., None])
    if t.kind == "checkerboard":
        first, second = (_as_scalar(inner, f"{path}.color{i}") for i, inner in enumerate(t.nested))
        # Read so, Mitsuba's checkerboard swaps its colours.
        return dataclasses.replace(t, nested=(second, first))
    return t


def _raise_to(t: TextureDescription, name: str, place: str, context: Context, low: float) -> None:
    """Raise values from 0 to below the least one that a model takes, as zeros of a roughness are, and note it."""
    below = (t.value >= 0.0) & (t.value < low)
    if low > 0.0 and below.any():
        context.note(
            f"{place}: {int(below.sum())} of {t.value.size} values of '{name}' are below {low:g}, and raised to it"
        )
        t.value[below] = low


def _check_values(
    t: TextureDescription,
    name: str,
    place: str,
    context: Context,
    ends: tuple[float, float],
    scalar: bool,
    clamped: bool,
) -> None:
    low, high = ends
    if scalar and t.kind == "volume" and t.value.shape[3] != 1:
        raise error(place, f"a volume of {t.value.shape[3]} channels", f"'{name}' is one number: give one channel")
    if scalar and t.kind == "constant" and t.value.size != 1:
        raise error(place, f"got the colour {t.value.tolist()}", f"'{name}' is one number")
    if t.kind in ("bitmap", "volume") and t.value.max() > high:
        # As in Mitsuba, whose scenes hold such bitmaps.
        count = int((t.value > high).sum())
        effect = f"which count as {high:g}" if clamped else "so more light is scattered than arrives"
        context.note(
            f"{place}: {count} of {t.value.size} values of '{name}' exceed {high:g} (the largest is "
            f"{t.value.max():g}), {effect}"
        )
        high = np.inf
    if t.value.size:
        check_range(t.value, place, low, high, f"'{name}'")


def constant(path: str, value: Any) -> TextureDescription:
    """Return a texture of one value."""
    return TextureDescription(path, "constant", np.atleast_1d(np.asarray(value, dtype=np.float32)))


def variant(node: dict, emissive: bool) -> str:
    """Return what a texture is shared as: emission changes the meaning of spectra only."""
    return "emission" if emissive and node.get("type") in COLOR_TYPES else "texture"


def build(
    node: dict, where: str, path: str, context: Context, emissive: bool = False, high: float = np.inf
) -> TextureDescription:
    """Return the texture that a nested dictionary describes."""
    if node.get("type") == "d65":
        nested = Properties(node, where, path, context).children("texture")
        if nested and nested[0][0] != "color":
            # The white of RGB times a texture is the texture.
            _, inner, place = nested[0]
            return build(inner, place, path, context, emissive, high)
    if node.get("type") in COLOR_TYPES:
        return constant(path, color(node, where, context, path=path, emissive=emissive, high=high))
    if category_of(node, where) != "texture":
        raise error(
            where,
            f"a '{node.get('type')}' is no texture",
            "give a colour, a bitmap, a mesh_attribute, a checkerboard or a volume",
        )
    props = Properties(node, where, path, context)
    if props.type == "checkerboard":
        return _checkerboard(props, emissive, high)
    if props.type == "volume":
        return _volume(props)
    return _mesh_attribute(props) if props.type == "mesh_attribute" else _bitmap(props)


def bitmap_values(props: Properties, raw: bool) -> np.ndarray:
    """Take a plugin's image: ``filename``, or ``bitmap`` or ``data`` in memory; linear, shape (H, W, 1 or 3).

    Integer arrays hold sRGB unless ``raw``; floating-point arrays are linear.

    Raises:
        ValueError: If there is none, more than one, or its shape is wrong.
        FileNotFoundError: If the file does not exist.
    """
    given = [name for name in ("filename", "bitmap", "data") if props.has(name)]
    sources = {name: props.take(name) for name in ("filename", "bitmap", "data")}
    if len(given) != 1:
        problem = f"got {' and '.join(given)}" if given else "there is no image"
        raise error(props.where, problem, "give one of 'filename', 'bitmap' and 'data'")
    place, value = props.place(given[0]), sources[given[0]]
    if given[0] == "filename":
        file = props.context.file(value, place)
        try:
            image = read_image(file, raw=raw)
        except ValueError as problem:
            raise SceneError(f"{place}: {problem}") from None
        props.context.count(image.size, place)
    else:
        try:
            image = np.array(value.numpy() if hasattr(value, "numpy") else value)
        except (TypeError, ValueError):
            image = np.empty(0)
        if image.dtype.kind == "u":
            image = image.astype(np.float32) / np.iinfo(image.dtype).max
            image = image if raw else srgb_to_linear(image)
        elif image.dtype.kind != "f":
            raise error(place, f"got an array of type {image.dtype}", "give float (linear) or uint8 (sRGB) values")
        image = image.astype(np.float32)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in (1, 2, 3, 4) or 0 in image.shape:
        raise error(place, f"the image has shape {image.shape}", "give (H, W), (H, W, 1), (H, W, 3) or (H, W, 4)")
    # A second or fourth channel is alpha, which textures do not have.
    return np.ascontiguousarray(image[..., : 1 if image.shape[2] <= 2 else 3])


def _bitmap(props: Properties) -> TextureDescription:
    values = bitmap_values(props, props.boolean("raw", False))
    props.ignore("format", "accel", reason="texels are always kept as 32-bit floats")
    result = TextureDescription(
        props.path,
        "bitmap",
        values,
        filter=cast(Literal["bilinear", "nearest"], props.string("filter_type", "bilinear", _FILTERS)),
        wrap=cast(Literal["repeat", "mirror", "clamp"], props.string("wrap_mode", "repeat", _WRAPS)),
        to_uv=_to_uv(props),
    )
    props.finish()
    return result


def _checkerboard(props: Properties, emissive: bool, high: float) -> TextureDescription:
    """Take the textures of both fields; those of a nested checkerboard would be a third and a fourth."""
    nested = []
    for name, default in (("color0", 0.4), ("color1", 0.2)):
        node = props.node.get(name)
        if isinstance(node, dict) and props.context.resolve(node, props.place(name))[0].get("type") == "checkerboard":
            problem = f"a checkerboard inside a checkerboard, as '{name}'"
            raise error(props.where, problem, "give a colour, a bitmap or a mesh_attribute")
        nested.append(_read(props, name, f"{props.path}.{name}", default, high, emissive, False)[0])
    result = TextureDescription(
        props.path, "checkerboard", np.zeros(0, dtype=np.float32), to_uv=_to_uv(props), nested=tuple(nested)
    )
    props.finish()
    return result


def _volume(props: Properties) -> TextureDescription:
    """Take the volume of a texture; a constant one is a constant texture."""
    if not props.has("volume"):
        raise error(props.where, "there is no volume", "nest a 'constvolume' or a 'gridvolume', named 'volume'")
    held = volume(props, "volume", 1.0, np.inf, grids=True)
    props.finish()
    if held.value.ndim == 1:
        return constant(held.parameter.removesuffix(".value"), held.value)
    assert held.to_world is not None
    reason = singular(held.to_world)
    if reason:
        raise error(props.place("volume"), reason, "give it an extent along all axes")
    return TextureDescription(
        f"{props.path}.volume", "volume", held.value, held.filter, held.wrap, to_world=held.to_world
    )


def _to_uv(props: Properties) -> np.ndarray:
    """Take the (3, 3) transformation of texture coordinates; of a 4x4 one, z is dropped."""
    value, place = props.take("to_uv"), props.place("to_uv")
    if value is None:
        return np.eye(3, dtype=np.float32)
    plain = getattr(value, "matrix", value)
    if np.shape(plain) == (3, 3):
        matrix = np.array(plain, dtype=np.float64)
    else:
        try:
            matrix = np.delete(np.delete(as_matrix(value), 2, axis=0), 2, axis=1)
        except SceneError as problem:
            raise SceneError(f"{place}: {problem}") from None
    if not np.isfinite(matrix).all() or not np.allclose(matrix[2], [0.0, 0.0, 1.0]):
        raise error(place, f"got {matrix.tolist()}", "give an affine 3x3 or 4x4 matrix")
    return matrix.astype(np.float32)


def _mesh_attribute(props: Properties) -> TextureDescription:
    name = props.string("name", "")
    if not name.startswith(("vertex_", "face_")):
        raise error(props.place("name"), f"got {name!r}", "name an attribute that starts with 'vertex_' or 'face_'")
    given = props.has("scale")
    scale = props.number("scale", 1.0)
    props.finish()
    return TextureDescription(
        props.path,
        "mesh_attribute",
        np.zeros(0, dtype=np.float32),
        attribute=name,
        scale=scale if given else None,
    )


def check_attribute(
    result: TextureDescription, attributes: dict[str, np.ndarray], where: str, low: float, high: float, scalar: bool
) -> None:
    """Raise if a mesh_attribute texture names an attribute that a shape lacks, or whose values do not fit.

    Raises:
        ValueError: With the attributes that the shape has.
    """
    for inner in result.nested:
        check_attribute(inner, attributes, where, low, high, scalar)
    if result.kind != "mesh_attribute":
        return
    if result.attribute not in attributes:
        known = ", ".join(sorted(attributes)) or "none"
        raise error(where, f"the shape has no attribute '{result.attribute}'", f"its attributes are: {known}")
    values = attributes[result.attribute]
    if values.shape[1] not in ((1,) if scalar else (1, 3)):
        wanted = "1 channel" if scalar else "1 or 3 channels"
        raise error(where, f"attribute '{result.attribute}' has {values.shape[1]} channels", f"give {wanted}")
    if result.scale is None:
        check_range(values, where, low, high, f"attribute '{result.attribute}'")
    else:
        check_range(result.scale * values, where, low, high, f"attribute '{result.attribute}' times its scale")
