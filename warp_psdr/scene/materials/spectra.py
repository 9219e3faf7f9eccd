"""Colours: numbers, RGB triples and spectra, as linear sRGB values, the same ones as in Mitsuba's RGB variants.

Mitsuba evaluates ``regular``, ``irregular`` and ``blackbody`` in its spectral variants only. Here they become the
colour that such a variant shows: that of the list of wavelengths as a ``spectrum``, and that of Planck's law.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.scene.errors import SceneError, error
from warp_psdr.scene.materials.cie import D65, WAVELENGTH_MAX, WAVELENGTH_MIN, X_BAR, Y_BAR, Z_BAR
from warp_psdr.scene.plugins import Properties
from warp_psdr.scene.transforms import FLOAT_MAX

if TYPE_CHECKING:
    from warp_psdr.scene.context import Context

#: CIE XYZ to linear sRGB (IEC 61966-2-1).
_XYZ_TO_RGB = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]]
)
#: Luminance of linear sRGB.
LUMINANCE = np.array([0.212671, 0.715160, 0.072169], dtype=np.float32)
#: Integral of the y matching function over nm, and the mean of D65 that it weighs: Mitsuba's, so that its rounding is
#: ours.
_Y_INTEGRAL, _D65_MEAN = 106.7502593994140625, 98.99741751876255
#: Wavelengths at which spectra are integrated.
_STEPS = 1000
#: Bytes and entries of a spectrum: far more than any measurement has.
_FILE_MAX, _ENTRIES_MAX = 1 << 20, 1 << 16
#: Planck's constant, the speed of light and Boltzmann's constant, SI units.
_H, _C, _K = 6.62607004e-34, 2.99792458e8, 1.38064852e-23

_REMEDY = "give a number, {'type': 'rgb', 'value': [r, g, b]} or {'type': 'spectrum', 'value': number or pairs}"


def color(
    value: Any, where: str, context: Context, *, path: str = "", emissive: bool = False, high: float = np.inf
) -> np.ndarray:
    """Return a colour as float32: shape (1,) for a grey number, (3,) for RGB.

    Emitted numbers become RGB, as in Mitsuba. A uniform ``spectrum`` is grey as a reflectance; as an emission it is the
    colour of equal energy, which is not grey in sRGB. Wavelength lists are integrated against the CIE 1931 observer:
    reflectances under daylight (D65), emissions as they are. ``d65`` is the white of sRGB.

    Args:
        value: A number, three numbers, or a dictionary whose type is one of ``COLOR_TYPES``.
        where: Place in the scene, for messages.
        context: The load in progress: files of spectra are looked up through it.
        path: Name under which the colour is listed.
        emissive: Whether the colour is emitted.
        high: Spectra are clipped to this bound, as saturated ones leave the gamut of sRGB.

    Raises:
        ValueError: If the value is of another form or not finite.
        FileNotFoundError: If the file of a spectrum does not exist.
    """
    if not isinstance(value, dict):
        numbers = _numbers(value, "", where)
        return _as_float32(np.full(3, numbers[0]) if emissive and numbers.size == 1 else numbers)
    where = getattr(value, "where", "") or where
    if value.get("type") not in COLOR_TYPES:
        raise error(where, f"got {dict(value)!r} for a colour", _REMEDY)
    props = Properties(value, where, path, context)
    result = _BUILDERS[props.type](props, emissive, high)
    props.finish()
    return _as_float32(result)


def _as_float32(numbers: np.ndarray) -> np.ndarray:
    return np.atleast_1d(numbers).astype(np.float32)


def _rgb(props: Properties, emissive: bool, high: float, name: str = "value") -> np.ndarray:
    value = _required(props, name)
    if isinstance(value, dict) and value.get("type") == "rgb":
        value = _required(Properties(value, props.place(name), "", props.context), "value")
    numbers = _numbers(value, "rgb", props.where)
    return np.full(3, numbers[0]) if numbers.size == 1 else numbers


def _srgb(props: Properties, emissive: bool, high: float) -> np.ndarray:
    props.take("unbounded")  # what is admissible depends on what the colour is used for
    return _rgb(props, emissive, high, "color")


def _uniform(props: Properties, emissive: bool, high: float) -> np.ndarray:
    value = _required(props, "value")
    _range(props)
    numbers = _numbers(value, "uniform", props.where)
    if numbers.size != 1:
        raise error(props.where, f"got {value!r} for a colour", "give one number")
    return numbers


def _rawconstant(props: Properties, emissive: bool, high: float) -> np.ndarray:
    return _numbers(_required(props, "value"), "rawconstant", props.where)


def _spectrum(props: Properties, emissive: bool, high: float) -> np.ndarray:
    if props.has("filename"):
        if props.has("value"):
            raise error(props.where, "got both 'value' and 'filename'", "give one of them")
        file = props.context.file(props.take("filename"), props.place("filename"))
        return _from_pairs(props, _read_spectrum(file, props.place("filename")), emissive, high)
    value = _required(props, "value")
    props.take("filename")
    if isinstance(value, str):
        value = parse_color(value, "spectrum", props.where)
    numbers = _plain(value, props.where)
    if numbers.ndim == 2 and numbers.shape[1] == 2:
        return _from_pairs(props, numbers, emissive, high)
    if numbers.size != 1:
        raise error(props.where, f"got {value!r} for a colour", _REMEDY)
    return float(numbers.reshape(())) * (_XYZ_TO_RGB @ np.ones(3)) if emissive else numbers.reshape(1)


def _d65(props: Properties, emissive: bool, high: float) -> np.ndarray:
    white = _rgb(props, emissive, high, "color") if props.has("color") else np.ones(1)
    props.take("color")
    return props.number("scale", 1.0, minimum=0.0) * white


def _regular(props: Properties, emissive: bool, high: float) -> np.ndarray:
    values = _list(props, "values")
    low, top = _range(props)
    return _from_pairs(props, np.stack([np.linspace(low, top, len(values)), values], axis=1), emissive, high)


def _irregular(props: Properties, emissive: bool, high: float) -> np.ndarray:
    wavelengths, values = _list(props, "wavelengths"), _list(props, "values")
    if len(wavelengths) != len(values):
        problem = f"{len(wavelengths)} wavelengths and {len(values)} values"
        raise error(props.where, problem, "give as many of both")
    return _from_pairs(props, np.stack([wavelengths, values], axis=1), emissive, high)


def _blackbody(props: Properties, emissive: bool, high: float) -> np.ndarray:
    """Planck's law, W per m^2, sr and nm."""
    temperature = props.number("temperature", None, minimum=0.0, exclusive=True)
    low, top = _range(props)

    def planck(nm: np.ndarray) -> np.ndarray:
        m = 1e-9 * nm
        with np.errstate(over="ignore"):  # cold bodies do not shine
            radiance = 2e-9 * _H * _C**2 / (m**5 * np.expm1(_H * _C / (_K * m * temperature)))
        return np.where((nm >= low) & (nm <= top), radiance, 0.0)

    return _integrate(planck, emissive, high)


