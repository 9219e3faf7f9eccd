"""Curves: what loads, what is refused, and how they follow edits."""

import copy

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.kernels.primitive.curves import HEADER
from warp_psdr.options import interior
from warp_psdr.scene.kinds.curve import TREE
from warp_psdr.scene.kinds.curve_files import read_curves

T = psdr.Transform
#: Two B-splines of four and six control points.
POINTS = np.array(
    [[0, 0, k / 4, 0.1] for k in range(4)] + [[0.5, 0.1 * k, k / 6, 0.02 * k] for k in range(6)], np.float32
)
STARTS = [0, 4]
TEXT = "# hair\n" + "\n".join(" ".join(f"{x:.9g}" for x in p) for p in POINTS[:4]) + "\n\n\n"
TEXT += "\r\n".join(" ".join(f"{x:.9g}" for x in p) for p in POINTS[4:])


def described(plugin: str = "bsplinecurve", **properties) -> dict:
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "to_world": T.look_at([0.2, -3, 0.5], [0.2, 0, 0.5], [0, 0, 1]), "film": film}
    given = {} if "filename" in properties else {"control_points": POINTS, "curve_starts": STARTS}
    body = {"type": plugin, **given, **properties}
    path = {"type": "path", "max_depth": 1}  # what is seen before the sky; other tests compile what it scatters
    return {"type": "scene", "integrator": path, "sensor": sensor, "sky": {"type": "constant"}, "body": body}


def spoiled(column: int, value: float) -> np.ndarray:
    points = POINTS.copy()
    points[5, column] = value
    return points


