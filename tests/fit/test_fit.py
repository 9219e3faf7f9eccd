"""The main job: it finds what it should, resumes bit for bit, and says what is wrong before it starts."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import warp_psdr as psdr
from tests.fit.scenes import SKY, TEXTURE, TRUTH, write_fit
from warp_psdr import image_io, plots
from warp_psdr.fit import checkpoint, run
from warp_psdr.fit import report as fit_report
from warp_psdr.fit.run import CHECKPOINT, FitConfig, Unknown, _step, fit, views_of_step
from warp_psdr.view import viewer

ROOT = Path(__file__).resolve().parents[2]
RESULTS = [
    "checkpoint.npz",
    "gradients/wall.bsdf.reflectance.data_end.npy",
    "gradients/wall.bsdf.reflectance.data_end.png",
    "gradients/wall.bsdf.reflectance.data_start.npy",
    "gradients/wall.bsdf.reflectance.data_start.png",
    "loss.png",
    "parameters/wall.bsdf.reflectance.data.exr",
    "parameters/wall.bsdf.reflectance.data.npy",
    "parameters/wall.bsdf.reflectance.data.png",
    "start/view_0.exr",
    "start/view_0.png",
    "start/view_1.exr",
    "start/view_1.png",
    "summary.json",
    "views.png",
    "views/view_0.exr",
    "views/view_0.png",
    "views/view_1.exr",
    "views/view_1.png",
]
#: Texels that both cameras see well, after a few dozen noisy steps: learning rate at the end plus the targets' noise.
RECOVERY = 0.03


@pytest.fixture(autouse=True)
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no plots, which take longer than these fits; ``recovered``, of a wider scope, is made before this."""
    for name in ("side_by_side", "loss_curve", "derivative_image"):
        monkeypatch.setattr(plots, name, lambda *arguments, **options: None)


@pytest.fixture
def config(tmp_path: Path) -> FitConfig:
    return FitConfig.from_file(write_fit(tmp_path))


@pytest.fixture(scope="module")
def recovered(tmp_path_factory: pytest.TempPathFactory):
    """A fit that ran to its end."""
    return fit(FitConfig.from_file(write_fit(tmp_path_factory.mktemp("recovered"), iterations=80)))


@pytest.mark.slow
@pytest.mark.smoke
def test_finds_the_texture(recovered) -> None:
    assert recovered.completed
    assert recovered.losses.shape == (80,)
    assert recovered.losses[-1] < 0.15 * recovered.losses[0]  # the rest is the noise of 4 samples a pixel
    assert np.median(np.abs(recovered.parameters[TEXTURE] - TRUTH)) < RECOVERY
    assert min(recovered.psnr) > 35.0


def test_leaves_results(recovered) -> None:
    files = sorted(str(path.relative_to(recovered.output)) for path in recovered.output.rglob("*") if path.is_file())
    assert files == RESULTS
    summary = json.loads((recovered.output / "summary.json").read_text())
    assert summary["iterations"] == 80
    assert set(summary["invalid_samples"].values()) == {0} and summary["invalid_samples"] == recovered.invalid
    assert summary["loss"]["last"] == recovered.losses[-1]
    np.testing.assert_allclose(summary["psnr"], recovered.psnr, atol=1e-3)
    stored = np.load(recovered.output / "parameters" / "wall.bsdf.reflectance.data.npy")
    np.testing.assert_array_equal(stored, recovered.parameters[TEXTURE])
    np.testing.assert_array_equal(
        image_io.read_image(recovered.output / "parameters" / "wall.bsdf.reflectance.data.exr"), stored
    )
    start = np.load(recovered.output / "gradients" / "wall.bsdf.reflectance.data_start.npy")
    end = np.load(recovered.output / "gradients" / "wall.bsdf.reflectance.data_end.npy")
    assert np.abs(end).sum() < 0.3 * np.abs(start).sum()


def test_first_gradient_points_away_from_the_truth(recovered) -> None:
    start = np.load(recovered.output / "gradients" / "wall.bsdf.reflectance.data_start.npy")
    assert np.corrcoef(start.ravel(), (0.5 - TRUTH).ravel())[0, 1] > 0.7


def test_resumes_bit_for_bit(config: FitConfig) -> None:
    whole = fit(replace(config, output=config.output / "whole"))
    # Stopped between checkpoints, as by a crash, after the checkpoint of step 3 was written.
    fit(replace(config, output=config.output / "parts"), iterations=3)
    parts = fit(replace(config, output=config.output / "parts"), resume=True)
    np.testing.assert_array_equal(parts.losses, whole.losses)
    np.testing.assert_array_equal(parts.parameters[TEXTURE], whole.parameters[TEXTURE])
    for name in ("views/view_0.exr", "views/view_1.exr"):
        assert (parts.output / name).read_bytes() == (whole.output / name).read_bytes()


