"""The examples that recover shapes and poses: smaller than they are run by hand, but with real progress."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from warp_psdr import image_io

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
#: Relative difference of a volume and its piecewise flat copy with edges a sixth of its size.
FLATNESS = 0.02


def lump(subdivisions: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """A smooth body without any symmetry, of about the bunny's size and place."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    x, y, z = np.asarray(ball.vertices).T
    radius = 0.5 + 0.35 * np.exp(-4.0 * ((x - 0.8) ** 2 + (y - 0.6) ** 2)) + 0.15 * np.exp(-4.0 * (z - 1.0) ** 2)
    points = radius[:, None] * np.stack([1.2 * x, y, 0.8 * z], axis=1) + [-0.1, 0.7, 0.0]
    return points.astype(np.float32), np.asarray(ball.faces)


def horned() -> tuple[np.ndarray, np.ndarray]:
    """A body with three horns of different lengths: its shadow tells how it is turned."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    d = np.asarray(ball.vertices)
    radius = np.full(len(d), 0.4)
    for horn, length in (((0.9, 0.4, 0.1), 0.7), ((-0.5, 0.8, 0.3), 0.5), ((-0.3, -0.2, 0.9), 0.35)):
        radius += length * np.exp(10.0 * (d @ (horn / np.linalg.norm(horn)) - 1.0))
    return (radius[:, None] * d).astype(np.float32), np.asarray(ball.faces)


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch):
    """Import an example by its name, with a lump for a bunny."""
    monkeypatch.syspath_prepend(str(EXAMPLES))

    def load(name: str):
        for module in (name, "bunny_data", "remesh", "shape_pictures"):
            monkeypatch.delitem(sys.modules, module, raising=False)
        import importlib

        module = importlib.import_module(name)
        if hasattr(module, "bunny_data"):
            monkeypatch.setattr(module.bunny_data, "read_bunny", lump)
        return module

    return load


def contrast(path: Path) -> float:
    return float(image_io.read_image(path, raw=True).std())


@pytest.mark.slow
def test_shape_gets_closer(example, tmp_path: Path) -> None:
    module = example("recover_shape")
    module.PHOTO_SPP, module.shape_pictures.PICTURE, module.shape_pictures.FRAME = 32, 16, 16
    stages = (module.Stage(10, 0.04, 1.0, 0.2), module.Stage(6, 0.02, 2.0, 0.15))
    report = module.main(tmp_path, stages=stages, width=20, spp=4)
    assert report["ratio"] > 2.0


@pytest.mark.slow
def test_shape_is_recovered(example, tmp_path: Path) -> None:
    module = example("recover_shape")
    module.PHOTO_SPP, module.shape_pictures.PICTURE, module.shape_pictures.FRAME = 64, 32, 32
    report = module.main(tmp_path, stages=module.QUICK, width=32, spp=4)
    assert report["ratio"] > 5.0
    assert report["vertices"] > 300
    assert json.loads((tmp_path / "report.json").read_text()) == report
    for name in ("result", "loss", "distance"):
        assert contrast(tmp_path / f"{name}.png") > 0.05
    from PIL import Image

    with Image.open(tmp_path / "animation.gif") as animation:
        assert animation.n_frames == 1 + report["steps"] // module.FRAME_EVERY
    assert trimesh.load(tmp_path / "recovered.ply", process=False).vertices.shape == (report["vertices"], 3)


@pytest.mark.slow
def test_pose_is_found_from_the_shadow(example, tmp_path: Path) -> None:
    module = example("pose_from_shadow")
    module.bunny_data.read_bunny = horned
    report = module.main(tmp_path, width=48, steps=110, spp=8)
    degrees = report["rotation error, degrees: start, found"]
    units = report["translation error, units: start, found"]
    assert degrees[1] < degrees[0] / 5.0
    assert units[1] < units[0] / 5.0
    # The camera sees nothing but the floor: painting the body changes no pixel.
    params = module.load(*horned(), 48)
    images = []
    params[module.POSITIONS] = 0.5 * horned()[0] + module.TRUTH[1]
    params.update()
    for albedo in (0.0, 1.0):
        params["bunny.bsdf.reflectance.value"] = albedo
        params.update()
        images.append(psdr.render(params.scene, integrator=psdr.PathIntegrator(max_depth=2), spp=4).numpy())
    np.testing.assert_array_equal(*images)
    assert contrast(tmp_path / "result.png") > 0.05


@pytest.mark.slow
def test_throw_is_found_from_the_shadow(example, tmp_path: Path) -> None:
    module = example("throw_from_shadow")
    report = module.main(tmp_path, width=32, frames=8, steps=25, spp=8)
    assert report["error"] < 0.05 < np.linalg.norm(module.START - module.TRUTH) / np.linalg.norm(module.TRUTH) / 4.0
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert contrast(tmp_path / "result.png") > 0.05
    from PIL import Image

    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 8 and film.size == (256, 128)
    # The camera sees nothing but the floor: painting the ball changes no pixel.
    flight, films = module.Flight(module.load(32), 8), []
    for albedo in (0.0, 1.0):
        flight.params["ball.bsdf.reflectance.value"] = albedo
        films.append(np.stack([image.numpy() for image in flight.film(1, 4)]))
    np.testing.assert_array_equal(*films)


@pytest.mark.slow
def test_cloth_is_found_from_its_film(example, tmp_path: Path) -> None:
    pytest.importorskip("newton")
    module = example("cloth_stiffness")
    report = module.main(tmp_path, width=32, frames=8, steps=40, spp=8)
    assert max(report["errors"].values()) < 0.1 < np.abs(module.START / module.TRUTH - 1.0).min() / 3.0
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert contrast(tmp_path / "result.png") > 0.05
    from PIL import Image

    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 8 and film.size == (256, 128)


@pytest.mark.slow
def test_swing_is_found_through_the_glass(example, tmp_path: Path) -> None:
    module = example("pour_and_look")
    report = module.main(tmp_path, width=32, frames=12, steps=30, spp=64)
    assert max(report["errors"].values()) < 0.1 < np.abs(module.START / module.TRUTH - 1.0).min()
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert contrast(tmp_path / "result.png") > 0.05
    from PIL import Image

    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 12 and film.size == (256, 128)


@pytest.mark.slow
def test_only_the_glass_shows_the_swing(example) -> None:
    module = example("pour_and_look")
    swing, seen = module.Swing(module.load(32), 6), []
    for albedo in (0.0, 1.0):  # what changes beside the glass is light that the bob sends to table and wall
        swing.params["bob.bsdf.reflectance.value"] = albedo
        seen.append(np.stack([image.numpy() for image in swing.film(1, 64)]))
    change = np.abs(seen[1] - seen[0]).sum(axis=(0, 3))
    glass = slice(5, 27)  # columns
    assert change[:, glass].sum() > 0.95 * change.sum()


@pytest.mark.slow
def test_arm_and_camera_are_found(example, tmp_path: Path) -> None:
    pytest.importorskip("newton")
    report = example("robot_pose").main(tmp_path, width=48, steps=90, spp=16)
    for name in ("worst joint, degrees", "camera's turn, degrees", "its shift, cm"):
        start, found = report[f"{name}: start, found"]
        assert found < start / 5.0
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert contrast(tmp_path / "result.png") > 0.05


@pytest.mark.slow
def test_pose_and_fog_are_found_from_the_shadow(example, tmp_path: Path) -> None:
    module = example("see_through_fog")
    report = module.main(tmp_path, width=24, steps=220, spp=16)
    degrees = report["rotation error, degrees: start, found"]
    units = report["translation error, units: start, found"]
    assert degrees[1] < degrees[0] / 4.0
    assert units[1] < units[0] / 6.0
    sought, start, found = report["density: sought, start, found"]
    assert abs(found - sought) < 0.1 * abs(start - sought)
    # Neither camera sees anything of the plate: painting it changes no pixel.
    params = module.load(*module.plate(), 24)
    params[module.POSITIONS] = module.plate()[0] + module.START[1]
    images = []
    for albedo in (0.0, 1.0):
        params["plate.bsdf.reflectance.value"] = albedo
        params.update()
        images.append(psdr.render(params.scene, integrator=module.INTEGRATOR, spp=4).numpy())
    np.testing.assert_array_equal(*images)
    for name in ("result", "derivatives", "error"):
        assert contrast(tmp_path / f"{name}.png") > 0.05


@pytest.mark.slow
def test_a_users_kernel_and_the_rendering_share_a_tape(example) -> None:
    # What the library launches itself, such as the refit of the ray structure, stays off the tape.
    import warp as wp

    module = example("pose_from_shadow")
    params = module.load(*lump(1), 16)
    points = wp.array(lump(1)[0], dtype=wp.vec3, device="cpu")
    rotation, translation = (wp.zeros(1, dtype=wp.vec3, device="cpu", requires_grad=True) for _ in range(2))
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 4}
    target = np.zeros((10, 16, 3), np.float32)
    tape = wp.Tape()
    with tape:
        loss = psdr.losses.l2(psdr.render(params.scene, params, tape=tape, **options), target)
    tape.backward(loss)
    gradient = params[module.POSITIONS].grad.numpy().copy()
    params.zero_grad()
    tape = wp.Tape()
    with tape:
        outputs = [params[module.POSITIONS]]
        wp.launch(module.recovery.place, len(points), [points, rotation, translation], outputs, device="cpu")
        params.update(module.POSITIONS)
        assert len(tape.launches) == 1
        loss = psdr.losses.l2(psdr.render(params.scene, params, tape=tape, **options), target)
    tape.backward(loss)
    np.testing.assert_allclose(translation.grad.numpy()[0], gradient.sum(axis=0), rtol=1e-4, atol=1e-7)
    turning = np.cross(points.numpy(), gradient).sum(axis=0)
    np.testing.assert_allclose(rotation.grad.numpy()[0], turning, rtol=1e-4, atol=1e-7)
    assert np.abs(turning).max() > 0.0


@pytest.mark.slow
def test_camera_is_found(example, tmp_path: Path) -> None:
    report = example("camera_pose").main(tmp_path, resolution=32, steps=80, spp=8)
    degrees = report["rotation error, degrees: start, found"]
    units = report["translation error, units: start, found"]
    assert degrees[1] < degrees[0] / 4.0
    assert units[1] < units[0] / 4.0
    assert contrast(tmp_path / "result.png") > 0.05


def test_generators_are_the_derivatives_of_rigid_motions(example) -> None:
    module = example("camera_pose")
    for generator, direction in zip(module.generators(), np.eye(6), strict=True):
        difference = (module.rigid(1e-5 * direction) - module.rigid(-1e-5 * direction)) / 2e-5
        np.testing.assert_allclose(generator, difference, atol=1e-8)


def test_remeshing_keeps_the_surface(example) -> None:
    module = example("remesh")
    vertices, faces = lump(3)
    before = trimesh.Trimesh(vertices, faces, process=False)
    after = trimesh.Trimesh(*module.remesh(vertices.astype(np.float64), faces, 0.12), process=False)
    assert after.is_watertight and after.is_winding_consistent
    assert after.volume == pytest.approx(before.volume, rel=FLATNESS)
    assert after.edges_unique_length.max() < 2.0 * 0.12
    assert after.edges_unique_length.min() > 0.3 * 0.12
    same = (vertices.astype(np.float64), faces)
    assert module.surface_distance(same, same) < 1e-6
    moved = (vertices.astype(np.float64) * 1.1, faces)
    assert module.surface_distance(same, moved) == pytest.approx(0.07, abs=0.03)


def test_remeshing_leaves_the_outer_hull(example) -> None:
    module = example("remesh")
    box = trimesh.creation.box()
    vertices = np.concatenate([box.vertices, box.vertices + np.array([0.53, 0.31, 0.27])])
    faces = np.concatenate([box.faces, box.faces + len(box.vertices)])
    after = trimesh.Trimesh(*module.remesh(vertices, faces, 0.07), process=False)
    assert after.is_watertight
    expected = 2.0 - 0.47 * 0.69 * 0.73
    assert after.volume == pytest.approx(expected, rel=2 * FLATNESS)
