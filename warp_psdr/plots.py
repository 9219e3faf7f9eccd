"""Plots of a run: derivative images, loss curves, pictures side by side and error against time.

Signed quantities share one look, here and in ``warp_psdr.view.viewer``: a diverging map that is white at zero, red
above and blue below, symmetric about zero. Its range ends at a percentile of the magnitudes, so that a few outliers do
not wash out the rest, and the picture says where it ends and how much lies beyond. matplotlib is loaded on the first
call and never through its global ``pyplot`` state. Every file appears under its name only once it is complete.
"""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from warp_psdr.files import write_atomic
from warp_psdr.image_io import linear_to_srgb

#: Rec. 709 luminance of linear RGB.
LUMINANCE = (0.2126, 0.7152, 0.0722)
#: What stands for NaN and infinity in a picture: a colour that no other part of the map has.
NOT_FINITE_COLOR = (1.0, 0.0, 1.0)
#: ColorBrewer's RdBu from low (blue) to high (red), with a middle that is exactly white instead of 0.97 grey.
_DIVERGING = (
    *("#053061", "#2166ac", "#4393c3", "#92c5de", "#d1e5f0"),
    "#ffffff",
    *("#fddbc7", "#f4a582", "#d6604d", "#b2182b", "#67001f"),
)
#: Odd, so that one entry of the table is the colour of zero.
_DIVERGING_ENTRIES = 257
#: Nearest-neighbour enlargement is used until a picture's longer side has about this many pixels.
_PICTURE_PIXELS = 640
_DPI = 100
#: Inches above and below a picture for its title and size.
_CAPTION = 0.5
#: Letters of a caption in an inch, and the inches of each further line.
_LETTERS, _LINE = 13.0, 0.15
#: What images hold, derivatives of images, and gradients of losses: names and units at colour bars.
RADIANCE = "radiance [W/m²/sr]"
RADIANCE_DERIVATIVE = "radiance [W/m²/sr] per unit of the parameter"
LOSS_GRADIENT = "loss per unit of the parameter"
#: Shape of a colour bar, its distance from the pictures, and its largest height in inches beside a grid.
_BAR: dict[str, Any] = {"aspect": 30, "pad": 0.02, "fraction": 0.04}
_BAR_HEIGHT = 4.0
#: Hatching of pixels that carry no information: two greys, and the period of the stripes in enlarged pixels.
_HATCH_GREYS, _HATCH_PERIOD = (0.93, 0.72), 12

Reduce = Literal["mean", "luminance"]


def as_array(values: Any) -> np.ndarray:
    """Return a Warp array, a tensor or anything array-like as a float64 NumPy array; vectors become a last axis."""
    return np.asarray(values.numpy() if hasattr(values, "numpy") else values, dtype=np.float64)


def to_signed(values: Any, *, reduce: Reduce = "mean") -> np.ndarray:
    """Reduce the last axis (1 or 3 channels) to one signed value.

    Args:
        values: (..., 1) or (..., 3).
        reduce: "mean" of the channels, or Rec. 709 "luminance".

    Returns:
        (...), float64.

    Raises:
        ValueError: The last axis has neither 1 nor 3 entries, or ``reduce`` is unknown.
    """
    values = as_array(values)
    if values.ndim == 0 or values.shape[-1] not in (1, 3):
        raise ValueError(f"got values of shape {values.shape}; expected 1 or 3 channels in the last axis")
    if reduce not in ("mean", "luminance"):
        raise ValueError(f"unknown reduce {reduce!r}; expected 'mean' or 'luminance'")
    if values.shape[-1] == 1:
        return values[..., 0]
    return values.mean(axis=-1) if reduce == "mean" else values @ np.array(LUMINANCE)


def symmetric_limit(values: np.ndarray, percentile: float = 99.5) -> float:
    """Return the end of a symmetric colour range: a percentile of the non-zero finite magnitudes.

    Zeros do not count, or a gradient that lives on few pixels would have the limit zero. Without any non-zero value the
    limit is 1, for which everything is white.

    Raises:
        ValueError: ``percentile`` lies outside (0, 100].
    """
    if not 0.0 < percentile <= 100.0:
        raise ValueError(f"got percentile {percentile}; expected a number in (0, 100]")
    magnitude = np.abs(values[np.isfinite(values)])
    magnitude = magnitude[magnitude > 0.0]
    return float(np.percentile(magnitude, percentile)) if magnitude.size else 1.0


