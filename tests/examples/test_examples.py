"""The examples run, at sizes that take moments, and leave pictures that show something."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from warp_psdr import image_io
from warp_psdr.fit.run import FitConfig, fit

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
#: A square that stands on the floor where the bunny sits.
SQUARE = np.float32([[-0.6, 0.03, 0.0], [0.6, 0.03, 0.0], [0.6, 1.4, 0.0], [-0.6, 1.4, 0.0]])
SQUARE_UVS = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]])
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
#: Mean radiance of 24 x 18 pixels with 64 samples each: several times its standard deviation.
NOISE_OF_THE_MEAN = 0.02


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch):
    """Import an example by its name."""
    monkeypatch.syspath_prepend(str(EXAMPLES))

    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture
def data(example, tmp_path: Path) -> ModuleType:
    """``bunny_data`` at small sizes, with its files in ``tmp_path`` and a square in the bunny's place."""
    module = example("bunny_data")
    module.PAINTED, module.RECOVERED, module.ENVIRONMENT = 16, 8, (4, 8)
    module.read_bunny = lambda: (SQUARE, SQUARE_FACES)
    module.unwrap = lambda vertices, faces: (np.arange(4), faces, SQUARE_UVS)
    scene = (ROOT / "scenes" / module.SCENE).read_text()
    for name, size in (("width", 24), ("height", 18)):
        start = scene.index(f'<default name="{name}" value="') + len(f'<default name="{name}" value="')
        scene = scene[:start] + str(size) + scene[scene.index('"', start) :]
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / module.SCENE).write_text(scene)
    module.ROOT, module.FOLDER = tmp_path, tmp_path / "data"
    module.write_data(module.FOLDER, spp=32)
    return module


def contrast(path: Path) -> float:
    """Standard deviation of a picture's values, in [0, 1]."""
    return float(image_io.read_image(path, raw=True).std())


@pytest.mark.slow
def test_render_scene(example, tmp_path: Path) -> None:
    example("render_scene").main(tmp_path, resolution=16, spp=4)
    assert contrast(tmp_path / "cornell_box.png") > 0.1
    assert image_io.read_image(tmp_path / "cornell_box.exr").max() > 1.0  # the light, brighter than a PNG can hold


@pytest.mark.slow
def test_estimator_zoo(example, tmp_path: Path) -> None:
    tables = example("estimator_zoo").main(tmp_path, resolution=16, depth=2, seconds=0.2)
    zoo = example("estimator_zoo")
    for name, rows in tables.items():
        term = zoo.TARGETS[name][0]
        assert len(rows) == sum(m.term == term for m in psdr.methods()) + len(zoo.CHOICES[name])
        assert all(row["error"] < 3.0 for row in rows if "error" in row) and "error" in rows[0]
        assert contrast(tmp_path / f"zoo_{name}.png") > 0.05
    assert contrast(tmp_path / "zoo_highlight.png") > 0.05 and contrast(tmp_path / "zoo_time.png") > 0.05


@pytest.mark.slow
def test_transient_room(example, tmp_path: Path) -> None:
    example("transient_room").main(tmp_path, resolution=12, spp=16)
    assert contrast(tmp_path / "transient.png") > 0.1


@pytest.mark.slow
def test_derivative_images(example, tmp_path: Path) -> None:
    example("derivative_images").main(tmp_path, resolution=16, spp=16)
    derivatives = {}
    for stem in ("wall", "light", "trade"):
        derivatives[stem] = image_io.read_image(tmp_path / f"derivative_{stem}.exr")
        assert contrast(tmp_path / f"derivative_{stem}.png") > 0.01
    # The red wall reflects no more green when it gets redder, and nothing grows darker.
    assert np.abs(derivatives["wall"][..., 1:]).max() == 0.0
    assert derivatives["wall"][..., 0].min() >= 0.0 < derivatives["wall"][..., 0].max()
    assert derivatives["light"].min() >= 0.0 < derivatives["light"].max()
    assert derivatives["trade"].min() < 0.0 < derivatives["trade"].max()


def test_print_plan(example, capsys: pytest.CaptureFixture) -> None:
    example("print_plan").main()
    printed = capsys.readouterr().out
    assert printed.count("depth") >= 3
    assert "differentiated" in printed.split("gradient of red.reflectance.value:")[1]
    assert "differentiated" not in printed.split("gradient of red.reflectance.value:")[0]