def test_equal_configurations_give_equal_bits_and_other_seeds_do_not(config: FitConfig) -> None:
    runs = [fit(replace(config, output=config.output / str(i), seed=i // 2), iterations=2) for i in range(3)]
    np.testing.assert_array_equal(runs[0].losses, runs[1].losses)
    assert not np.array_equal(runs[0].losses, runs[2].losses)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stop_request_ends_the_run_at_a_whole_step(config: FitConfig, number: int, monkeypatch) -> None:
    count = 0
    render = psdr.render

    def interrupted(*arguments, **options):
        nonlocal count
        count += "tape" in options
        if count == 5:  # two evaluations for the pictures at the start, then the third step
            count += 1
            os.kill(os.getpid(), number)
        return render(*arguments, **options)

    monkeypatch.setattr(psdr, "render", interrupted)
    before = signal.getsignal(number)
    stopped = fit(config)
    assert signal.getsignal(number) is before
    assert not stopped.completed
    assert len(stopped.losses) == 3
    monkeypatch.undo()
    resumed = fit(config, resume=True)
    whole = fit(replace(config, output=config.output / "whole"))
    np.testing.assert_array_equal(resumed.losses, whole.losses)
    np.testing.assert_array_equal(resumed.parameters[TEXTURE], whole.parameters[TEXTURE])


def test_killed_run_resumes_bit_for_bit(config: FitConfig) -> None:
    code = (
        "import os, signal, sys\n"
        "from warp_psdr import fit\n"
        "from warp_psdr.fit import checkpoint\n"
        "save = checkpoint.save\n"
        "def killed(path, arrays, values):\n"
        "    if len(arrays['losses']) == 6: os.kill(os.getpid(), signal.SIGKILL)\n"
        "    save(path, arrays, values)\n"
        "checkpoint.save = killed\n"
        "fit.fit(fit.FitConfig.from_file(sys.argv[1]))\n"
    )
    file = config.scene.parent / "fit.toml"
    done = subprocess.run([sys.executable, "-c", code, str(file)], cwd=ROOT, capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    assert len(checkpoint.load(config.output / CHECKPOINT)[0]["losses"]) == 3
    resumed = fit(config, resume=True)
    whole = fit(replace(config, output=config.output / "whole"))
    np.testing.assert_array_equal(resumed.losses, whole.losses)
    np.testing.assert_array_equal(resumed.parameters[TEXTURE], whole.parameters[TEXTURE])


def test_existing_checkpoint_is_not_overwritten_by_accident(config: FitConfig) -> None:
    fit(config, iterations=1)
    with pytest.raises(ValueError, match=r"checkpoint\.npz exists: resume it"):
        fit(config, iterations=1)
    assert len(fit(config, iterations=2, overwrite=True).losses) == 2


def test_a_run_that_ends_while_another_starts_keeps_its_results(config: FitConfig, monkeypatch) -> None:
    load = run.load_problem

    def loads_while_another_ends(config: FitConfig) -> run.Problem:
        config.output.mkdir()
        (config.output / CHECKPOINT).write_bytes(b"of another run")
        return load(config)

    monkeypatch.setattr(run, "load_problem", loads_while_another_ends)
    with pytest.raises(ValueError, match=r"checkpoint\.npz exists: resume it"):
        fit(config, iterations=1)
    assert (config.output / CHECKPOINT).read_bytes() == b"of another run"


def test_resume_without_checkpoint_starts_at_the_beginning(config: FitConfig) -> None:
    assert len(fit(config, iterations=1, resume=True).losses) == 1


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"spp": 5}, "spp"),
        ({"parameters": {TEXTURE: {"lr": 0.01, "initial": 0.5}}}, "lr"),
        ({"parameters": {TEXTURE: {"lr": 0.05, "initial": 0.4}}}, "initial"),
        ({"loss": "l1", "seed": 3}, "loss, seed"),
    ],
)
def test_checkpoint_of_another_run_is_refused(config: FitConfig, change: dict, field: str) -> None:
    fit(config, iterations=1)
    with pytest.raises(ValueError, match=f"belongs to another run: {field} differ"):
        fit(replace(config, **change), resume=True)


def test_checkpoint_of_other_targets_is_refused(config: FitConfig) -> None:
    fit(config, iterations=1)
    image_io.write_image(config.targets[0], np.zeros((10, 12, 3), np.float32))
    with pytest.raises(ValueError, match="belongs to another run: targets differ"):
        fit(config, resume=True)