def clip_text(values: np.ndarray, limit: float) -> str:
    """Say where the colour range ends, which share of the values lies beyond, and how many are not finite."""
    finite = np.isfinite(values)
    if not np.any(values[finite]):
        text = "zero everywhere" if finite.all() else "zero where finite"
    else:
        beyond = 100.0 * np.mean(np.abs(values[finite]) > limit * (1.0 + 1e-6))
        text = f"clip ±{limit:.3g}, {beyond:.2g} % beyond"
    bad = int(values.size - finite.sum())
    return f"{text}, {bad} not finite" if bad else text


def diverging_colormap() -> Any:
    """Return the matplotlib colour map of signed values: blue, white at zero, red; magenta where not finite."""
    from matplotlib.colors import LinearSegmentedColormap

    colormap = LinearSegmentedColormap.from_list("psdr_diverging", _DIVERGING, N=_DIVERGING_ENTRIES)
    return colormap.with_extremes(bad=NOT_FINITE_COLOR)


def tonemap(image: Any, *, exposure: float = 0.0) -> np.ndarray:
    """Encode linear radiance for display: scale by ``2**exposure``, clamp to [0, 1], apply the sRGB curve.

    Args:
        image: (H, W), (H, W, 1) or (H, W, 3), linear.
        exposure: In stops.

    Returns:
        (H, W, 3) in [0, 1]; pixels that are not finite are magenta.
    """
    image = _image(image)
    finite = np.isfinite(image).all(axis=-1, keepdims=True)
    encoded = linear_to_srgb(np.where(finite, image, 0.0) * 2.0**exposure)
    return np.where(finite, np.broadcast_to(encoded, (*image.shape[:2], 3)), NOT_FINITE_COLOR)


def write_picture(path: str | os.PathLike, write: Callable[[BinaryIO], object]) -> None:
    """Let ``write`` fill a file that appears under its name only when it is complete.

    Raises:
        FileNotFoundError: The folder does not exist.
    """
    folder = Path(path).parent
    if not folder.is_dir():
        raise FileNotFoundError(f"cannot write {path}: folder {folder} does not exist; create it first")
    write_atomic(path, write)


def derivative_image(
    path: str | os.PathLike | BinaryIO,
    image: Any,
    *,
    percentile: float = 99.5,
    limit: float | None = None,
    reduce: Reduce = "mean",
    title: str = "",
    unit: str = "",
) -> Drawn:
    """Draw a signed image, such as the derivative of a picture or the gradient of a texture, with its colour bar.

    Args:
        path: File to write; the suffix names the format (.png, .pdf, .svg). Or an open binary file, for PNG.
        image: (H, W), (H, W, 1) or (H, W, 3), NumPy or Warp array.
        percentile: Of the non-zero magnitudes; the colour range ends there.
        limit: End of the colour range, instead of the percentile; for pictures that are to be compared.
        reduce: How RGB becomes one value: the "mean" of the channels or their "luminance".
        title: Stands above the picture.
        unit: Name and unit of the values, such as ``RADIANCE_DERIVATIVE``; stands at the colour bar.

    Returns:
        The end of the colour range, a number that notebooks show as the picture.

    Raises:
        ValueError: The image has another shape, or ``limit`` is not positive and finite.
    """
    pixels = _image(image)
    values = to_signed(pixels, reduce=reduce)
    if limit is None:
        limit = symmetric_limit(values, percentile)
    elif not (math.isfinite(limit) and limit > 0.0):
        raise ValueError(f"got limit {limit}; expected a positive number")
    height, width = values.shape
    figure = _figure(*_picture_size(width, height), extra_width=1.4, extra_height=0.9)
    axes = figure.add_subplot()
    drawn = _draw_signed(axes, values, limit)
    axes.set(xticks=[], yticks=[])
    axes.set_xlabel(f"{width} × {height}", fontsize=8, color="0.4", labelpad=2)
    axes.set_title(title, fontsize=10, wrap=True)
    channels = f"{reduce} of RGB" if pixels.shape[-1] == 3 else ""
    quantity = ", ".join(text for text in (unit, channels) if text)
    _signed_bar(figure, drawn, [axes], values, limit, quantity)
    _save(figure, path)
    return Drawn(limit, path)


class Drawn(float):
    """The end of a picture's colour range; notebooks show the picture.

    Args:
        limit: The number.
        path: The file of the picture, or an open one, which is not shown.
    """

    def __new__(cls, limit: float, path: str | os.PathLike | BinaryIO) -> Drawn:
        """Return the number with its file."""
        value = super().__new__(cls, limit)
        value._file = Path(path) if isinstance(path, str | os.PathLike) else None
        return value

    _file: Path | None

    def _repr_png_(self) -> bytes | None:
        file = self._file
        return file.read_bytes() if file is not None and file.suffix.lower() == ".png" and file.is_file() else None