@pytest.mark.slow
def test_torch_wall_color(example, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    error = example("torch_wall_color").main(tmp_path, resolution=12, steps=40, spp=8)
    assert error < 0.15  # from 0.46 at the start
    assert contrast(tmp_path / "torch_wall_color.png") > 0.1


@pytest.mark.slow
def test_material_and_sky_are_recovered(example, tmp_path: Path) -> None:
    module = example("recover_material")
    module.PHOTO_SPP = 64
    report = module.main(tmp_path, resolution=16, steps=64, spp=4)
    start, found = (report[f"psnr of the kept views{at}, dB"] for at in (" at the start", ""))
    assert min(np.subtract(found, start)) > 4.0
    for name in ("result", "textures", "loss"):
        assert contrast(tmp_path / f"{name}.png") > 0.05


@pytest.mark.slow
def test_smoke_is_recovered_from_nothing(example, tmp_path: Path) -> None:
    module = example("recover_smoke")
    module.PHOTO_SPP = 64
    report = module.main(tmp_path, voxels=16, resolution=16, steps=(32, 32))
    start, found = (report[f"psnr of the kept views{at}, dB"] for at in (" at the start", ""))
    assert min(np.subtract(found, start)) > 6.0
    assert report["largest derivative by a voxel at density 0"] > 1e-5
    for name in ("result", "slices", "loss"):
        assert contrast(tmp_path / f"{name}.png") > 0.05


@pytest.mark.slow
def test_the_hole_of_a_link_opens(example, tmp_path: Path) -> None:
    module = example("recover_genus")
    module.PHOTO_SPP = 64
    report = module.main(tmp_path, resolution=48, spp=4)
    start, found, sought = report["Euler number: start, recovered, sought"]
    assert start >= 40 and found == sought == 0
    before, after = (report[f"psnr of the kept views{at}, dB"] for at in (" at the start", ""))
    assert min(np.subtract(after, before)) > 15.0
    assert report["mean distance of the surfaces in voxels"] < 0.5
    for name in ("result", "steps", "loss"):
        assert contrast(tmp_path / f"{name}.png") > 0.05


@pytest.mark.slow
def test_a_lens_draws_a_heart(example, tmp_path: Path) -> None:
    report = example("caustic_design").main(tmp_path, steps=60, count=25, width=32, spp=16)
    assert report["psnr of the lens, dB"] > report["psnr of the flat slab, dB"] + 3.0
    for name in ("result", "lens", "loss"):
        assert contrast(tmp_path / f"{name}.png") > 0.02


@pytest.mark.slow
def test_fibres_find_their_places(example, tmp_path: Path) -> None:
    module = example("fit_fibres")
    module.PHOTO_SPP = 16
    report = module.main(tmp_path, stages=module.QUICK, spp=2)
    for what in ("control points, mean distance in widths", "axes, mean distance in widths"):
        start, found = report[f"{what}: start, found"]
        assert found < 0.75 * start
    start, found = report["radii, mean error in percent: start, found"]
    assert found < start
    assert report["fibres that the first gradient moves towards what is sought, percent"] > 65.0
    before, after = (report[f"psnr of the kept views{at}, dB"] for at in (" at the start", ""))
    assert min(np.subtract(after, before)) > 1.0
    for name in ("result", "loss", "error"):
        assert contrast(tmp_path / f"{name}.png") > 0.05


def test_fibres_are_pushed_apart(example) -> None:
    module = example("fit_fibres")
    points = module.sought()
    np.testing.assert_array_equal(module.apart(points), points)  # none run through each other
    crossed = points.copy()
    crossed[0] = points[1] + [0.3 * module.WIDTH, 0.0, 0.0, 0.0]
    after = module.apart(crossed)
    moved = np.abs(after - crossed).max(axis=(1, 2)) > 0.0
    assert moved[:2].all() and not moved[100:].any()
    np.testing.assert_array_equal(after[..., 3], crossed[..., 3])
    axes = np.einsum("mk,fkc->fmc", module.weights(), after)[:2]
    distance = np.linalg.norm(axes[0, :, None, :3] - axes[1, None, :, :3], axis=2)
    assert (distance > 1.05 * (axes[0, :, None, 3] + axes[1, None, :, 3])).all()


@pytest.mark.slow
def test_a_ball_has_one_derivative_however_it_is_held(example, tmp_path: Path) -> None:
    module = example("implicit_gradients")
    slopes = module.main(tmp_path, resolution=16, spp=64, difference_spp=256, only=("linear grid", "exact sphere"))
    assert len(slopes) == 2
    for value, error in slopes.values():
        assert error < 0.1 and abs(value - 1.0) < 4.0 * error
    assert contrast(tmp_path / "implicit_gradients.png") > 0.05


def test_a_baked_texture_shows_the_surface(example) -> None:
    module = example("bunny_data")
    texture = module.bake(SQUARE, SQUARE_UVS, SQUARE_FACES, 8, lambda points: points)
    centers = (np.arange(8) + 0.5) / 8
    # Texture coordinate v runs down the square, as rows do; the points of the nearest texel are a grid of 1/7.
    np.testing.assert_allclose(texture[3, :, 0], 1.2 * centers - 0.6, atol=1.2 / 14 + 1e-6)
    np.testing.assert_allclose(texture[:, 3, 1], 1.4 - 1.37 * centers, atol=1.37 / 14 + 1e-6)


def test_the_bunny_comes_with_the_warp_wheel(example) -> None:
    vertices, faces = example("bunny_data").read_bunny()
    assert faces.shape == (12200, 3)
    assert faces.max() == len(vertices) - 1
    assert np.ptp(vertices, axis=0).max() == pytest.approx(1.619, abs=0.01)


def test_charts_keep_the_triangles(example) -> None:
    pytest.importorskip("xatlas")
    ball = trimesh.creation.icosphere(subdivisions=2)
    source, faces, uvs = example("bunny_data").unwrap(ball.vertices.astype(np.float32), ball.faces.astype(np.uint32))
    np.testing.assert_array_equal(np.sort(source[faces], axis=1), np.sort(ball.faces, axis=1))
    assert 0.0 <= uvs.min() < uvs.max() <= 1.0


def test_bunny_scene_fits_its_data(data: ModuleType) -> None:
    scene = psdr.load_file(data.FOLDER / data.SCENE)
    assert len(scene.description.sensors) == len(data.GIVEN) + len(data.KEPT)
    np.testing.assert_allclose(scene.description.shapes[0].vertices, SQUARE)
    photo = image_io.read_image(data.FOLDER / "view_3.exr")
    assert photo.shape == (18, 24, 3)
    new = data.photographs(data.FOLDER, (3,), spp=32, seed=1)[3]
    assert not np.array_equal(new, photo)  # other seeds, other noise
    assert new.mean() == pytest.approx(photo.mean(), rel=3 * NOISE_OF_THE_MEAN)


@pytest.mark.slow
def test_bunny_configuration_recovers_views(data: ModuleType) -> None:
    config = FitConfig.from_file(EXAMPLES / "bunny.toml")
    assert len(config.targets) == len(data.GIVEN)
    config = replace(
        config,
        scene=data.FOLDER / data.SCENE,
        targets=tuple(data.FOLDER / f"view_{i}.exr" for i in data.GIVEN[:2]),
        output=data.FOLDER / "fit",
        iterations=40,
        final_spp=32,
    )
    result = fit(config)
    assert result.losses[-5:].mean() < 0.1 * result.losses[0]
    truth = data.photographs(data.FOLDER, (0, 1), spp=64, seed=99)
    start = psdr.load_file(config.scene)
    for i in (0, 1):
        found = image_io.read_image(config.output / "views" / f"view_{i}.exr")
        before = psdr.render(start, sensor=i, spp=32).numpy()
        error, was = (
            np.mean((psdr.plots.tonemap(image) - psdr.plots.tonemap(truth[i])) ** 2) for image in (found, before)
        )
        assert error < 0.1 * was


def test_bunny_scene_is_one_for_mitsuba(data: ModuleType) -> None:
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    names = {"albedo": "albedo_truth.exr", "environment": "environment_truth.exr"}
    scene = mitsuba.load_file(str(data.FOLDER / data.SCENE), **names)
    expected = np.array(mitsuba.render(scene, sensor=0, spp=64))
    image = data.photographs(data.FOLDER, (0,), spp=64, seed=7)[0]
    np.testing.assert_allclose(image.mean((0, 1)), expected.mean((0, 1)), rtol=NOISE_OF_THE_MEAN)
