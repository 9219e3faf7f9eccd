"""Grids of signed distances: what loads, what is refused, and how they follow edits."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.rays.test_sdfgrid_cubic import spline
from tests.scene.test_volumes import header
from warp_psdr.options import boundary, interior
from warp_psdr.scene.kinds.sdfgrid import reaches

T = psdr.Transform
AT = np.linspace(0.0, 1.0, 6)
Z, Y, X = np.meshgrid(AT, AT, AT, indexing="ij")
BALL = (np.sqrt((X - 0.5) ** 2 + (Y - 0.5) ** 2 + (Z - 0.5) ** 2) - 0.4).astype(np.float32)
FLAT = np.diag([1.0, 1.0, 0.0, 1.0])
TILES = {"type": "bitmap", "bitmap": np.ones((2, 2, 3))}


def described(**properties) -> dict:
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "to_world": T.look_at([0.5, -3, 0.5], [0.5, 0, 0.5], [0, 0, 1]), "film": film}
    body = {"type": "sdfgrid", **({} if "filename" in properties else {"grid": BALL}), **properties}
    path = {"type": "path", "max_depth": 1}  # what is seen before the sky; other tests compile what it scatters
    return {"type": "scene", "integrator": path, "sensor": sensor, "sky": {"type": "constant"}, "body": body}


def spoiled(value: float) -> np.ndarray:
    values = BALL.copy()
    values[1, 2, 3] = value
    return values


@pytest.mark.parametrize(
    ("properties", "problem"),
    [
        ({"grid": BALL[0]}, r"got the shape \(6, 6\).*give numbers \(Z, Y, X\)"),
        ({"grid": BALL[:1]}, "2 or more nodes along each axis"),
        ({"grid": np.stack([BALL, BALL], axis=-1)}, r"got the shape \(6, 6, 6, 2\)"),
        ({"grid": "ball"}, "no array of numbers"),
        ({"grid": spoiled(np.nan)}, "1 of 216 values are not finite"),
        ({"grid": spoiled(np.inf)}, "1 of 216 values are not finite"),
        ({"normals": "flat"}, "got 'flat'.*give one of: smooth, analytic"),
        ({"face_normals": True}, "'normals': 'analytic'"),
        ({"interpolation": "cubical"}, "got 'cubical'.*give one of: linear, cubic"),
        ({"interpolation": "cubic", "normals": "smooth"}, "'smooth' normals on a cubic 'sdfgrid'.*leave out 'normals'"),
        ({"to_world": FLAT}, "singular|no inverse"),
        ({"filename": "ball.vol", "grid": BALL}, "got filename and grid"),
        ({"emitter": {"type": "area"}}, "an emitter on a 'sdfgrid'.*'mesh'"),
        ({"sensor": {"type": "irradiancemeter"}}, "a sensor on a 'sdfgrid'"),
        ({"interior": {"type": "homogeneous"}, "bsdf": {"type": "null"}}, "a medium on a 'sdfgrid'"),
        ({"bsdf": {"type": "diffuse", "reflectance": TILES}}, "'bitmap' for 'reflectance'.*no texture coordinates"),
        ({"bsdf": {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.2}}, "two roughnesses"),
        (
            {"bsdf": {"type": "normalmap", "normalmap": TILES, "a": {"type": "diffuse"}}},
            "no texture coordinates",
        ),
    ],
)
def test_what_it_does_not_do_is_refused(properties: dict, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        psdr.load_dict(described(**properties))


def test_values_are_needed() -> None:
    nothing = described()
    del nothing["body"]["grid"]
    with pytest.raises(ValueError, match="there are no values; give one of 'filename'"):
        psdr.load_dict(nothing)


def instanced(pose: psdr.Transform, **more) -> dict:
    """Return the scene with the grid in a group, which ``copy`` is an instance of."""
    whole = described()
    whole["group"] = {"type": "shapegroup", "body": {**whole.pop("body"), **more.pop("body", {})}, **more}
    return whole | {"copy": {"type": "instance", "to_world": pose, "group": {"type": "ref", "id": "group"}}}


def test_an_instance_has_the_bits_and_the_parameters_of_a_grid_there() -> None:
    poses = T.translate([0.1, 0.0, 0.2]) @ T.rotate([1, 2, 3], 40.0), T.scale([0.8, 1.2, 1.0])
    held = psdr.load_dict(instanced(poses[0]))
    params = psdr.traverse(held)
    assert {"group.body.grid", "copy.to_world", "group.body.bsdf.reflectance.value"} <= set(params)
    images = [psdr.render(held, spp=4).numpy()]
    params["copy.to_world"] = poses[1].matrix
    params.update()
    images.append(psdr.render(held, spp=4).numpy())
    for pose, image in zip(poses, images, strict=True):
        np.testing.assert_array_equal(image, psdr.render(psdr.load_dict(described(to_world=pose)), spp=4).numpy())
    assert not np.array_equal(*images)


@pytest.mark.parametrize(
    ("whole", "problem"),
    [
        (instanced(T(), body={"to_world": T.scale(2.0)}), "a pose of a 'sdfgrid' inside a 'shapegroup'.*'instance'"),
        (instanced(T(), cube={"type": "cube"}), "beside other shapes of a 'shapegroup'; give it a group of its own"),
        (instanced(T(FLAT)), "scene.'copy'.*singular"),
        (
            instanced(T()) | {"again": {"type": "instance", "group": {"type": "ref", "id": "group"}}},
            "scene.'again'.*a second 'instance' of a 'sdfgrid'",
        ),
    ],
    ids=["its own pose", "beside others", "flat", "two"],
)
def test_what_groups_of_it_do_not_do_is_refused(whole: dict, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        psdr.load_dict(whole)


@pytest.mark.parametrize(("sign", "missing"), [(1.0, "negative"), (-1.0, "positive")])
def test_one_sign_is_empty_and_noted(sign: float, missing: str) -> None:
    with pytest.warns(psdr.SceneWarning, match=f"no value is {missing}, so the shape is empty"):
        held = psdr.load_dict(described(grid=sign * (np.abs(BALL) + 0.1)))
    assert psdr.render(held, spp=4).numpy() == pytest.approx(1.0)


def test_parameters_files_and_updates(tmp_path) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    mi.VolumeGrid(BALL[..., None]).write(str(tmp_path / "ball.vol"))
    held = psdr.load_dict(described(filename=str(tmp_path / "ball.vol")))
    params = psdr.traverse(held)
    assert params["body.grid"].shape == (6, 6, 6, 1) and "body.to_world" in params
    np.testing.assert_array_equal(params["body.grid"].numpy()[..., 0], BALL)
    with pytest.raises(KeyError, match=r"its parameters are 'body.grid' and 'body.to_world'"):
        params["body.vertex_positions"]
    said = str(psdr.plan(held))
    assert "distance grids" in said and "6 x 6 x 6" in said

    def image() -> np.ndarray:
        return psdr.render(held, spp=16, seed=3).numpy()

    # A new grid, and a new pose, render as if they had been loaded.
    for name, value in (("grid", BALL + 0.15), ("to_world", T.translate([0.3, 0.0, 0.0]).scale(0.7).matrix)):
        before = image()
        params[f"body.{name}"] = value[..., None] if name == "grid" else value
        params.update()
        fresh = psdr.load_dict(described(grid=BALL + 0.15, **({name: value} if name == "to_world" else {})))
        assert (image() != before).any()
        np.testing.assert_allclose(image(), psdr.render(fresh, spp=16, seed=3).numpy(), atol=1e-5)
    params["body.grid"].assign(spoiled(np.nan)[..., None])
    with pytest.raises(ValueError, match=r"body.grid is nan in 1 of 216 places after an edit; write finite values"):
        params.update()


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (header(size=(6, 6, 6), channels=2) + np.ones(432, "<f4").tobytes(), r"\(6, 6, 6, 2\)"),
        (header(size=(6, 6, 6)) + BALL.tobytes()[:-4], "has 908 bytes, and 6 x 6 x 6 voxels"),
        (header(size=(1000, 1000, 1000)), "declares 1000 x 1000 x 1000 voxels.*at most"),
        (header(size=(6, 6, 6)) + spoiled(np.nan).tobytes(), "NaN|not finite"),
        (header(size=(6, 6, 1)) + BALL[:1].tobytes(), "2 or more nodes along each axis"),
        (b"VOX", "is no .vol file"),
    ],
)
def test_files_that_hold_no_grid_are_refused(content: bytes, problem: str, tmp_path) -> None:
    file = tmp_path / "grid.vol"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=problem):
        psdr.load_dict(described(filename=str(file)))


def test_reaches_are_chessboard_distances() -> None:
    found = reaches(BALL[..., None])
    passed = np.argwhere(found == 0.0)
    for cell in np.ndindex(found.shape):
        assert found[cell] == np.abs(passed - cell).max(axis=1).min()
    corners = [(BALL[o : o + 5, p : p + 5, q : q + 5] < 0.0) for o, p, q in np.ndindex(2, 2, 2)]
    np.testing.assert_array_equal(found == 0.0, np.any(corners, axis=0) & ~np.all(corners, axis=0))


def test_reaches_of_a_spline_are_those_of_its_coefficients() -> None:
    found = reaches(BALL[..., None], True)
    rng = np.random.default_rng(0)
    linear = reaches(BALL[..., None])
    # As many voxels and a few more; and in the others the sign is that of the middle.
    assert (linear == 0.0).sum() <= (found == 0.0).sum() <= 1.5 * (linear == 0.0).sum()
    for k, j, i in np.argwhere(found > 0.0):
        p = (np.array([i, j, k]) + rng.random((50, 3))) / 5.0
        assert len(np.unique(spline(BALL.astype(np.float64), p) < 0.0)) == 1


@pytest.mark.slow
def test_a_spline_that_smooths_its_surface_away_is_noted() -> None:
    lone = np.ones((6, 6, 6), np.float32)
    lone[3, 3, 3] = -1.0
    with pytest.warns(psdr.SceneWarning, match="smooths away what differs in sign"):
        held = psdr.load_dict(described(grid=lone, interpolation="cubic"))
    assert psdr.render(held, spp=4).numpy() == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["body.grid", "body.to_world", "sensor.to_world", "wall.vertex_positions"])
def test_what_moves_has_no_boundary_term_with_smooth_normals_in_mirrors(name: str) -> None:
    whole = described()
    whole["wall"] = {"type": "rectangle", "bsdf": {"type": "conductor"}}
    held = psdr.load_dict(whole)
    for form in ("auto", boundary.PathSpace()):
        with pytest.raises(ValueError, match=r"normals of 'body'.*'normals': 'analytic'.*boundary=None"):
            psdr.plan(held, integrator=psdr.PathIntegrator(boundary=form), names=[name])
    psdr.plan(held, integrator=psdr.PathIntegrator(boundary=None), names=[name])
    textbook = psdr.PathIntegrator(boundary=None, interior=interior.Textbook())
    with pytest.raises(ValueError, match=r"interior.Textbook\(\) does not know points that slide along rays"):
        psdr.plan(held, integrator=textbook, names=[name])


@pytest.mark.filterwarnings("ignore:'sensor' names no medium")
def test_other_ways_are_refused() -> None:
    held = psdr.load_dict(described())
    with pytest.raises(ValueError, match=r"does not know 'body', a 'sdfgrid'; use interior.Replay\(\)"):
        psdr.plan(held, integrator=psdr.PathIntegrator(interior=interior.LightTracing()))
    whole = described()
    fog = {"type": "homogeneous", "sigma_t": 0.1}
    whole["box"] = {"type": "cube", "to_world": T.scale(9.0), "bsdf": {"type": "null"}, "interior": fog}
    with pytest.raises(ValueError, match=r"what moves beside media is not followed where there is 'body', a 'sdfgrid'"):
        psdr.plan(psdr.load_dict(whole), names=["body.to_world"])