def loss_curve(
    path: str | os.PathLike,
    losses: Any,
    *,
    title: str = "",
    ylabel: str = "loss",
    first_step: int = 0,
) -> None:
    """Draw losses against optimisation steps; logarithmic when all are positive.

    Args:
        path: File to write; the suffix names the format.
        losses: (N,) losses, or a mapping from a curve's label to its losses. Steps whose loss is not finite are marked.
        title: Stands above the plot.
        ylabel: Name and unit of the loss.
        first_step: Step of the first loss, for a run that was resumed.

    Raises:
        ValueError: There are no losses, or they are not one-dimensional.
    """
    curves = losses if isinstance(losses, Mapping) else {"": losses}
    arrays = {label: as_array(values) for label, values in curves.items()}
    if not arrays:
        raise ValueError("got no loss curve; expected at least one")
    figure = _figure(7.0, 4.2)
    axes = figure.add_subplot()
    for label, values in arrays.items():
        if values.ndim != 1 or values.size == 0:
            raise ValueError(f"losses {label!r} have shape {values.shape}; expected (N,) with N > 0")
        steps = first_step + np.arange(values.size)
        finite = np.isfinite(values)
        marker = "." if values.size < 50 else None
        (line,) = axes.plot(steps, np.where(finite, values, np.nan), label=label or None, marker=marker, linewidth=1.5)
        if finite.any():
            last = int(np.flatnonzero(finite)[-1])
            axes.annotate(f"{values[last]:.3g}", (steps[last], values[last]), (3, 4), textcoords="offset points",
                          fontsize=8, color=line.get_color())  # fmt: skip
        for step in steps[~finite]:
            axes.axvline(step, color=NOT_FINITE_COLOR, linewidth=1.0)
    pooled = np.concatenate(list(arrays.values()))
    pooled_finite = pooled[np.isfinite(pooled)]
    if pooled_finite.size and np.all(pooled_finite > 0.0):
        axes.set_yscale("log")
    bad = pooled.size - pooled_finite.size
    axes.set_title(f"{title} ({bad} not finite)".strip() if bad else title, fontsize=10)
    axes.set(xlabel="step", ylabel=ylabel)
    axes.margins(x=0.08)  # room for the last values
    axes.grid(True, which="both", alpha=0.25)
    if any(arrays):
        axes.legend(fontsize=8)
    _save(figure, path)


