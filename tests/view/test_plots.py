"""The plots, looked at pixel by pixel: colours mean what the docstrings say, and no file is ever half written."""

import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from PIL import Image

from warp_psdr import plots

WHITE = (255, 255, 255)
MAGENTA = (255, 0, 255)
ROOT = Path(__file__).resolve().parents[2]


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def band_colors(path: Path, count: int) -> list[tuple[int, ...]]:
    """Colours of ``count`` equal bands, left to right, of the picture that fills the left of a file."""
    image = pixels(path)
    row = [tuple(color) for color in image[len(image) // 2].tolist()]
    runs: list[tuple[tuple[int, ...], int]] = []
    for color in row:
        runs = [*runs[:-1], (color, runs[-1][1] + 1)] if runs and runs[-1][0] == color else [*runs, (color, 1)]
    return [color for color, length in runs if length > 100][:count]


def is_red(color: tuple[int, ...]) -> bool:
    return color[0] > color[1] + 60 and color[0] > color[2] + 60


def is_blue(color: tuple[int, ...]) -> bool:
    return color[2] > color[0] + 60


def share(image: np.ndarray, color: tuple[int, ...]) -> float:
    return float(np.mean((image == color).all(axis=-1)))


def test_zero_is_white_positive_red_negative_blue(tmp_path: Path) -> None:
    image = np.repeat([[-2.0, 0.0, 2.0]], 3, axis=0)
    assert plots.derivative_image(tmp_path / "d.png", image, title="t", unit="W/m²/sr") == 2.0
    blue, white, red = band_colors(tmp_path / "d.png", 3)
    assert white == WHITE
    assert is_blue(blue)
    assert is_red(red)


def test_equal_magnitudes_are_equally_far_from_white() -> None:
    colors = plots.diverging_colormap()(np.array([0.0, 0.25, 0.5, 0.75, 1.0]))[:, :3]
    assert np.array_equal(colors[2], [1.0, 1.0, 1.0])
    luminance = colors @ np.array(plots.LUMINANCE)
    assert abs(luminance[1] - luminance[3]) < 0.08  # ColorBrewer balances the two sides only approximately
    assert luminance[0] < luminance[1] < luminance[2] > luminance[3] > luminance[4]


def test_range_ends_at_a_percentile_of_what_is_not_zero(tmp_path: Path) -> None:
    image = np.zeros((40, 40))
    image[:10] = np.linspace(-1.0, 1.0, 400).reshape(10, 40)
    image[0, 0] = -1e6
    limit = plots.derivative_image(tmp_path / "d.png", image, percentile=99.0)
    nonzero = np.abs(image[image != 0.0])
    assert limit == pytest.approx(np.percentile(nonzero, 99.0))
    assert limit < 1.0
    text = plots.clip_text(image, limit)
    assert f"{limit:.3g}" in text
    assert f"{100.0 * np.mean(np.abs(image) > limit):.2g} % beyond" in text


def test_all_zero_is_all_white(tmp_path: Path) -> None:
    assert plots.derivative_image(tmp_path / "d.png", np.zeros((4, 8, 3))) == 1.0
    assert band_colors(tmp_path / "d.png", 1) == [WHITE]
    assert plots.clip_text(np.zeros(3), 1.0) == "zero everywhere"


def test_what_is_not_finite_is_magenta_and_counted(tmp_path: Path) -> None:
    image = np.zeros((8, 8))
    image[:, 4] = 1.0
    image[2:4] = np.nan
    image[4:6] = np.inf
    plots.derivative_image(tmp_path / "d.png", image)
    assert share(pixels(tmp_path / "d.png"), MAGENTA) > 0.2
    assert plots.clip_text(image, 1.0).endswith("32 not finite")


def test_rgb_is_reduced_as_asked(tmp_path: Path) -> None:
    image = np.zeros((2, 2, 3))
    image[..., 1] = 3.0
    assert plots.derivative_image(tmp_path / "m.png", image) == pytest.approx(1.0)
    assert plots.derivative_image(tmp_path / "l.png", image, reduce="luminance") == pytest.approx(3.0 * 0.7152)


def test_a_given_limit_makes_pictures_comparable(tmp_path: Path) -> None:
    image = np.ones((4, 4))
    plots.derivative_image(tmp_path / "full.png", image)
    assert plots.derivative_image(tmp_path / "pale.png", image, limit=4.0) == 4.0
    (full,), (pale,) = band_colors(tmp_path / "full.png", 1), band_colors(tmp_path / "pale.png", 1)
    assert is_red(full)
    assert sum(pale) > sum(full) + 150


def test_takes_warp_images(tmp_path: Path) -> None:
    image = wp.array(np.full((4, 6, 3), -0.5, np.float32), dtype=wp.vec3, device="cpu")
    assert plots.derivative_image(tmp_path / "d.png", image) == pytest.approx(0.5)
    assert is_blue(band_colors(tmp_path / "d.png", 1)[0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"image": np.zeros((2, 2, 4))}, "shape"),
        ({"image": np.zeros(5)}, "shape"),
        ({"image": np.zeros((0, 4, 3))}, "not empty"),
        ({"image": np.ones((2, 2)), "percentile": 0.0}, "percentile"),
        ({"image": np.ones((2, 2)), "limit": -1.0}, "limit"),
        ({"image": np.ones((2, 2, 3)), "reduce": "max"}, "reduce"),
        ({"image": np.ones((2, 2)), "path": "d.xyz"}, "format"),
    ],
)
def test_bad_derivative_images_are_refused(tmp_path: Path, arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plots.derivative_image(tmp_path / arguments.pop("path", "d.png"), **arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        plots.loss_curve(tmp_path / "nowhere" / "l.png", [1.0])


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "l.png"
    path.write_bytes(b"old")

    def fail(self, file, **options):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", fail)
    with pytest.raises(OSError, match="disk full"):
        plots.loss_curve(path, [1.0, 0.5])
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["l.png"]


def line_heights(image: np.ndarray, color: tuple[int, int, int]) -> dict[int, float]:
    """Mean row of a colour's pixels in each column that has some."""
    rows, columns = np.nonzero((np.abs(image - color) <= 8).all(axis=-1))
    return {int(c): float(rows[columns == c].mean()) for c in np.unique(columns)}


def test_losses_fall_along_a_logarithmic_axis(tmp_path: Path) -> None:
    plots.loss_curve(tmp_path / "l.png", 0.9 ** np.arange(100), title="fit")
    heights = line_heights(pixels(tmp_path / "l.png"), (31, 119, 180))
    columns = sorted(heights)
    curve = np.array([heights[c] for c in columns if c < columns[0] + 500])
    assert len(curve) > 300
    # A geometric decay is a straight line when the axis is logarithmic.
    line = np.polyval(np.polyfit(np.arange(len(curve)), curve, 1), np.arange(len(curve)))
    assert curve[-1] - curve[0] > 150
    assert np.abs(curve - line).max() < 5


def test_losses_that_are_not_finite_are_marked(tmp_path: Path) -> None:
    losses = np.linspace(2.0, -1.0, 60)
    plots.loss_curve(tmp_path / "good.png", {"one": losses})
    losses[30] = np.nan
    plots.loss_curve(tmp_path / "bad.png", {"one": losses})
    assert share(pixels(tmp_path / "good.png"), MAGENTA) == 0.0
    assert share(pixels(tmp_path / "bad.png"), MAGENTA) > 0.0


@pytest.mark.parametrize("losses", [[], [[1.0, 2.0]], {}, {"a": []}])
def test_losses_that_are_no_curve_are_refused(tmp_path: Path, losses) -> None:
    with pytest.raises(ValueError, match="expected"):
        plots.loss_curve(tmp_path / "l.png", losses)


def test_tonemap_is_the_srgb_curve() -> None:
    image = np.array([[0.0, 0.001, 0.18, 0.5, 1.0, 7.0, -1.0]])
    encoded = plots.tonemap(image)[0, :, 0]
    assert encoded == pytest.approx([0.0, 0.01292, 0.46136, 0.73536, 1.0, 1.0, 0.0], abs=1e-4)
    assert plots.tonemap(image, exposure=-1.0)[0, 4] == pytest.approx([0.73536] * 3, abs=1e-4)
    assert plots.tonemap(np.array([[np.nan]]))[0, 0].tolist() == [1.0, 0.0, 1.0]


def test_pictures_stand_side_by_side_in_order(tmp_path: Path) -> None:
    colors = [(0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 9.0)]
    images = [np.broadcast_to(np.array(color), (6, 8, 3)) for color in colors]
    plots.side_by_side(tmp_path / "s.png", images, ["a", "b", "c"], title="views")
    assert band_colors(tmp_path / "s.png", 3) == [(188, 0, 0), (0, 188, 0), (0, 0, 255)]


def test_pictures_wrap_into_rows(tmp_path: Path) -> None:
    images = [np.full((4, 4), v) for v in (0.2, 0.4, 0.6)]
    plots.side_by_side(tmp_path / "s.png", images, ["a", "b", "c"], columns=2)
    shown = pixels(tmp_path / "s.png")
    greys = [round(255 * float(plots.tonemap(image)[0, 0, 0])) for image in images]
    assert min((shown == grey).all(axis=-1).sum() for grey in greys) > 100 * 100


@pytest.mark.parametrize(("images", "titles"), [([], []), ([np.ones((2, 2))], ["a", "b"])])
def test_each_picture_needs_a_title(tmp_path: Path, images: list, titles: list) -> None:
    with pytest.raises(ValueError, match="title"):
        plots.side_by_side(tmp_path / "s.png", images, titles)


def test_error_against_time_is_log_log(tmp_path: Path) -> None:
    seconds = np.geomspace(0.1, 100.0, 8)
    series = {"good": (seconds[::-1], 0.1 / seconds[::-1]), "bad": (seconds, 2.0 / seconds)}
    plots.error_against_time(tmp_path / "e.png", series, title="cornell")
    image = pixels(tmp_path / "e.png")
    good, bad = line_heights(image, (31, 119, 180)), line_heights(image, (255, 127, 14))
    common = sorted(set(good) & set(bad))
    common = common[5 : int(0.6 * len(common))]  # without the legend's samples
    assert len(common) > 150
    assert all(good[c] > bad[c] + 20 for c in common)  # lower on the page is less error
    line = np.polyval(np.polyfit(common, [good[c] for c in common], 1), common)
    assert np.abs(line - [good[c] for c in common]).max() < 4
    assert share(image, (191, 191, 191)) > 0.0  # the guides of slope -1/2


@pytest.mark.parametrize(
    "series",
    [{}, {"a": ([1.0, 2.0], [1.0])}, {"a": ([0.0], [1.0])}, {"a": ([1.0], [-1.0])}, {"a": ([1.0], [np.nan])}],
)
def test_errors_that_a_log_log_plot_cannot_show_are_refused(tmp_path: Path, series: dict) -> None:
    with pytest.raises(ValueError, match="series"):
        plots.error_against_time(tmp_path / "e.png", series)


@pytest.mark.slow
def test_matplotlib_loads_late_and_without_its_global_state(tmp_path: Path) -> None:
    code = (
        "import sys; from warp_psdr import plots; assert 'matplotlib' not in sys.modules; "
        f"plots.loss_curve({str(tmp_path / 'l.pdf')!r}, [2.0, 1.0]); "
        "assert 'matplotlib' in sys.modules and 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], cwd=ROOT, check=True)
    assert (tmp_path / "l.pdf").read_bytes().startswith(b"%PDF")


# --- what every plot says about itself --------------------------------------------------------------------------


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list:
    """Collect the figures that are saved, without writing them."""
    drawn: list = []
    monkeypatch.setattr(plots, "_save", lambda figure, path: drawn.append(figure))
    return drawn


def bars(figure) -> list:
    return [axes for axes in figure.axes if axes.get_label() == "<colorbar>"]


def test_a_derivative_has_a_colour_bar_with_unit_and_a_size(figures: list) -> None:
    plots.derivative_image("d.png", np.linspace(-2.0, 2.0, 12).reshape(3, 4), unit=plots.RADIANCE_DERIVATIVE)
    (bar,) = bars(figures[0])
    assert plots.RADIANCE_DERIVATIVE in bar.get_ylabel() and "clip ±" in bar.get_ylabel()
    low, high = bar.get_ylim()
    assert low == -high
    assert figures[0].axes[0].get_xlabel() == "4 × 3"


def test_images_have_a_colour_bar_with_unit_and_their_sizes(figures: list) -> None:
    plots.side_by_side("s.png", [np.ones((4, 8)), np.ones((2, 2))], ["a", "b"], exposure=1.0)
    (bar,) = bars(figures[0])
    assert plots.RADIANCE in bar.get_ylabel()
    assert bar.get_ylim() == (0.0, 0.5)  # one stop more light: white is half as much
    assert [axes.get_xlabel() for axes in figures[0].axes[:2]] == ["8 × 4", "2 × 2"]


def test_differences_are_signed_on_one_symmetric_scale(figures: list) -> None:
    first, second = np.full((4, 4), 0.5), np.full((4, 4), -0.25)
    plots.side_by_side("s.png", [first], ["a"], differences={"b − a": first, "c − a": second}, percentile=100.0)
    shown = [axes.images[0] for axes in figures[0].axes[1:3]]
    assert [image.get_clim() for image in shown] == [(-0.5, 0.5)] * 2
    colors = [image.cmap(image.norm(image.get_array()))[0, 0, :3] for image in shown]
    assert is_red(tuple(255 * colors[0])) and is_blue(tuple(255 * colors[1]))
    signed, grey = bars(figures[0])
    assert "difference of radiance [W/m²/sr]" in signed.get_ylabel()
    assert plots.RADIANCE in grey.get_ylabel()


def test_derivatives_beside_an_image_have_a_quantity_of_their_own(figures: list) -> None:
    image = np.full((4, 4), 0.5)
    plots.side_by_side("s.png", [image], ["a"], differences={"b": image}, difference_quantity="d radiance / dt")
    signed, grey = bars(figures[0])
    assert signed.get_ylabel().startswith("d radiance / dt,")
    assert plots.RADIANCE in grey.get_ylabel()


def test_titles_of_narrow_pictures_do_not_overprint_each_other(figures: list) -> None:
    titles = [f"recovered, view {i} of a long fit, 38.1 dB" for i in range(8)]
    plots.side_by_side("s.png", [np.ones((30, 40))] * 8, titles, columns=8)
    figures[0].draw_without_rendering()
    boxes = [axes.title.get_window_extent() for axes in figures[0].axes[:8]]
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))
    assert max(box.y1 for box in boxes) <= figures[0].bbox.y1


def test_a_row_is_as_high_as_its_pictures(figures: list) -> None:
    plots.side_by_side("s.png", [np.ones((8, 8)), np.ones((4, 16))], ["a", "b"], columns=1)
    figures[0].draw_without_rendering()
    square, wide = (axes.get_position() for axes in figures[0].axes[:2])
    assert wide.width == pytest.approx(square.width, rel=0.05)  # neither is shrunk to fit
    gap = (square.y0 - wide.y1) * figures[0].get_figheight()
    assert gap < 1.0  # inches: title and size, no white


def test_unseen_pixels_are_hatched(figures: list) -> None:
    mask = np.zeros((4, 4), bool)
    mask[1, 2] = True
    options = {"unseen": [mask, None], "unseen_label": "hatched: hidden"}
    plots.side_by_side("s.png", [np.zeros((4, 4, 3)), np.zeros((4, 4, 3))], ["a", "b"], **options)
    hatched, plain = (axes.images[0].get_array() for axes in figures[0].axes[:2])
    size = hatched.shape[0] // 4
    tile = hatched[size : 2 * size, 2 * size : 3 * size]
    assert len(np.unique(tile)) == 2 and tile.min() > 150  # stripes of two greys
    assert hatched.sum() == tile.sum()
    assert not plain.any()
    assert figures[0].get_supxlabel() == "hatched: hidden"


def test_a_mask_has_the_shape_of_its_image() -> None:
    with pytest.raises(ValueError, match="mask"):
        plots.side_by_side("s.png", [np.zeros((4, 4))], ["a"], unseen=[np.zeros((2, 2), bool)])
    with pytest.raises(ValueError, match="mask"):
        plots.side_by_side("s.png", [np.zeros((4, 4))], ["a"], unseen=[])


@pytest.mark.parametrize("draw", ["loss_curve", "error_against_time"])
def test_curves_name_their_axes(figures: list, draw: str) -> None:
    if draw == "loss_curve":
        plots.loss_curve("l.png", [2.0, 1.0], ylabel="L2 loss [(W/m²/sr)²]")
    else:
        plots.error_against_time("e.png", {"a": ([1.0, 2.0], [0.2, 0.1])})
    axes = figures[0].axes[0]
    labels = {"loss_curve": ("step", "L2 loss [(W/m²/sr)²]"), "error_against_time": ("time [s]", "relative RMS error")}
    assert (axes.get_xlabel(), axes.get_ylabel()) == labels[draw]