def test_checkpoint_of_other_files_of_the_scene_is_refused(config: FitConfig) -> None:
    text = config.scene.read_text()
    texture = config.scene.parent / "other.png"
    image_io.write_image(texture, np.full((2, 2, 3), 0.5, np.float32))
    extra = '<shape type="rectangle"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
    extra += f'<string name="filename" value="{texture.name}"/></texture></bsdf></shape></scene>'
    config.scene.write_text(text.replace("</scene>", extra))
    fit(config, iterations=1)
    image_io.write_image(texture, np.full((2, 2, 3), 0.6, np.float32))
    with pytest.raises(ValueError, match="belongs to another run: values differ"):
        fit(config, resume=True)


@pytest.mark.parametrize("value", [7.0, -0.1])
def test_checkpoint_with_values_out_of_bounds_is_refused(config: FitConfig, value: float) -> None:
    fit(config, iterations=1)
    arrays, values = checkpoint.load(config.output / CHECKPOINT)
    arrays[f"parameter/{TEXTURE}"][0, 0, 0] = value
    checkpoint.save(config.output / CHECKPOINT, arrays, values)
    with pytest.raises(ValueError, match=rf"{TEXTURE}' has 1 of .* values out of range .*; start again"):
        fit(config, resume=True)


def test_finished_run_is_not_shortened(config: FitConfig) -> None:
    fit(config, iterations=2)
    with pytest.raises(ValueError, match="at most 1 iterations"):
        fit(config, iterations=1, resume=True)


def test_transparent_targets_are_refused(tmp_path: Path) -> None:
    image = np.full((4, 5, 4), 0.5, np.float32)
    image[..., 3] = 1.0
    image_io.write_image(tmp_path / "a.png", image)
    np.testing.assert_allclose(run.read_target(tmp_path / "a.png", (4, 5)), 0.5, atol=0.01)  # opaque: nothing is lost
    image[1, 2:, 3] = 0.0
    image_io.write_image(tmp_path / "a.png", image)
    with pytest.raises(ValueError, match=r"a.png: 3 pixels are transparent .* write the target without alpha"):
        run.read_target(tmp_path / "a.png", (4, 5))


def test_views_take_turns() -> None:
    config = FitConfig(
        scene="s.xml", targets=["a.exr"] * 5, output="o", parameters={"a": {"lr": 1}}, views_per_step=2, seed=4
    )
    seen = [view for step in range(50) for view in views_of_step(config, step)]
    for first in range(0, 100, 5):
        assert sorted(seen[first : first + 5]) == [0, 1, 2, 3, 4]
    assert len({tuple(seen[first : first + 5]) for first in range(0, 100, 5)}) > 5


def test_all_losses_and_several_parameters_run(config: FitConfig) -> None:
    unknowns = {TEXTURE: Unknown(lr=0.01), SKY: Unknown(lr=0.05, initial=(1.5, 1.0, 0.5))}
    for loss in ("l1", "huber", "relative_l2"):
        changed = replace(config, loss=loss, parameters=unknowns, views_per_step=None, output=config.output / loss)
        result = fit(changed, iterations=6)
        assert result.losses[-1] < result.losses[0]
        assert np.abs(result.parameters[SKY] - 1.0).max() < 0.45


def test_non_finite_loss_stops_with_the_last_checkpoint_whole(config: FitConfig, monkeypatch) -> None:
    fit(config, iterations=3)
    render = psdr.render

    def broken(*arguments, **options):
        image = render(*arguments, **options)
        if "tape" in options:
            image.fill_(float("nan"))
        return image

    monkeypatch.setattr(psdr, "render", broken)
    with pytest.raises(ValueError, match=r"loss of view \d \(target_\d\.exr\) is nan at step 4"):
        fit(config, resume=True)
    assert len(checkpoint.load(config.output / CHECKPOINT)[0]["losses"]) == 3


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"scene": Path("none.xml")}, FileNotFoundError, "fit config: scene: none.xml does not exist"),
        ({"targets": [Path("none.exr")]}, FileNotFoundError, r"fit config: targets\[0\]: none.exr does not exist"),
        ({"sensors": [0, 2]}, ValueError, "target of sensor 2, but .* has 2 sensors"),
        (
            {"parameters": {"wall.bsdf.reflectence.data": {"lr": 1}}},
            ValueError,
            "no parameter 'wall.bsdf.reflectence.data'",
        ),
        (
            {"parameters": {TEXTURE: {"lr": 1, "initial": 2}}},
            ValueError,
            r"values from 2 to 2, expected them in \[0, 1\]",
        ),
        ({"parameters": {TEXTURE: {"lr": 1, "initial": [0, 1]}}}, ValueError, "got 2 numbers, expected one or 3"),
        ({"parameters": {TEXTURE: {"lr": 1, "initial": "none.npy"}}}, FileNotFoundError, "none.npy does not exist"),
    ],
)
def test_what_does_not_fit_the_scene_is_named(config: FitConfig, change: dict, error, message: str) -> None:
    with pytest.raises(error, match=message):
        fit(replace(config, **change))
    assert not config.output.exists()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((10, 11, 3)), "got 11 x 10 pixels, expected the film's 12 x 10"),
        (np.full((10, 12, 3), np.nan), "120 pixels are NaN or infinite"),
    ],
)
def test_bad_targets_are_named(config: FitConfig, image: np.ndarray, message: str) -> None:
    image_io.write_image(config.targets[1], image.astype(np.float32))
    with pytest.raises(ValueError, match=f"target .*target_1.exr: {message}"):
        fit(config)