def side_by_side(
    path: str | os.PathLike | BinaryIO,
    images: Sequence[Any],
    titles: Sequence[str],
    *,
    exposure: float = 0.0,
    columns: int = 4,
    title: str = "",
    quantity: str = RADIANCE,
    differences: Mapping[str, Any] | None = None,
    difference_quantity: str = "",
    percentile: float = 99.5,
    unseen: Sequence[Any] | None = None,
    unseen_label: str = "hatched: not seen",
) -> None:
    """Draw linear images next to each other, all tone-mapped alike (see ``tonemap``), with the scale of their grey.

    Small images are enlarged without interpolation; their sizes stand below them.

    Args:
        path: File to write; the suffix names the format. Or an open binary file, for PNG.
        images: Each (H, W), (H, W, 1) or (H, W, 3), linear; sizes may differ.
        titles: One an image; one that is wider than its image takes several lines.
        exposure: In stops, the same for all.
        columns: Images in a row.
        title: Stands above the whole.
        quantity: Name and unit of the values; stands at the colour bar.
        differences: Title -> signed image. These follow the images: the mean of their channels on one scale that is
            symmetric about zero, with a colour bar of its own.
        difference_quantity: Name and unit of these values; without one they are differences of ``quantity``.
        percentile: Of the magnitudes of all differences; their colour range ends there.
        unseen: One an image: a mask (H, W) of pixels that carry no information and are hatched, or None.
        unseen_label: Says what the hatching means.

    Raises:
        ValueError: There is no image, or the numbers of images and titles differ, or a mask has another shape.
    """
    if not len(images) or len(images) != len(titles):
        raise ValueError(
            f"got {len(images)} images and {len(titles)} titles; expected one title an image, at least one"
        )
    masks = [None] * len(images) if unseen is None else list(unseen)
    if len(masks) != len(images):
        raise ValueError(f"got {len(masks)} masks for {len(images)} images; expected a mask or None an image")
    signed = {caption: to_signed(_image(values)) for caption, values in (differences or {}).items()}
    cells = [(tonemap(image, exposure=exposure), mask) for image, mask in zip(images, masks, strict=True)]
    shapes = [picture.shape[:2] for picture, _ in cells] + [values.shape for values in signed.values()]
    columns = min(columns, len(shapes))
    width, _ = _picture_size(shapes[0][1], shapes[0][0])
    width = min(width, 12.0 / columns)  # inches: the whole stays readable on a screen
    # A row is as high as its highest picture: wide pictures leave no white below them.
    rows = [shapes[i : i + columns] for i in range(0, len(shapes), columns)]
    captions = [_wrapped(caption, width) for caption in (*titles, *signed)]
    lines = [max(text.count("\n") for text in captions[i : i + columns]) for i in range(0, len(shapes), columns)]
    heights = [
        width * max(h / w for h, w in row) + _CAPTION + _LINE * more for row, more in zip(rows, lines, strict=True)
    ]
    bars = 1.0 + bool(signed)
    figure = _figure(columns * width, sum(heights), extra_width=bars, extra_height=0.25 + (0.3 if title else 0.0))
    grid = figure.add_gridspec(len(rows), columns, height_ratios=heights)
    axes = [figure.add_subplot(grid[i // columns, i % columns]) for i in range(len(shapes))]
    for panel, (picture, mask), caption in zip(axes, cells, captions, strict=False):
        shown = picture if mask is None else _hatched(picture, np.asarray(mask, bool))
        levels = np.round(255.0 * shown).astype(np.uint8)  # matplotlib itself would round down
        panel.imshow(levels, interpolation="nearest" if max(shown.shape[:2]) < _PICTURE_PIXELS else "auto")
        panel.set_title(caption, fontsize=9)
    limit = symmetric_limit(np.concatenate([v.reshape(-1) for v in signed.values()]), percentile) if signed else 1.0
    rest = zip(axes[len(cells) :], captions[len(cells) :], signed.values(), strict=True)
    for panel, caption, values in rest:
        drawn = _draw_signed(panel, values, limit)
        panel.set_title(caption, fontsize=9)
    for panel, (h, w) in zip(axes, shapes, strict=True):
        panel.set(xticks=[], yticks=[])
        panel.set_xlabel(f"{w} × {h}", fontsize=7, color="0.4", labelpad=2)
    if signed:
        of = difference_quantity or f"difference of {quantity}"
        every = np.concatenate([v.reshape(-1) for v in signed.values()])
        _signed_bar(figure, drawn, axes, every, limit, f"{of},\nmean of RGB")
    _grey_bar(figure, axes, quantity, exposure)
    if any(mask is not None for mask in masks):
        figure.supxlabel(unseen_label, fontsize=8)
    if title:
        figure.suptitle(title, fontsize=10)
    _save(figure, path)


def error_against_time(
    path: str | os.PathLike,
    series: Mapping[str, tuple[Any, Any]],
    *,
    title: str = "",
    ylabel: str = "relative RMS error",
) -> None:
    """Draw each method's error against its time, both logarithmic, over guides of the Monte Carlo slope -1/2.

    Args:
        path: File to write; the suffix names the format.
        series: A method's label, and its times in seconds and errors, (N,) each.
        title: Stands above the plot.
        ylabel: Name and unit of the error.

    Raises:
        ValueError: There is no series, lengths differ, or a time or an error is not positive and finite.
    """
    if not series:
        raise ValueError("got no series; expected at least one")
    points = {label: (as_array(seconds), as_array(errors)) for label, (seconds, errors) in series.items()}
    figure = _figure(6.6, 5.0)
    axes = figure.add_subplot()
    for label, (seconds, errors) in points.items():
        if seconds.ndim != 1 or seconds.size == 0 or seconds.shape != errors.shape:
            raise ValueError(
                f"series {label!r} has times {seconds.shape} and errors {errors.shape}; expected (N,) twice"
            )
        if not (np.isfinite([seconds, errors]).all() and min(seconds.min(), errors.min()) > 0.0):
            raise ValueError(
                f"series {label!r} has a time or an error that is not positive; a log-log plot cannot show it"
            )
        order = np.argsort(seconds)
        axes.plot(seconds[order], errors[order], marker="o", markersize=4, linewidth=1.5, label=label)
    axes.set(xscale="log", yscale="log", xlabel="time [s]", ylabel=ylabel)
    axes.set_title(title, fontsize=10)
    low, high = axes.get_xlim()
    limits = axes.get_ylim()
    for number, (seconds, errors) in enumerate(points.values()):
        through = errors[np.argmin(seconds)] * math.sqrt(seconds.min())
        times = np.array([low, high])
        guide = axes.plot(times, through / np.sqrt(times), color="0.75", linewidth=0.8, linestyle="--", zorder=0)
        if number == 0:
            guide[0].set_label("slope −1/2")
    axes.set(xlim=(low, high), ylim=limits)
    axes.grid(True, which="both", alpha=0.25)
    axes.legend(fontsize=8)
    _save(figure, path)


def _wrapped(caption: str, width: float) -> str:
    """Return a caption whose lines are no wider than a picture of ``width`` inches, where they have spaces."""
    letters = max(int(_LETTERS * width), 8)
    return "\n".join(textwrap.fill(line, letters, break_long_words=False) for line in caption.split("\n"))


def _image(image: Any) -> np.ndarray:
    """Return (H, W, 1 or 3) float64."""
    pixels = as_array(image)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[-1] not in (1, 3) or pixels.size == 0:
        raise ValueError(f"got an image of shape {pixels.shape}; expected (H, W), (H, W, 1) or (H, W, 3), not empty")
    return pixels


def _draw_signed(axes: Any, values: np.ndarray, limit: float) -> Any:
    shown = np.where(np.isfinite(values), values, np.nan)
    return axes.imshow(shown, cmap=diverging_colormap(), vmin=-limit, vmax=limit, interpolation="nearest")


def _signed_bar(figure: Any, drawn: Any, axes: list[Any], values: np.ndarray, limit: float, quantity: str) -> None:
    """Add the colour bar of signed values: name and unit, where the range ends, and what lies beyond."""
    beyond = np.any(np.abs(values[np.isfinite(values)]) > limit * (1.0 + 1e-6))
    bar = figure.colorbar(drawn, ax=axes, extend="both" if beyond else "neither", **_BAR, shrink=_shrink(figure, axes))
    bar.ax.ticklabel_format(style="sci", scilimits=(-2, 3), useMathText=True)
    bar.set_label("\n".join(text for text in (quantity, clip_text(values, limit)) if text), fontsize=8)


def _shrink(figure: Any, axes: list[Any]) -> float:
    """Return a colour bar's share of the height: all of one picture's, a handy part of a grid's."""
    return min(_BAR_HEIGHT / figure.get_figheight(), 1.0) if len(axes) > 1 else 1.0


def _grey_bar(figure: Any, axes: list[Any], quantity: str, exposure: float) -> None:
    """Add the scale of tone-mapped values: the grey that stands for each, up to white."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    greys = linear_to_srgb(np.linspace(0.0, 1.0, 256))
    colormap = LinearSegmentedColormap.from_list("psdr_srgb", np.repeat(greys[:, None], 3, axis=1))
    white = 2.0**-exposure
    bar = figure.colorbar(
        ScalarMappable(Normalize(0.0, white), colormap), ax=axes, extend="max", **_BAR, shrink=_shrink(figure, axes)
    )
    bar.set_label(f"{quantity},\neach channel, sRGB-encoded", fontsize=8)


def _hatched(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return an enlarged picture (H', W', 3) with diagonal stripes where the mask holds."""
    if mask.shape != picture.shape[:2]:
        raise ValueError(f"got a mask of shape {mask.shape} for an image of shape {picture.shape[:2]}")
    scale = max(_PICTURE_PIXELS // max(mask.shape), 1)
    enlarged, where = (np.repeat(np.repeat(x, scale, axis=0), scale, axis=1) for x in (picture, mask))
    y, x = np.indices(where.shape)
    stripes = np.where((x + y) % _HATCH_PERIOD < _HATCH_PERIOD // 2, *_HATCH_GREYS)
    return np.where(where[..., None], stripes[..., None], enlarged)


def _picture_size(width: int, height: int) -> tuple[float, float]:
    """Return inches such that an image pixel is a whole number of picture pixels, up to ``_PICTURE_PIXELS``."""
    longer = max(width, height)
    scale = max(_PICTURE_PIXELS // longer, 1) if longer <= 2 * _PICTURE_PIXELS else 2 * _PICTURE_PIXELS / longer
    return max(width * scale / _DPI, 1.0), max(height * scale / _DPI, 1.0)


def _figure(width: float, height: float, *, extra_width: float = 0.0, extra_height: float = 0.0) -> Any:
    """Return an empty figure with an Agg canvas; sizes in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = (max(width + extra_width, 3.0), max(height + extra_height, 2.2))
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Any, path: str | os.PathLike | BinaryIO) -> None:
    if not isinstance(path, (str, os.PathLike)):
        figure.savefig(path, format="png")
        return
    suffix = Path(path).suffix.lower().lstrip(".")
    known = figure.canvas.get_supported_filetypes()
    if suffix not in known:
        raise ValueError(f"cannot write {path}: unknown format {suffix!r}; expected one of {', '.join(sorted(known))}")
    write_picture(path, lambda file: figure.savefig(file, format=suffix))
