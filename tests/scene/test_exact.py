"""Shapes without triangles: what loads, what is refused, and how they follow edits."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene.kinds.records import position_of
from warp_psdr.scene.kinds.sphere import Sphere
from warp_psdr.topology.kinds.exact_shapes import _across, crossed_faces, exact_shapes, least_distance, runs_through

T = psdr.Transform
#: Flat, for float32.
SHEARED = np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 1e-8, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
BUMPS = {"type": "bumpmap", "h": {"type": "bitmap", "bitmap": np.ones((2, 2, 1))}, "b": {"type": "diffuse"}}
POSE = T.translate([0.4, -0.2, 0.3]).rotate([1, 2, 0], 30.0).scale([0.5, 0.3, 0.2])


def sphere(**properties) -> dict:
    return {"type": "sphere", "exact": True, **properties}


def scene(**shapes) -> psdr.Scene:
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    sensor = {"type": "perspective", "to_world": T.look_at([0, -3, 0], [0, 0, 0], [0, 0, 1]), "film": film}
    return psdr.load_dict({"type": "scene", "sensor": sensor, "sky": {"type": "constant"}, **shapes})


@pytest.mark.parametrize(
    ("properties", "problem"),
    [
        ({"resolution": 16}, "'exact' beside 'resolution'"),
        ({"face_normals": True}, "'exact' beside 'face_normals'"),
        ({"emitter": {"type": "directionalarea"}}, "an emitter but 'area' on an exact 'sphere'"),
        ({"sensor": {"type": "irradiancemeter"}}, "a sensor on an exact 'sphere'"),
        (
            {
                "bsdf": {
                    "type": "bumpmap",
                    "h": {"type": "bitmap", "bitmap": np.ones((2, 2, 1))},
                    "b": {"type": "diffuse"},
                }
            },
            "a 'bumpmap' on an exact 'sphere'",
        ),
        ({"to_world": T.scale([1.0, 1.0, 0.0])}, "singular"),
        ({"to_world": SHEARED}, "no inverse"),
        ({"exact": "yes"}, "exact"),
    ],
)
def test_what_it_does_not_do_is_refused(properties: dict, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        scene(ball=sphere(**properties))


def test_it_is_refused_in_groups() -> None:
    group = {"type": "shapegroup", "ball": sphere()}
    with pytest.raises(ValueError, match="an exact 'sphere' inside a 'shapegroup'"):
        scene(group=group, copy={"type": "instance", "group": {"type": "ref", "id": "group"}})


def test_its_parameter_is_the_pose() -> None:
    held = scene(ball=sphere(to_world=POSE))
    params = psdr.traverse(held)
    assert "ball.to_world" in params and "ball.vertex_positions" not in params
    np.testing.assert_allclose(params["ball.to_world"].numpy(), POSE.matrix, atol=1e-6)
    with pytest.raises(KeyError, match=r"exact 'sphere', which has no vertices: its parameter is 'ball.to_world'"):
        params.requires_grad("ball.vertex_positions")
    assert held.face_count == 0
    assert "exact shapes" in str(psdr.plan(held))


def test_without_exact_nothing_changes() -> None:
    plain, said = scene(ball={"type": "sphere"}), scene(ball={"type": "sphere", "exact": False})
    np.testing.assert_array_equal(plain.triangles.numpy(), said.triangles.numpy())
    assert psdr.plan(plain).config == psdr.plan(said).config
    assert psdr.plan(plain).config.surfaces.primitives == ()


def test_center_and_radius_make_the_pose() -> None:
    params = psdr.traverse(scene(ball=sphere(center=[1.0, 2.0, 3.0], radius=0.5)))
    expected = T.translate([1.0, 2.0, 3.0]).scale(0.5).matrix
    np.testing.assert_allclose(params["ball.to_world"].numpy(), expected, atol=1e-6)


def test_records_follow_edits() -> None:
    held = scene(floor={"type": "rectangle"}, ball=sphere(to_world=POSE))
    params = psdr.traverse(held)
    record = held.triangles.numpy()[held.face_count]
    assert record["i1"] < 0 and record["i2"] == 1
    moved = params["ball.to_world"].numpy().copy()
    moved[:3] *= -1.0  # mirrored: c turns over, normals do not
    params["ball.to_world"] = moved
    params.update()
    record = held.triangles.numpy()[held.face_count]
    np.testing.assert_array_equal(record["normal"], moved[:3, 3])
    np.testing.assert_array_equal(record["p1"], moved[:3, 1])
    assert record["i2"] == -1
    moved[:3, 2] = 0.0
    params["ball.to_world"] = moved
    with pytest.raises(ValueError, match=r"ball.to_world: .* no inverse"):
        params.update()


def test_points_are_on_the_sphere() -> None:
    random = np.random.default_rng(0)
    u, v = random.uniform(-1.0, 1.0, (2, 1000))
    q = Sphere.points(u, v)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-12)
    held = scene(ball=sphere(to_world=POSE))
    x = position_of(held, held.triangles.numpy()[0], 0.3, -0.4)
    local = np.linalg.inv(POSE.matrix) @ np.append(x, 1.0)
    np.testing.assert_allclose(local[:3], Sphere.points(0.3, -0.4), atol=1e-6)


def pierced(held: psdr.Scene, shapes: frozenset[int] | None) -> tuple[int, int] | None:
    """The first exact shape and one that runs through it, one of both among ``shapes`` (None: any)."""
    exact = exact_shapes(held)
    for i in exact:
        faces = crossed_faces(held, i, shapes)
        if len(faces):
            return i, int(held.builder.face_shape[faces[0]])
        for j in exact:
            if j != i and (shapes is None or shapes & {i, j}) and runs_through(held, i, j):
                return min(i, j), max(i, j)
    return None


def test_shapes_that_run_through_it_are_found() -> None:
    def shapes(z: float, second: float) -> psdr.Scene:
        floor = {"type": "rectangle", "to_world": T.translate([0.0, 0.0, z])}
        return scene(floor=floor, ball=sphere(radius=0.5), other=sphere(center=[second, 0.0, 0.0], radius=0.3))

    assert pierced(shapes(-0.6, 2.0), None) is None
    assert pierced(shapes(-0.5, 2.0), None) is None, "it stands on the floor"
    assert pierced(shapes(-0.4, 2.0), None) == (1, 0)
    assert pierced(shapes(-0.4, 2.0), frozenset({2})) is None, "neither moves"
    assert pierced(shapes(-0.6, 0.7), None) == (1, 2)
    assert pierced(shapes(-0.6, 0.1), None) is None, "one lies inside of the other"


@pytest.mark.parametrize("kind", ["disk", "cylinder"])
@pytest.mark.parametrize(
    ("properties", "problem"),
    [
        ({"resolution": 16}, "'exact' beside 'resolution'"),
        ({"emitter": {"type": "directionalarea"}}, "an emitter but 'area' on an exact"),
        ({"bsdf": BUMPS}, "a 'bumpmap' on an exact"),
        ({"to_world": SHEARED}, "no inverse.*all three columns"),
    ],
)
def test_what_other_kinds_do_not_do_is_refused(kind: str, properties: dict, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        scene(shape={"type": kind, "exact": True, **properties})


def test_rectangles_and_cubes_stay_triangles() -> None:
    with pytest.raises(ValueError, match="exact"):
        scene(shape={"type": "rectangle", "exact": True})


def test_other_kinds_have_a_pose_and_a_box() -> None:
    tube = {"type": "cylinder", "exact": True, "p0": [1.0, 0.0, 0.0], "p1": [1.0, 2.0, 0.0], "radius": 0.25}
    held = scene(plate={"type": "disk", "exact": True, "to_world": POSE}, tube=tube, ball=sphere(radius=0.1))
    assert held.face_count == 0
    assert "1 disk, 1 cylinder, 1 sphere" in str(psdr.plan(held))
    box = held.points[4:12]  # behind the corners of the plate
    np.testing.assert_allclose(box.min(axis=0), [0.75, 0.0, -0.25], atol=1e-6)
    np.testing.assert_allclose(box.max(axis=0), [1.25, 2.0, 0.25], atol=1e-6)
    records = held.triangles.numpy()
    for record in records:
        for u, v in ((0.3, -0.4), (-0.1, 0.5)):
            q = held.geometry(int(record["shape"])).points(u, v)
            linear = np.stack([record["p0"], record["p1"], record["p2"]], axis=1)
            np.testing.assert_allclose(position_of(held, record, u, v), linear @ q + record["normal"], atol=1e-6)


def test_shapes_that_touch_disks_and_cylinders_are_found() -> None:
    def shapes(z: float = -2.0, **more) -> psdr.Scene:
        wall = {"type": "rectangle", "to_world": T.translate([0.0, 0.0, z]).scale(0.5)}
        tube = {"type": "cylinder", "exact": True, "radius": 0.5}
        return scene(wall=wall, tube=tube, **more)

    def plate(z: float, radius: float = 0.5, x: float = 0.0) -> dict:
        return {"type": "disk", "exact": True, "to_world": T.translate([x, 0.0, z]).scale(radius)}

    assert pierced(shapes(), None) is None
    assert pierced(shapes(0.5), None) == (1, 0), "corners of the square are outside"
    assert pierced(shapes(0.0), None) == (1, 0), "it stands on it"
    assert pierced(shapes(-0.01), None) is None
    assert pierced(shapes(cap=plate(1.0)), None) == (1, 2), "a cap touches the rim"
    assert pierced(shapes(cap=plate(1.0)), frozenset({0})) is None, "neither moves"
    assert pierced(shapes(cap=plate(0.5, 0.4)), None) is None, "it floats inside"
    assert pierced(shapes(cap=plate(0.5, 0.4, 0.2)), None) == (1, 2)
    assert pierced(shapes(ball=sphere(center=[0.0, 0.0, 0.5], radius=0.4)), None) is None
    assert pierced(shapes(ball=sphere(center=[0.0, 0.0, 0.5], radius=0.6)), None) == (1, 2)
    assert pierced(shapes(cap=plate(-1.0), ball=sphere(center=[0.0, 0.0, -1.1], radius=0.3)), None) == (2, 3)
    assert pierced(shapes(cap=plate(-1.0), ball=sphere(center=[0.0, 0.0, -1.4], radius=0.3)), None) is None
    assert pierced(shapes(cap=plate(-1.0), far=plate(-1.0, 0.2, 0.6)), None) == (2, 3), "in one plane"
    assert pierced(shapes(cap=plate(-1.0), far=plate(-1.0, 0.2, 0.8)), None) is None


def test_parts_of_triangles_between_planes() -> None:
    random = np.random.default_rng(2)
    triangles = random.normal(size=(200, 3, 3)) * random.uniform(0.2, 2.0, (200, 1, 1))
    triangles[:20, :, 2] = triangles[:20, :1, 2]
    triangles[20:30, 0, 2] = triangles[20:30, 1, 2]
    points = np.einsum("nk,mki->mni", random.dirichlet((0.5, 0.5, 0.5), 10000), triangles)
    for low, high in ((-0.1, 1.1), (-0.6, 0.3)):
        rows, nearest, farthest = _across(triangles, low, high)
        between = (points[..., 2] >= low) & (points[..., 2] <= high)
        distance = np.linalg.norm(points[..., :2], axis=2)
        sampled = np.where(between, distance, np.inf).min(axis=1)
        assert set(np.flatnonzero(sampled <= 1.0)) <= set(rows)
        some = between[rows].sum(axis=1) > 200
        gaps = sampled[rows] - nearest, farthest - np.where(between, distance, 0.0).max(axis=1)[rows]
        for gap in gaps:
            assert (gap[some] > -1e-5).all() and (gap[some] < 0.05).all()


def test_distances_of_triangles() -> None:
    random = np.random.default_rng(1)
    corners = random.normal(size=(50, 3, 3)) + random.normal(size=(50, 1, 3))
    weights = random.dirichlet((0.5, 0.5, 0.5), 20000)
    sampled = np.linalg.norm(np.einsum("nk,mki->mni", weights, corners), axis=2).min(axis=1)
    found = least_distance(corners)
    assert (found <= sampled + 1e-9).all() and (sampled - found < 0.05).all()
