"""Poses of meshes: every mesh has one, and moves by it as by its vertices."""

import numpy as np
import pytest

import warp_psdr as psdr

T = psdr.Transform
PLACE = T.translate((0.1, 0.2, 0.0)) @ T.rotate((0, 1, 0), 20) @ T.scale((1.0, 0.5, 1.2))
TURN = np.array([[0.2, -0.4, 0.1, 0.3], [0.3, 0.1, -0.2, 0.1], [-0.1, 0.2, 0.3, -0.2], [0.0, 0.0, 0.0, 0.0]])
#: A tetrahedron off the origin of its own coordinates, whose vertices triangles share; in the order of their first use.
CORNERS = np.array([[1.2, -0.5, -0.4], [-0.8, -0.6, -0.5], [0.3, 1.1, -0.2], [0.4, -0.1, 1.0]])
FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
#: Rounding of sums of float32, over the largest number.
ROUNDING = 2e-6


def obj(path) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"f {a} {b} {c}" for a, b, c in FACES + 1]
    (path / "shape.obj").write_text("\n".join(lines))
    return str(path / "shape.obj")


def described(shape: dict) -> dict:
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {"type": "perspective", "to_world": T.look_at((0, 0, 5), (0, 0, 0), (0, 1, 0)), "film": film},
        "lamp": {
            "type": "rectangle", "to_world": T.look_at((2, 3, 4), (0, 0, 0), (0, 1, 0)),
            "emitter": {"type": "area", "radiance": 5.0},
        },
        "shape": shape,
    }  # fmt: skip


@pytest.fixture(params=["obj", "mesh"])
def shape(request: pytest.FixtureRequest, tmp_path) -> dict:
    if request.param == "obj":
        return {"type": "obj", "filename": obj(tmp_path)}
    return {"type": "mesh", "vertices": CORNERS, "faces": FACES}


def moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ np.asarray(matrix)[:3, :3].T + np.asarray(matrix)[:3, 3]


@pytest.mark.parametrize("place", [np.eye(4), PLACE.matrix], ids=["as it is", "placed"])
def test_a_pose_moves_the_vertices_of_the_file(shape: dict, place: np.ndarray) -> None:
    params = psdr.traverse(psdr.load_dict(described({**shape, "to_world": place})))
    np.testing.assert_allclose(params["shape.to_world"].numpy(), place, atol=1e-7)
    np.testing.assert_array_equal(params["shape.vertex_positions"].numpy(), moved(place, CORNERS).astype(np.float32))
    pose = T.translate((0.0, -0.5, 0.25)).matrix @ place
    params["shape.to_world"] = pose
    params.update()
    np.testing.assert_allclose(params["shape.vertex_positions"].numpy(), moved(pose, CORNERS), atol=1e-6)
    # What was edited is moved by later poses, from the pose that it was edited under.
    params["shape.vertex_positions"] = moved(pose, 2.0 * CORNERS)
    params.update()
    params["shape.to_world"] = place
    params.update()
    np.testing.assert_allclose(params["shape.vertex_positions"].numpy(), moved(place, 2.0 * CORNERS), atol=2e-6)


def test_normals_of_files_without_them_follow_a_pose(shape: dict) -> None:
    """They are computed from the vertices: those that a new scene with this pose has."""
    pose = T.scale((1.0, 3.0, 0.5)).matrix
    params = psdr.traverse(psdr.load_dict(described(shape)))
    before = params["shape.vertex_normals"].numpy().copy()
    params["shape.to_world"] = pose
    params.update()
    fresh = psdr.traverse(psdr.load_dict(described({**shape, "to_world": pose})))["shape.vertex_normals"].numpy()
    np.testing.assert_allclose(params["shape.vertex_normals"].numpy(), fresh, atol=1e-6)
    assert np.abs(fresh - before).max() > 0.1


def test_derivatives_by_a_pose_are_those_by_the_vertices_that_it_moves(shape: dict) -> None:
    scene = psdr.load_dict(described({**shape, "to_world": PLACE}))
    params = psdr.traverse(scene)
    options = {"spp": 16, "seed": 1}
    by_pose = psdr.render_forward(scene, params, {"shape.to_world": TURN}, **options).numpy()
    by_vertices = psdr.render_forward(
        scene, params, {"shape.vertex_positions": moved(TURN, CORNERS)}, **options
    ).numpy()  # fmt: skip
    assert np.abs(by_pose).max() > 0.1
    np.testing.assert_allclose(by_pose, by_vertices, rtol=0, atol=ROUNDING * np.abs(by_pose).max())
    weights = np.random.default_rng(0).normal(size=by_pose.shape).astype(np.float32)
    params.requires_grad_only("shape.to_world", "shape.vertex_positions")
    params.zero_grad()
    psdr.render_backward(scene, params, weights, **options)
    pulled = (params["shape.to_world"].grad.numpy() * TURN).sum()
    vertices = (params["shape.vertex_positions"].grad.numpy() * moved(TURN, CORNERS)).sum()
    scale = np.abs(weights * by_pose).sum()
    assert abs(pulled - (weights * by_pose).sum()) < ROUNDING * 10 * scale
    assert abs(vertices - pulled) < ROUNDING * 10 * scale


@pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")  # that it is far away
def test_only_what_keeps_its_digits_has_a_pose() -> None:
    """A mesh far from the origin of its own coordinates has vertices alone."""
    shape = {"type": "mesh", "vertices": CORNERS + 1e5, "faces": FACES, "face_normals": True}
    params = psdr.traverse(psdr.load_dict(described(shape)))
    assert "shape.vertex_positions" in params and "shape.to_world" not in params
