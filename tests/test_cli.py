"""The command line: every command leaves what it says, and every mistake is one line and status 2."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr
from tests.fit.scenes import SKY, TEXTURE, write_fit, write_scene
from warp_psdr import image_io
from warp_psdr.accuracy import Report
from warp_psdr.cli import main

ROOT = Path(__file__).resolve().parents[1]
POSITIONS = "wall.vertex_positions"
#: Between a derivative and a difference quotient of a polynomial in the radiance: float32 rounding over the step.
DIFFERENCE = 1e-3


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path)
    return "scene.xml"


@pytest.mark.smoke
def test_render_writes_what_the_library_renders(scene: str, capsys) -> None:
    Path("new").mkdir()
    assert main(["render", scene, "-o", "new/image.exr", "--spp", "8", "--seed", "3", "--sensor", "1"]) == 0
    expected = psdr.render(psdr.load_file(scene, device="cpu"), sensor=1, spp=8, seed=3).numpy()
    np.testing.assert_array_equal(image_io.read_image("new/image.exr"), expected)
    assert capsys.readouterr().out == "wrote new/image.exr\n"


def test_render_options_reach_the_renderer(scene: str) -> None:
    main(["render", scene, "-o", "one.exr", "--spp", "8", "--workers", "1", "--max-depth", "1"])
    main(["render", scene, "-o", "three.exr", "--spp", "8", "--workers", "2"])
    main(["render", scene, "-o", "again.exr", "--spp", "8", "--workers", "1"])
    psdr.set_workers(None)
    one, three, again = (image_io.read_image(f"{name}.exr") for name in ("one", "three", "again"))
    assert one.mean() < 0.5 * three.mean()  # without reflection the wall is black
    np.testing.assert_array_equal(three, again)


def test_render_fills_in_parameters_of_the_file(scene: str) -> None:
    text = Path(scene).read_text().replace('value="12"', 'value="$width"')
    Path("sized.xml").write_text(text)
    assert main(["render", "sized.xml", "-o", "image.png", "--spp", "1", "-D", "width=7"]) == 0
    assert image_io.read_image("image.png").shape == (10, 7, 3)


def test_forward_gradient_is_the_derivative(scene: str) -> None:
    # The image is linear in the sky's radiance, so its derivative along (1, 1, 1) is the image under a unit sky.
    assert main(["gradient", scene, "--param", SKY, "--spp", "64", "-o", "d"]) == 0
    derivative = image_io.read_image("d/derivative.exr")
    loaded = psdr.load_file(scene)
    image = psdr.render(loaded, spp=1024, seed=9).numpy()
    np.testing.assert_allclose(derivative.mean(), image.mean(), rtol=0.02)
    assert Path("d/derivative.png").stat().st_size > 1000


def test_forward_gradient_along_a_file(scene: str) -> None:
    np.save("tangent.npy", np.array([1.0, 0.0, 0.0], np.float32))
    assert main(["gradient", scene, "--param", SKY, "--tangent", "tangent.npy", "--spp", "16", "-o", "d"]) == 0
    derivative = image_io.read_image("d/derivative.exr")
    assert derivative[..., 0].min() > 0.0
    assert np.all(derivative[..., 1:] == 0.0)


@pytest.mark.slow
def test_forward_gradient_of_a_translation(scene: str) -> None:
    arguments = ["gradient", scene, "--param", POSITIONS, "--translate", "0", "0", "1", "--spp", "4", "-o", "d"]
    assert main([*arguments, "--boundary", "none"]) == 0
    assert np.isfinite(image_io.read_image("d/derivative.exr")).all()


def test_reverse_gradient_agrees_with_differences(scene: str, capsys) -> None:
    image_io.write_image("target.exr", np.zeros((10, 12, 3), np.float32))
    arguments = ["gradient", scene, "--param", SKY, "--param", TEXTURE, "--target", "target.exr", "--spp", "256"]
    assert main([*arguments, "-o", "g"]) == 0
    gradient = np.load(f"g/{SKY}.npy")
    # mean(image^2) is quadratic in the radiance, so that its derivative along (1, 1, 1) at a unit sky is twice itself.
    image = psdr.render(psdr.load_file(scene), spp=1024, seed=5).numpy()
    np.testing.assert_allclose(gradient.sum(), 2 * np.mean(image**2), rtol=0.02)
    assert np.load(f"g/{TEXTURE}.npy").shape == (4, 4, 3)
    assert Path(f"g/{TEXTURE}.png").exists()
    assert capsys.readouterr().out.startswith("l2 loss ")


def test_accuracy_is_printed_drawn_and_written(scene: str, capsys) -> None:
    image_io.write_image("target.exr", np.zeros((10, 12, 3), np.float32))
    arguments = ["accuracy", scene, "--param", SKY, "--param", TEXTURE, "--target", "target.exr", "--seconds", "0.2"]
    Path("new").mkdir()
    assert main([*arguments, "--target-error", "0.1", "--plot", "new/a.png", "--json", "new/a.json"]) == 0
    printed = capsys.readouterr().out
    assert "Accuracy of the gradient" in printed and SKY in printed and "relative error 0.1: " in printed
    assert Path("new/a.png").stat().st_size > 1000
    assert list(Report.load("new/a.json").norm2) == [SKY, TEXTURE]


def test_accuracy_of_the_image_and_of_its_derivative(scene: str, capsys) -> None:
    assert main(["accuracy", scene, "--seconds", "0.1"]) == 0
    assert main(["accuracy", scene, "--param", SKY, "--seconds", "0.1", "--clock", "cpu"]) == 0
    printed = capsys.readouterr().out
    assert "Accuracy of the image" in printed and "Accuracy of the derivative image" in printed
    assert main(["accuracy", scene, "--target", "target.exr"]) == 2
    assert "give a --param" in capsys.readouterr().err


def test_what_cannot_be_written_is_said_before_the_work(scene: str, capsys) -> None:
    for output, said in (("no/a.exr", "there is no folder 'no'"), ("a.gif", "suffix '.gif'"), (".", "suffix ''")):
        assert main(["render", scene, "-o", output]) == 2
        printed = capsys.readouterr().err
        assert said in printed and "render 1" not in printed
    Path("a.exr").mkdir()
    assert main(["render", scene, "-o", "a.exr"]) == 2
    assert "is a folder" in capsys.readouterr().err
    assert main(["accuracy", scene, "--target-error", "0"]) == 2
    printed = capsys.readouterr()
    assert "--target-error: got 0.0" in printed.err and not printed.out


def test_notes_on_the_scene_are_a_line_each_and_a_sensor_has_an_id(scene: str, capsys, recwarn) -> None:
    text = Path(scene).read_text().replace("<film", '<float name="shutter_open" value="1"/><film', 1)
    Path("noted.xml").write_text(text)
    name = psdr.load_file(scene).description.sensors[1].path
    assert main(["render", "noted.xml", "-o", "id.hdr", "--spp", "1", "--sensor", name]) == 0
    notes = [line for line in capsys.readouterr().err.splitlines() if line.startswith("note: ")]
    assert len(notes) == 1 and "'shutter_open' is ignored" in notes[0] and not recwarn
    assert main(["render", scene, "-o", "number.hdr", "--spp", "1", "--sensor", "1"]) == 0
    assert Path("id.hdr").read_bytes() == Path("number.hdr").read_bytes()
    assert main(["render", scene, "-o", "a.hdr", "--sensor", "nowhere"]) == 2
    assert "sensor 'nowhere': the scene has" in capsys.readouterr().err


def test_plan_names_the_parameters(scene: str, capsys) -> None:
    assert main(["plan", scene]) == 0
    printed = capsys.readouterr().out
    assert TEXTURE in printed and POSITIONS in printed


@pytest.mark.smoke
def test_plan_is_printed(scene: str, capsys) -> None:
    assert main(["plan", scene, "--param", TEXTURE, "--max-depth", "5"]) == 0
    printed = capsys.readouterr().out
    assert TEXTURE in printed
    assert "at most 5 vertices" in printed


def test_compile_says_what_it_did_and_then_that_nothing_is_left(scene: str, capsys) -> None:
    assert main(["compile", scene, "--param", TEXTURE]) == 0
    assert capsys.readouterr().out
    assert main(["compile", scene, "--param", TEXTURE]) == 0
    assert capsys.readouterr().out.startswith("all kernels were in the cache")


def test_fit_and_resume(tmp_path: Path, capsys) -> None:
    config = write_fit(tmp_path)
    assert main(["fit", str(config), "--iterations", "2"]) == 0
    assert "after 2 steps; PSNR of the views: " in capsys.readouterr().out
    assert main(["fit", str(config), "--iterations", "4"]) == 2
    assert "--resume" in capsys.readouterr().err
    assert main(["fit", str(config), "--iterations", "4", "--resume"]) == 0
    captured = capsys.readouterr()
    assert captured.out.splitlines() == [captured.out.splitlines()[0], f"results in {tmp_path / 'out'}"]
    assert captured.err.startswith("fit 3/4")


def test_view_hands_over_what_it_was_told(scene: str, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    # What is drawn is the business of tests/view/test_view.py; a machine without OpenGL draws nothing.
    from warp_psdr.view import viewer

    calls = []

    class Plotter:
        def close(self) -> None:
            calls.append("closed")

    def view(*arguments, **options):
        calls.append(options)
        return Plotter()

    monkeypatch.setattr(viewer, "view", view)
    np.save("g.npy", np.ones((4, 3), np.float32))
    Path("new").mkdir()
    arguments = ["view", scene, "--field", f"{POSITIONS}=g.npy", "--screenshot", "new/shot.png", "--sensor", "1"]
    assert main(arguments) == 0
    options, closed = calls
    assert closed == "closed"
    assert (options["camera"], options["screenshot"]) == (1, Path("new/shot.png"))
    np.testing.assert_array_equal(options["fields"][POSITIONS], np.ones((4, 3)))
    assert capsys.readouterr().out == "wrote new/shot.png\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["render", "none.xml", "-o", "a.exr"], "none.xml"),
        (["render", "scene.xml", "-o", "a.tiff"], "a.tiff: got suffix '.tiff', expected .exr or .hdr"),
        (["render", "scene.xml", "-o", "a.exr", "--sensor", "7"], "sensor 7"),
        (["render", "scene.xml", "-o", "a.exr", "--spp", "0"], "spp: got 0"),
        (["render", "scene.xml", "-o", "a.exr", "--workers", "0"], "workers: got 0"),
        (["render", "scene.xml", "-o", "a.exr", "--max-depth", "0"], "max_depth: got 0"),
        (["render", "scene.xml", "-o", "a.exr", "--device", "gpu"], "gpu"),
        (["render", "scene.xml", "-o", "a.exr", "-D", "width"], "-D: got 'width', expected NAME=VALUE"),
        (["gradient", "scene.xml", "--param", "sky.radiance", "-o", "d"], "no parameter 'sky.radiance'"),
        (["gradient", "scene.xml", "--param", SKY, "--tangent", "none.npy", "-o", "d"], "none.npy does not exist"),
        (["gradient", "scene.xml", "--param", SKY, "--target", "none.exr", "-o", "d"], "none.exr"),
        (["gradient", "scene.xml", "--param", "*", "--tangent", "t.npy", "-o", "d"], "--tangent belongs to one"),
        (["gradient", "scene.xml", "--param", SKY, "--loss", "l1", "-o", "d"], "--loss compares with an image"),
        (["accuracy", "scene.xml", "--loss", "l1"], "--loss compares with an image"),
        (["plan", "scene.xml", "--param", "nothing"], "no parameter 'nothing'"),
        (["fit", "none.toml"], "none.toml does not exist"),
        (["view", "scene.xml", "--field", "no-file"], "--field: got 'no-file'"),
        (["view", "scene.xml", "--screenshot", "a.jpg"], "got suffix '.jpg'"),
    ],
)
def test_mistakes_are_one_line(scene: str, capsys, arguments: list[str], message: str) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert captured.err.startswith("warp-psdr: error: ")
    assert message in captured.err
    psdr.set_workers(None)


def test_debug_shows_the_traceback(scene: str) -> None:
    with pytest.raises(FileNotFoundError):
        main(["render", "none.xml", "-o", "a.exr", "--debug"])


def test_interrupt_is_a_status(scene: str, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(psdr, "render", interrupted)
    assert main(["render", scene, "-o", "a.exr"]) == 130
    assert capsys.readouterr().err == "warp-psdr: interrupted\n"
    assert not Path("a.exr").exists()


def test_unexpected_errors_say_how_to_see_more(scene: str, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def broken(*arguments, **options):
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(psdr, "render", broken)
    assert main(["render", scene, "-o", "a.exr"]) == 2
    assert capsys.readouterr().err == "warp-psdr: error: oh (ZeroDivisionError; --debug shows where)\n"


@pytest.mark.smoke
def test_help_lists_every_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "warp_psdr.cli", "--help"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    for name in ("render", "gradient", "plan", "compile", "fit", "view"):
        assert f"\n    {name} " in done.stdout


def test_output_holds_results_only(scene: str, tmp_path: Path) -> None:
    # Warp's banner and its line a compiled kernel would otherwise stand between them.
    command = [sys.executable, "-m", "warp_psdr.cli", "render", str(tmp_path / scene), "-o", str(tmp_path / "a.exr")]
    done = subprocess.run([*command, "--spp", "1"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == f"wrote {tmp_path / 'a.exr'}\n"


def test_the_version_is_the_librarys(capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0 and capsys.readouterr().out == f"warp-psdr {psdr.__version__}\n"


def test_help_of_fit_names_every_key(capsys) -> None:
    with pytest.raises(SystemExit):
        main(["fit", "--help"])
    text = capsys.readouterr().out
    assert "FitConfig" not in text
    for field in dataclasses.fields(psdr.fit.FitConfig):
        assert re.search(rf"^ +(\[|.*, )?{field.name}\b", text, re.MULTILINE), field.name
    for field in dataclasses.fields(psdr.fit.Unknown):
        assert re.search(rf"^    {field.name} ", text, re.MULTILINE), field.name
