"""Photographs: what a camera's file says of radiance, and what of the camera is unknown.

A camera turns the radiance I of a pixel into the number c that its file holds, between 0 and 1:

    f(c) = V(r) g I + b,

f the inverse of its response, V = 1 + v_1 r^2 + v_2 r^4 + ... its vignetting with r the distance from the film's centre
over half of its diagonal, g its exposure, a number for each channel, and b its black level. The residual compares both
sides of this equation, since a rendered image is noisy: only what is linear in I has a mean without bias. It is
weighted by the slope of the response at the photograph's value, so that an error of a residual is one of c, of which
quantisation and compression leave about the same everywhere.

Derivation: ``docs/theory/photographs.md``.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warp_psdr.image_io import read_image, srgb_to_linear
from warp_psdr.observe.observation import Observation

__all__ = ["Photograph"]

#: EXIF's tag of an image's orientation.
ORIENTATION = 0x0112
#: What can be unknown of a photograph, and how many numbers it has; the vignetting has its coefficients.
UNKNOWNS = {"exposure": 1, "white_balance": 3, "gamma": 1, "vignetting": 0}
#: Least code at which the slope of a power law counts: it has none at 0.
DARK = 0.02


class Photograph(Observation):
    """A photograph, for ``psdr.solve``.

    Args:
        source: a file, or an array (H, W), (H, W, 1) or (H, W, 3): integers over their largest value, or floats. A grey
            one has three equal channels.
        response: "srgb"; a number, the exponent by which codes become linear; a curve, (K,) linear values of the codes
            0 ... 1 in equal steps; None: linear. EXR, HDR and PFM files are linear.
        exposure: code per radiance, one number or one for each channel.
        black: linear value of no light.
        mask: (H, W), or a file: pixels that count, or their weights; or a function that returns such, which is asked
            before each step: what of the picture the scene shows, by the pose found so far. Default: all.
        saturated: codes from which on a pixel does not count, nor where any of its channels reaches them.
        vignetting: coefficients of r^2, r^4, ...
        reduce: edge of the squares of pixels that are averaged, linear, before they are compared.
        unknowns: what is to be found beside parameters of the scene: "exposure", or "white_balance", an exposure for
            each channel; "gamma", the exponent of a response that is a number; "vignetting".

    Attributes:
        weights: (H, W, 3), 0 where a pixel does not count.
        values: the camera's numbers by name: ``exposure`` (3,), ``gamma`` (1,), ``vignetting`` (n,).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no image; integers are said to be linear; it is stored turned (EXIF); the mask has another
            size, or leaves no pixel; ``reduce`` does not divide the size.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | Any,
        *,
        response: str | float | Sequence[float] | None = "srgb",
        exposure: float | Sequence[float] = 1.0,
        black: float = 0.0,
        mask: str | os.PathLike[str] | Any | None = None,
        saturated: float = 0.98,
        vignetting: Sequence[float] = (),
        reduce: int = 1,
        unknowns: Sequence[str] = (),
    ):
        codes, whole, name = _codes(source)
        self.name = name
        if whole and response is None:
            raise ValueError(f"{name}: integer values are hardly linear; give the response, or pass floats if they are")
        linear = isinstance(source, str | os.PathLike) and not whole
        self.response = None if linear else response
        self.black, self.unknowns = float(black), tuple(unknowns)
        self.values = {
            "exposure": np.broadcast_to(np.asarray(exposure, float), (3,)).copy(),
            "gamma": np.array([response if isinstance(response, int | float) else 1.0], float),
            "vignetting": np.asarray(vignetting, float),
        }
        self._check(name)
        self._counts = np.all(np.isfinite(codes) & (codes < saturated if whole else True), axis=2)
        if reduce < 1 or codes.shape[0] % reduce or codes.shape[1] % reduce:
            raise ValueError(f"{name}: reduce={reduce} does not divide {codes.shape[1]} x {codes.shape[0]} pixels")
        if reduce > 1 and "gamma" in self.unknowns:
            raise ValueError(f"{name}: an unknown gamma needs single pixels; leave out reduce, or resize the file")
        self.codes = np.where(np.isfinite(codes), codes, 0.0)
        held, slope = self._decoded(self.codes)
        self.linear, self._slope, self._reduce = _averaged(held, reduce), _averaged(slope, reduce), reduce
        self._mask = mask
        self.weights = self._weighed(mask() if callable(mask) else mask)
        self._radius2 = _radius2(self.linear.shape[:2])

    def _weighed(self, mask: Any) -> np.ndarray:
        """Return the weights of a mask's pixels."""
        weights = _mask(mask, self._counts.shape, self.name) * self._counts
        # Averages of pixels that partly count do not.
        inside = _averaged((weights > 0.0).astype(float)[..., None], self._reduce) > 1.0 - 1e-9
        if not np.any(inside):
            raise ValueError(f"{self.name}: no pixel counts: the mask is empty, or all are saturated")
        return np.where(inside, _averaged(weights[..., None], self._reduce) * self._slope, 0.0)

    def look(self) -> None:
        """Ask a mask that is a function again."""
        if callable(self._mask):
            self.weights = self._weighed(self._mask())

    def _check(self, name: str) -> None:
        unknown = [u for u in self.unknowns if u not in UNKNOWNS]
        if unknown:
            raise ValueError(f"{name}: unknown {unknown[0]!r}; expected some of {', '.join(UNKNOWNS)}")
        if {"exposure", "white_balance"} <= set(self.unknowns):
            raise ValueError(f"{name}: 'white_balance' contains 'exposure'; give one of them")
        if "gamma" in self.unknowns and not isinstance(self.response, int | float):
            raise ValueError(f"{name}: 'gamma' is the exponent of a response that is a number, not {self.response!r}")
        if "vignetting" in self.unknowns and not self.values["vignetting"].size:
            raise ValueError(f"{name}: how many coefficients? Give vignetting=[0.0, ...], where it starts")

    def _decoded(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return linear values, and the slopes of the response there: code per linear value."""
        if self.response is None:
            return codes, np.ones_like(codes)
        if isinstance(self.response, str):
            if self.response != "srgb":
                raise ValueError(f"{self.name}: response {self.response!r}; expected 'srgb', a number, a curve or None")
            h = 0.5 / 255.0
            low, high = (srgb_to_linear(np.clip(codes + side, 0.0, 1.0)).astype(float) for side in (-h, h))
            return srgb_to_linear(codes).astype(float), np.minimum(2.0 * h, 1.0) / np.maximum(high - low, 1e-6)
        if isinstance(self.response, int | float):
            gamma = float(self.values["gamma"][0])
            return codes**gamma, 1.0 / (gamma * np.maximum(codes, DARK) ** (gamma - 1.0))
        curve = np.asarray(self.response, float)
        if curve.ndim != 1 or len(curve) < 2 or np.any(np.diff(curve) <= 0.0):
            raise ValueError(f"{self.name}: a response curve is 1-D and rises, got shape {curve.shape}")
        places = np.linspace(0.0, 1.0, len(curve))
        return np.interp(codes, places, curve), 1.0 / np.interp(codes, places, np.gradient(curve, places))

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the image that it is compared with."""
        return self.linear.shape[0], self.linear.shape[1]

    @property
    def labels(self) -> list[str]:
        """Names of the unknown numbers, in order."""
        found = []
        for name in self.unknowns:
            n = UNKNOWNS[name] or self.values[name].size
            channels = ["red", "green", "blue"] if name == "white_balance" else [str(i + 1) for i in range(n)]
            found += [name] if n == 1 else [f"{name} {channel}" for channel in channels]
        return found

    @property
    def unknown_values(self) -> np.ndarray:
        """Values of the unknown numbers."""
        parts = [self.values["exposure"][:1] if u == "exposure" else self.values[_held(u)] for u in self.unknowns]
        return np.concatenate(parts) if parts else np.zeros(0)

    def move(self, step: np.ndarray) -> None:
        """Add a step to the unknown numbers."""
        first = 0
        for name in self.unknowns:
            values = self.values[_held(name)]
            n = UNKNOWNS[name] or values.size
            self.values[_held(name)] = values + step[first : first + n]
            first += n
        if "gamma" in self.unknowns:
            self.linear, _slope = self._decoded(self.codes)

    def gain(self) -> np.ndarray:
        """Return V(r) g, (H, W, 3): linear value per radiance."""
        v = np.ones(self.shape) + sum(c * self._radius2 ** (i + 1) for i, c in enumerate(self.values["vignetting"]))
        return v[..., None] * self.values["exposure"]

    def residual(self, image: np.ndarray) -> np.ndarray:
        """Return what an image has too much, weighted, (H, W, 3)."""
        return self.weights * (self.gain() * image + self.black - self.linear)

    def pushed(self, image: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return the derivative of the residual where an image has the derivative ``moved``, (H, W, 3)."""
        return self.weights * self.gain() * moved

    def pulled(self, image: np.ndarray, adjoint: np.ndarray) -> np.ndarray:
        """Return what ``pushed`` makes of an image's derivative, transposed, (H, W, 3)."""
        return self.weights * self.gain() * adjoint

    def derivatives(self, image: np.ndarray) -> np.ndarray:
        """Return the residual's derivatives by the unknown numbers, (n, H, W, 3)."""
        found, v = [], self.gain() / self.values["exposure"]
        for name in self.unknowns:
            if name == "exposure":
                found.append(v * image)
            elif name == "white_balance":
                found += [v * image * channel for channel in np.eye(3)]
            elif name == "gamma":
                found.append(-self.linear * np.log(np.maximum(self.codes, 1e-6)))
            else:
                n = self.values["vignetting"].size
                found += [self._radius2[..., None] ** (i + 1) * self.values["exposure"] * image for i in range(n)]
        return self.weights * np.array(found).reshape(-1, *self.linear.shape)

    def doubts(self, image: np.ndarray) -> np.ndarray:
        """Return the residual's derivatives by what a photograph may have and no unknown says, (n, H, W, 3).

        A response of another exponent, and light that gets brighter to one side.
        """
        h, w = self.shape
        y, x = np.mgrid[0:h, 0:w]
        seen = self.gain() * image
        found = [seen * ((x + 0.5) / w - 0.5)[..., None], seen * ((y + 0.5) / h - 0.5)[..., None]]
        if self.response is not None and "gamma" not in self.unknowns:
            found.append(-self.linear * np.log(np.maximum(self.linear, 1e-6)))
        return self.weights * np.array(found)


def _held(unknown: str) -> str:
    """Return where the values of an unknown are held."""
    return "exposure" if unknown == "white_balance" else unknown


def _codes(source: Any) -> tuple[np.ndarray, bool, str]:
    """Return an image's codes (H, W, 3), whether it was integers, and its name."""
    if isinstance(source, str | os.PathLike):
        name = Path(source).name
        image = read_image(source, raw=True)
        whole = Path(source).suffix.lower() not in (".exr", ".hdr", ".rgbe", ".pfm")
        turned = _orientation(source) if whole else 1
        if turned != 1:
            raise ValueError(
                f"{name} is stored turned (EXIF orientation {turned}), and cameras count stored pixels; turn its "
                "pixels first (Pillow: ImageOps.exif_transpose)"
            )
        image = image[..., : 3 if image.shape[2] >= 3 else 1]
    else:
        name = "photograph"
        image = np.asarray(source.numpy() if hasattr(source, "numpy") else source)
        whole = image.dtype.kind in "ui"
        image = image / np.iinfo(image.dtype).max if whole else image
        image = image[..., None] if image.ndim == 2 else image
        if image.ndim != 3 or image.shape[2] not in (1, 3):
            raise ValueError(f"photograph: got shape {np.shape(source)}, expected (H, W), (H, W, 1) or (H, W, 3)")
    return np.broadcast_to(np.asarray(image, float), (*image.shape[:2], 3)), whole, name


def _orientation(path: str | os.PathLike[str]) -> int:
    from PIL import Image

    with Image.open(path) as image:
        return int(image.getexif().get(ORIENTATION, 1))


def _mask(mask: Any, size: tuple[int, ...], name: str) -> np.ndarray:
    """Return weights (H, W)."""
    if mask is None:
        return np.ones(size)
    given = read_image(mask, raw=True).mean(axis=2) if isinstance(mask, str | os.PathLike) else np.asarray(mask, float)
    if given.shape != size:
        raise ValueError(f"{name}: the mask has shape {given.shape}, the image {size}")
    return given


def _averaged(values: np.ndarray, edge: int) -> np.ndarray:
    """Return means of squares of pixels."""
    h, w, c = values.shape
    return values.reshape(h // edge, edge, w // edge, edge, c).mean(axis=(1, 3))


def _radius2(size: tuple[int, ...]) -> np.ndarray:
    """Return squared distances from the film's centre over half of its diagonal, (H, W)."""
    h, w = size
    y, x = np.mgrid[0:h, 0:w]
    return ((x + 0.5 - 0.5 * w) ** 2 + (y + 0.5 - 0.5 * h) ** 2) / (0.25 * (w * w + h * h))