#: Plugins that are a colour.
_BUILDERS: dict[str, Callable[[Properties, bool, float], np.ndarray]] = {
    "rgb": _rgb,
    "srgb": _srgb,
    "spectrum": _spectrum,
    "uniform": _uniform,
    "rawconstant": _rawconstant,
    "d65": _d65,
    "blackbody": _blackbody,
    "regular": _regular,
    "irregular": _irregular,
}
COLOR_TYPES = tuple(_BUILDERS)


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
    expected = (1,) if kind in ("spectrum", "uniform") else (1, 3)
    if len(numbers) not in expected:
        forms = {"spectrum": "one number or 'wavelength:value' pairs", "uniform": "one number"}
        form = forms.get(kind, "'r g b', one number or '#rrggbb'")
        raise error(where, f"cannot read the colour '{text}'", f"write {form}")
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


def _required(props: Properties, name: str) -> Any:
    value = props.take(name)
    if value is None:
        raise error(props.where, f"a '{props.type}' without '{name}'", _REMEDY)
    return value


def _plain(value: Any, where: str) -> np.ndarray:
    """Return finite numbers, float64, of whatever shape."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise error(where, f"got {value!r} for a colour", _REMEDY) from None
    if not (np.abs(numbers) <= FLOAT_MAX).all():
        raise error(where, f"the colour {value!r} is not finite, as 32-bit floats", _REMEDY)
    return numbers


def _numbers(value: Any, kind: str, where: str) -> np.ndarray:
    """Return one or three finite numbers, float64, of a colour or of its text."""
    numbers = np.atleast_1d(_plain(parse_color(value, kind, where) if isinstance(value, str) else value, where))
    if numbers.shape not in ((1,), (3,)):
        raise error(where, f"got {value!r} for a colour", _REMEDY)
    return numbers


def _list(props: Properties, name: str) -> np.ndarray:
    """Take a list of finite numbers or its text."""
    value = _required(props, name)
    if isinstance(value, str):
        value = [token for token in re.split(r"[\s,]+", value.strip()) if token]
    numbers = _plain(value, props.place(name))
    if numbers.ndim != 1 or not 2 <= len(numbers) <= _ENTRIES_MAX:
        raise error(props.place(name), f"got numbers of shape {numbers.shape}", f"give 2 to {_ENTRIES_MAX} numbers")
    return numbers


def _range(props: Properties) -> tuple[float, float]:
    """Take ``wavelength_min`` and ``wavelength_max`` in nm."""
    low = props.number("wavelength_min", WAVELENGTH_MIN, minimum=0.0)
    high = props.number("wavelength_max", WAVELENGTH_MAX)
    if low >= high:
        problem = f"wavelength_min is {low:g} and wavelength_max {high:g}"
        raise error(props.where, problem, "wavelength_min must be the smaller one")
    return low, high


def _read_spectrum(file: Path, where: str) -> np.ndarray:
    """Return the pairs of a text file: a wavelength in nm and a value in each line, comments after "#"."""
    if file.stat().st_size > _FILE_MAX:
        raise error(where, f"'{file}' has {file.stat().st_size} bytes", f"give a spectrum of at most {_FILE_MAX}")
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    pairs = []
    for number, line in enumerate(lines, start=1):
        text = line.partition("#")[0].replace(",", " ").split()
        if not text:
            continue
        try:
            wavelength, value = (float(token) for token in text)
        except ValueError:
            problem = f"'{file}', line {number}: '{line.strip()[:80]}' is no pair of numbers"
            raise error(where, problem, "write a wavelength in nm and a value in each line") from None
        pairs.append((wavelength, value))
    return _plain(pairs, where).reshape(-1, 2)


def _from_pairs(props: Properties, pairs: np.ndarray, emissive: bool, high: float) -> np.ndarray:
    """Integrate (wavelength in nm, value) pairs, linear between them and zero outside."""
    wavelengths, values = pairs.T
    if not 2 <= len(pairs) <= _ENTRIES_MAX or np.any(np.diff(wavelengths) <= 0.0):
        problem = f"{props.where}: the spectrum has {len(pairs)} pairs; give 2 to {_ENTRIES_MAX} pairs"
        raise SceneError(f"{problem} with increasing wavelengths")
    return _integrate(lambda nm: np.interp(nm, wavelengths, values, left=0.0, right=0.0), emissive, high)


def _integrate(spectrum: Callable[[np.ndarray], np.ndarray], emissive: bool, high: float) -> np.ndarray:
    """Return the linear sRGB colour of a spectrum, per nm, clipped to [0, ``high``]."""
    grid = np.linspace(WAVELENGTH_MIN, WAVELENGTH_MAX, len(Y_BAR))
    nm = np.linspace(WAVELENGTH_MIN, WAVELENGTH_MAX, _STEPS)
    matching = np.stack([np.interp(nm, grid, bar) for bar in (X_BAR, Y_BAR, Z_BAR)])
    light = 1.0 if emissive else np.interp(nm, grid, D65) / _D65_MEAN
    # Mitsuba's sum: its white is 0.999.
    width = (WAVELENGTH_MAX - WAVELENGTH_MIN) / _STEPS / _Y_INTEGRAL
    xyz = (matching * light * spectrum(nm)).sum(axis=1) * width
    return np.clip(_XYZ_TO_RGB @ xyz, 0.0, high)
