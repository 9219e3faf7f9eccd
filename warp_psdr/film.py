"""What a range of samples adds up to: a film, from which images follow, and which adds to other films."""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_psdr.files import write_atomic
from warp_psdr.image import Image


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Film:
    """Sums over samples of an image, which ``psdr.render(samples=(a, b))`` returns.

    Films of other samples, or of other pixels, add to it: ``film + film``, or ``sum(films)``. Add each sample once: the
    sum of (0, 8) and (4, 16) counts those from 4 to 7 twice. Films can be pickled.

    Attributes:
        weights: (H, W) float64, sums of the samples' weights under the pixel filter; 0 where none were drawn.
        radiance: (H, W, 3) float64, sums of the samples' radiance times their weights, W/m^2/sr.
        drawn: (H, W) int64, how many samples every pixel has.
        squares: (H, W, 3) float64, sums of the squares of the samples' radiance; None under a filter that lets a sample
            count for several pixels, and where paths start at the lights.
        splats: (H, W, 3) float64, sums of what paths from the lights bring, W/m^2/sr; the image has their part divided
            by ``drawn``. None: there are no such paths.
    """

    weights: np.ndarray
    radiance: np.ndarray
    drawn: np.ndarray
    squares: np.ndarray | None = None
    splats: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ValueError: they do not agree.
        """
        shape = self.weights.shape
        for name, array in self._arrays().items():
            expected = shape if array is self.weights or name == "drawn" else (*shape, 3)
            if len(shape) != 2 or array.shape != expected:
                raise ValueError(f"{name}: got shape {array.shape} beside weights of shape {shape}, expected (H, W)")

    @property
    def samples(self) -> int:
        """Samples a pixel, the largest number where pixels have unequal ones."""
        return int(self.drawn.max(initial=0))

    def __repr__(self) -> str:
        height, width = self.weights.shape
        return f"Film({width} x {height} pixels, {self.samples} samples a pixel)"

    def __add__(self, other: Film) -> Film:
        """Return the film of the samples of both.

        Raises:
            ValueError: the films differ in size, or only one has squares or light paths.
        """
        if not isinstance(other, Film):
            return NotImplemented
        ours, theirs = self._arrays(), other._arrays()
        if self.weights.shape != other.weights.shape:
            raise ValueError(f"films: got {self!r} and {other!r}, expected films of one size")
        for name in ("squares", "splats"):
            if (name in ours) != (name in theirs):
                raise ValueError(
                    f"films: only one of the two has {name}; add films of one scene, sensor and integrator"
                )
        return Film(**{name: array + theirs[name] for name, array in ours.items()})

    def __radd__(self, other: Any) -> Film:
        """Let ``sum`` begin with its zero."""
        return self if isinstance(other, int) and other == 0 else NotImplemented

    def image(self, device: Any = "cpu") -> Image:
        """Return the image of these samples.

        Args:
            device: Warp device that it lies on.

        Returns:
            ``wp.array2d`` of vec3, (H, W), W/m^2/sr; black where no samples were drawn.
        """
        weights = np.where(self.weights > 0.0, self.weights, 1.0)
        values = self.radiance / weights[..., None]
        if self.splats is not None:
            values += self.splats / np.maximum(self.drawn, 1)[..., None]
        image = Image(self.weights.shape, device)
        image.assign(values.astype(np.float32))
        return image

    def variance(self) -> np.ndarray:
        """Return the estimated variance of the image.

        The estimate is unbiased for independent samples (``PathIntegrator(sampler="independent")``). Sobol samples of a
        pixel are stratified: their mean varies less than that of independent ones, and the estimate is too large.

        Returns:
            (H, W, 3) float64, variance of every pixel's mean, (W/m^2/sr)^2; NaN where there are fewer than two samples.

        Raises:
            ValueError: the film has no squares.
        """
        if self.squares is None:
            raise ValueError(
                "film: its samples have no squares, since each counts for several pixels, or since paths start at the "
                "lights; give the sensor a 'box' filter, or compare the images of several seeds"
            )
        count = np.where(self.drawn > 1, self.drawn, np.nan)[..., None]
        about_mean = self.squares - self.radiance * self.radiance / count
        return np.maximum(about_mean, 0.0) / (count * (count - 1.0))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the film to a file (NumPy's ``npz``), which appears under its name when it is complete.

        Args:
            path: of the file; a former one is replaced.

        Raises:
            OSError: the file cannot be written; then a former one is untouched.
        """
        write_atomic(path, lambda file: np.savez(file, **self._arrays()))  # type: ignore[arg-type]

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Film:
        """Return the film of a file that ``save`` has written.

        Args:
            path: of the file.

        Returns:
            The film, to the bit.

        Raises:
            OSError: the file cannot be read.
            ValueError: it holds no film.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                return Film(**{name: file[name] for name in file.files})
        except (TypeError, ValueError, EOFError, zipfile.BadZipFile) as problem:
            raise ValueError(f"{path}: holds no film that Film.save has written: {problem}") from problem

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays that there are, by name."""
        return {name: array for name, array in vars(self).items() if array is not None}
