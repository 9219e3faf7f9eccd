"""Colours: numbers, RGB triples and spectra, as linear sRGB values."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from .cie import D65, WAVELENGTH_MAX, WAVELENGTH_MIN, X_BAR, Y_BAR, Z_BAR
from .errors import SceneError, error
from .transforms import FLOAT_MAX

#: CIE XYZ to linear sRGB (IEC 61966-2-1).
_XYZ_TO_RGB = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]]
)
#: Luminance of linear sRGB.
LUMINANCE = np.array([0.212671, 0.715160, 0.072169], dtype=np.float32)

COLOR_TYPES = ("rgb", "spectrum", "uniform")
_REMEDY = "give a number, {'type': 'rgb', 'value': [r, g, b]} or {'type': 'spectrum', 'value': number or pairs}"


def color(value: Any, where: str, *, emissive: bool = False, high: float = np.inf) -> np.ndarray:
    """Return a colour as float32: shape (1,) for a grey number, (3,) for RGB.

    Emitted numbers become RGB, as in Mitsuba. A uniform spectrum is grey as a reflectance; as an emission it is the
    colour of equal energy, which is not grey in sRGB. Wavelength lists are integrated against the CIE 1931 observer:
    reflectances under daylight (D65), emissions as they are.

    Args:
        value: A number, three numbers, or a dictionary of type "rgb", "spectrum" or "uniform".
        where: Place in the scene, for messages.
        emissive: Whether the colour is emitted.
        high: Spectra within this bound stay within it: saturated ones leave the gamut of sRGB and are clipped.

    Raises:
        ValueError: If the value is of another form or not finite.
    """
    kind = ""
    if isinstance(value, dict):
        kind, where = str(value.get("type")), getattr(value, "where", "") or where
        if kind == "spectrum" and "filename" in value:
            raise error(where, "a spectrum from a file is not supported", "write it as 'wavelength:value, ...'")
        unknown = sorted(set(value) - {"type", "value", "id"})
        if unknown or kind not in COLOR_TYPES or "value" not in value:
            raise error(where, f"got {dict(value)!r} for a colour", _REMEDY)
        value = value["value"]
    if isinstance(value, str):
        value = parse_color(value, kind, where)
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise error(where, f"got {value!r} for a colour", _REMEDY) from None
    if not (np.abs(numbers) <= FLOAT_MAX).all():
        raise error(where, f"the colour {value!r} is not finite, as 32-bit floats", _REMEDY)
    if kind == "spectrum" and numbers.ndim == 2 and numbers.shape[1] == 2:
        return _from_wavelengths(numbers, where, emissive, high)
    if numbers.ndim == 0 or numbers.shape == (1,):
        if kind == "rgb" or (emissive and not kind):
            numbers = np.full(3, float(numbers.reshape(())))
        elif kind == "spectrum" and emissive:
            numbers = float(numbers.reshape(())) * (_XYZ_TO_RGB @ np.ones(3))
        return np.atleast_1d(numbers).astype(np.float32)
    if numbers.shape != (3,) or kind in ("spectrum", "uniform"):
        raise error(where, f"got {value!r} for a colour", _REMEDY)
    return numbers.astype(np.float32)


def parse_color(text: str, kind: str, where: str) -> Any:
    """Return the numbers in a colour's text: "r g b", "r, g, b", "g", "#rrggbb" (sRGB-encoded), "wavelength:value ...".

    Raises:
        ValueError: If the text is none of these.
    """
    tokens = [token for token in re.split(r"[\s,]+", text.strip()) if token]
    if kind == "rgb" and re.fullmatch(r"#[0-9a-fA-F]{6}", text.strip()):
        encoded = np.array([int(text.strip()[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
        return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    try:
        if kind == "spectrum" and any(":" in token for token in tokens):
            return [[float(part) for part in token.split(":")] for token in tokens]
        numbers = [float(token) for token in tokens]
    except ValueError:
        numbers = []
    expected = (1,) if kind == "spectrum" else (1, 3)
    if len(numbers) not in expected:
        forms = {"spectrum": "one number or 'wavelength:value' pairs"}.get(kind, "'r g b', one number or '#rrggbb'")
        raise error(where, f"cannot read the colour '{text}'", f"write {forms}")
    return numbers[0] if len(numbers) == 1 else numbers


def check_range(values: np.ndarray, where: str, low: float, high: float, what: str) -> None:
    """Raise if a colour or a texture has values outside [low, high] or that are not finite.

    Raises:
        ValueError: With the count and the extremes.
    """
    if not np.isfinite(values).all():
        raise error(where, f"{what} holds NaN or infinity", "give finite values")
    outside = (values < low) | (values > high)
    if outside.any():
        limits = f"at least {low:g}" if np.isinf(high) else f"between {low:g} and {high:g}"
        raise error(
            where,
            f"{what} has {int(outside.sum())} of {values.size} values out of range "
            f"(from {float(values.min()):g} to {float(values.max()):g})",
            f"give values {limits}",
        )


def _from_wavelengths(pairs: np.ndarray, where: str, emissive: bool, high: float) -> np.ndarray:
    """Integrate (wavelength in nm, value) pairs, linear between them and zero outside."""
    wavelengths, values = pairs.T
    if len(pairs) < 2 or np.any(np.diff(wavelengths) <= 0.0):
        raise SceneError(f"{where}: the spectrum has {len(pairs)} pairs; give two or more with increasing wavelengths")
    grid = np.linspace(WAVELENGTH_MIN, WAVELENGTH_MAX, len(Y_BAR))
    fine = np.linspace(WAVELENGTH_MIN, WAVELENGTH_MAX, 941)
    matching = np.stack([np.interp(fine, grid, bar) for bar in (X_BAR, Y_BAR, Z_BAR)])
    light = np.ones_like(fine) if emissive else np.interp(fine, grid, D65)
    sampled = np.interp(fine, wavelengths, values, left=0.0, right=0.0)
    xyz = (matching * light * sampled).sum(axis=1) / (matching[1] * light).sum()
    rgb = np.clip(_XYZ_TO_RGB @ xyz, 0.0, high if values.max() <= high else np.inf)
    return rgb.astype(np.float32)