@pytest.mark.parametrize(
    ("properties", "problem"),
    [
        ({"control_points": POINTS[:, :3]}, r"got the shape \(10, 3\).*give numbers \(N, 4\)"),
        ({"control_points": np.ones(6)}, r"got the shape \(6,\)"),
        ({"control_points": "hair"}, r"got the shape \(0,\)"),
        ({"control_points": spoiled(0, np.nan)}, "control point 6 is not finite"),
        ({"control_points": spoiled(3, np.nan)}, "control point 6 is not finite"),
        ({"control_points": spoiled(3, -0.1)}, "control point 6 has the radius -0.1; give 0 or more"),
        ({"curve_starts": [0, 7]}, "curve 2 has 3 control points; give each at least 4"),
        ({"curve_starts": [4]}, "give whole numbers that start with 0"),
        ({"curve_starts": [0, 4, 4]}, "give whole numbers that start with 0 and rise"),
        ({"curve_starts": [0, 10]}, "all below the 10 control points"),
        ({"curve_starts": [0.0, 4.0]}, "give whole numbers"),
        ({"control_points": np.repeat(POINTS[:1], 5, axis=0), "curve_starts": 0}, "1 to 4 are all in one place"),
        ({"filename": "hair.txt", "control_points": POINTS}, "got filename and control_points"),
        ({"filename": "hair.txt", "curve_starts": STARTS}, "curve_starts.*given beside 'filename'"),
        ({"flip_normals": True}, "they are seen from outside"),
        ({"to_world": np.diag([1.0, 1.0, 0.0, 1.0])}, "singular|no inverse"),
        ({"emitter": {"type": "area"}}, "an emitter on a 'bsplinecurve'.*'mesh'"),
        ({"interior": {"type": "homogeneous"}, "bsdf": {"type": "null"}}, "a medium on a 'bsplinecurve'"),
    ],
)
def test_what_it_does_not_do_is_refused(properties: dict, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        psdr.load_dict(described(**properties))


@pytest.mark.parametrize(
    ("properties", "problem"),
    [
        ({"curve_starts": [0, 9]}, "curve 2 has 1 control points; give each at least 2"),
        ({"control_points": POINTS[:1], "curve_starts": 0}, "curve 1 has 1 control points; give each at least 2"),
        ({"control_points": np.repeat(POINTS[:1], 2, axis=0), "curve_starts": 0}, "are all in one place"),
    ],
)
def test_straight_curves_that_are_none_are_refused(properties: dict, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        psdr.load_dict(described("linearcurve", **properties))


def test_control_points_are_needed() -> None:
    nothing = described()
    del nothing["body"]["control_points"]
    with pytest.raises(ValueError, match="there are no control points; give one of 'filename'"):
        psdr.load_dict(nothing)


def test_it_is_refused_in_groups() -> None:
    whole = described()
    whole["group"] = {"type": "shapegroup", "body": whole.pop("body")}
    whole["copy"] = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    with pytest.raises(ValueError, match="a 'bsplinecurve' inside a 'shapegroup'"):
        psdr.load_dict(whole)


def test_files(tmp_path) -> None:
    file = tmp_path / "hair.txt"
    file.write_bytes(TEXT.encode())
    points, starts = read_curves(file)
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(starts, STARTS)
    for text, problem in (
        ("1 2 3", "control point 1: got '1 2 3'; give 'x y z radius'"),
        ("1 2 3 4\n1 2 x 4", "control point 2: got '1 2 x 4'"),
        ("# nothing", "curve 1 has 0 control points"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=problem):
            psdr.load_dict(described("linearcurve", filename=str(file)))
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="is no text"):
        psdr.load_dict(described(filename=str(file)))


def test_doubtful_curves_are_noted() -> None:
    with pytest.warns(psdr.SceneWarning, match="all radii are 0"):
        psdr.load_dict(described(control_points=POINTS * [1, 1, 1, 0]))
    tight = np.array([[0, 0, 0, 0.3], [0.1, 0, 0, 0.3], [0.1, 0.1, 0, 0.3], [0, 0.1, 0, 0.3]])
    with pytest.warns(psdr.SceneWarning, match="1 segments bend more than their radius allows"):
        psdr.load_dict(described(control_points=tight, curve_starts=0))


def test_parameters_and_updates() -> None:
    held = psdr.load_dict(described(to_world=T.scale(0.9)))
    params = psdr.traverse(held)
    assert params["body.control_points"].shape == (40,) and "body.to_world" in params
    with pytest.raises(KeyError, match=r"its parameters are 'body.control_points' and 'body.to_world'"):
        params["body.vertex_positions"]
    said = str(psdr.plan(held))
    assert "curves body" in said and "4 segments" in said

    def image() -> np.ndarray:
        return psdr.render(held, spp=16, seed=3).numpy()

    # New control points, and a new pose, render as if they had been loaded; radii do not scale.
    thicker = POINTS * np.float32([1.0, 1.0, 0.8, 2.0])
    pose = T.translate([0.3, 0.0, 0.0]).scale(0.7).matrix
    for name, value in (("control_points", thicker.reshape(-1)), ("to_world", pose)):
        before = image()
        params[f"body.{name}"] = value
        params.update()
        placed = pose if name == "to_world" else T.scale(0.9)
        fresh = psdr.load_dict(described(control_points=thicker, to_world=placed))
        assert (image() != before).any()
        np.testing.assert_allclose(image(), psdr.render(fresh, spp=16, seed=3).numpy(), atol=1e-5)
    params["body.control_points"] = -params["body.control_points"].numpy()
    with pytest.raises(ValueError, match=r"body.control_points: .* a radius is negative"):
        params.update()


def test_other_ways_are_refused() -> None:
    held = psdr.load_dict(described())
    with pytest.raises(ValueError, match=r"does not know 'body', a 'bsplinecurve'; use interior.Replay\(\)"):
        psdr.plan(held, integrator=psdr.PathIntegrator(interior=interior.LightTracing()))


def test_a_copy_walks_trees_of_its_own() -> None:
    held = psdr.load_dict(described())
    params = psdr.traverse(held)
    params["body.bsdf.reflectance.value"] = 0.25
    params.update()
    copied = copy.deepcopy(held)
    before, after = (scene.values.numpy() for scene in (held, copied))
    frame = held.builder.frames[0]
    words = slice(frame + TREE, frame + HEADER)  # where the trees lie
    assert before[words].tobytes() != after[words].tobytes()
    rest = np.r_[0 : words.start, words.stop : len(before)]
    np.testing.assert_array_equal(before[rest], after[rest])