def test_initial_values_come_from_files(config: FitConfig) -> None:
    folder = config.scene.parent
    start = np.linspace(0, 1, TRUTH.size, dtype=np.float32).reshape(TRUTH.shape)
    np.save(folder / "start.npy", start)
    image_io.write_image(folder / "start.exr", start)
    for name in ("start.npy", "start.exr"):
        unknown = Unknown(lr=1e-6, initial=folder / name)
        result = fit(replace(config, parameters={TEXTURE: unknown}, output=config.output / name), iterations=1)
        np.testing.assert_allclose(result.parameters[TEXTURE], start, atol=2e-6)
    np.save(folder / "start.npy", start[:2])
    with pytest.raises(ValueError, match=r"start.npy has shape \(2, 4, 3\), expected \(4, 4, 3\)"):
        fit(replace(config, parameters={TEXTURE: Unknown(lr=1, initial=folder / "start.npy")}))
    (folder / "start.npy").write_bytes(b"no array")
    with pytest.raises(ValueError, match=r"start\.npy is no array of numbers"):
        fit(replace(config, parameters={TEXTURE: Unknown(lr=1, initial=folder / "start.npy")}))


def test_psnr_is_that_of_the_displayed_images() -> None:
    target = np.full((4, 4, 3), 0.5, np.float32)
    image = target + np.float32(0.1)
    expected = -20 * np.log10(abs(plots.tonemap(image) - plots.tonemap(target)).max())
    assert fit_report.psnr(image, target) == pytest.approx(expected)
    assert fit_report.psnr(target + 7, target + 9) == 120.0  # both are white on a display


def test_file_names_are_harmless_and_different() -> None:
    stems = fit_report.file_stems(["a/../b", "a_.._b", "..", "größe.value", ""])
    assert len(set(stems.values())) == len(stems)
    assert not any("/" in stem or stem.startswith(".") or not stem for stem in stems.values())


def test_pictures_that_cannot_be_drawn_are_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_opengl(*arguments, **options):
        raise RuntimeError("VTK cannot draw on this machine")

    monkeypatch.setattr(viewer, "view", no_opengl)
    params = {"wall.vertex_positions": np.zeros((4, 3)), "sky.radiance.value": np.zeros(3)}
    notes = fit_report.write_gradients(tmp_path, None, params, params, "_end")
    assert notes == ["wall.vertex_positions_end.png not drawn: VTK cannot draw on this machine"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "sky.radiance.value_end.npy",
        "wall.vertex_positions_end.npy",
    ]


@pytest.mark.parametrize(("error", "noted"), [(viewer.NotDrawableError("no look"), True), (ValueError("a bug"), False)])
def test_only_what_has_no_look_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error, noted: bool) -> None:
    def fail(*arguments, **options):
        raise error

    monkeypatch.setattr(viewer, "view", fail)
    params = {"wall.vertex_color": np.zeros((4, 3))}
    if noted:
        notes = fit_report.write_gradients(tmp_path, None, params, params)
        assert notes == ["wall.vertex_color.png not drawn: no look"]
    else:
        with pytest.raises(ValueError, match="a bug"):
            fit_report.write_gradients(tmp_path, None, params, params)


def test_a_view_that_comes_twice_in_a_step_is_drawn_anew() -> None:
    config = SimpleNamespace(targets=["a", "b", "c"], views_per_step=2, seed=0, lr_half_life=None)
    drawn: list[tuple[int, int]] = []

    def backward_all(views, _following) -> list[float]:
        drawn.extend((view, seed) for view, seed, _weight in views)
        return [1.0] * len(views)

    twice = 0
    for step in range(30):
        drawn.clear()
        _step(SimpleNamespace(config=config, backward_all=backward_all), SimpleNamespace(step=lambda scale: None), step)
        assert len(set(drawn)) == len(drawn) == 2
        twice += drawn[0][0] == drawn[1][0]
    assert twice > 0
