"""Steps off surfaces and past edges in scenes of mixed scales (``kernels/step.py``, ``scene/shapes/steps.py``)."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.rays.test_wide_bvh import Tracer
from tests.stability.sweeps import room
from tests.stability.test_mixed_scales import on_a_floor
from tests.stability.test_scale import world
from warp_psdr.kernels.step import LEAVE, RAY_EPSILON, TOUCH
from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.welding import weld, weld_shapes

#: What is noted is looked for in the notes.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")


def test_a_scene_of_one_scale_has_one_step() -> None:
    steps = psdr.load_dict(room()).steps
    assert steps.scene == 0.0 and not steps.shapes.any()


def test_only_what_touches_the_vast_takes_longer_steps() -> None:
    size = 1e5
    for scene, touched in ((world(size), False), (on_a_floor(size), True), (on_a_floor(size, pieces=3), False)):
        loaded = psdr.load_dict(scene)
        number = [s.path for s in loaded.description.shapes].index("box")
        step = loaded.steps.shapes[number]
        own = RAY_EPSILON * loaded.steps.far[number]
        assert step == pytest.approx(TOUCH * 0.5 * size if touched else own, rel=1e-6) and own < 2e-5
        assert loaded.steps.scene == pytest.approx(TOUCH / RAY_EPSILON * loaded.ray_epsilon)


def test_steps_follow_an_edit() -> None:
    scene = psdr.load_dict(room())
    params = psdr.traverse(scene)
    vertices = params["floor.vertex_positions"].numpy().copy()
    params["floor.vertex_positions"] = vertices * np.float32(1e4)
    params.update()
    assert scene.steps.scene > 0.0 and scene.data().least_step > 0.0
    params["floor.vertex_positions"] = vertices
    params.update()
    assert scene.steps.scene == 0.0 and scene.data().least_step == 0.0


def test_mirrors_take_one_step_for_all_and_say_so() -> None:
    def notes(material: dict) -> list[str]:
        scene = world(1e5)
        scene["floor"] |= {"bsdf": material}
        return [note for note in psdr.load_dict(scene).description.notes if "mirrors" in note]

    assert any("'box'" in note for note in notes({"type": "conductor", "material": "none"}))
    assert not notes({"type": "diffuse"})


@pytest.mark.parametrize("backend", ["wide", "warp"])
def test_rays_that_leave_a_triangle_do_not_meet_it_again(backend: str) -> None:
    rng = np.random.default_rng(0)
    count, again = 20000, {LEAVE: 0, 0.5 * LEAVE: 0, 0.0: 0}
    for offset in (0.0, 0.5, 3.0):
        for _ in range(3):
            a, b = np.linalg.qr(rng.standard_normal((3, 2)))[0].T
            c = offset * rng.uniform(-1, 1, 3)
            corners = np.float32([c - a - b, c + a - b, c + a + b, c - a + b])
            tracer = Tracer(corners, [[0, 1, 2], [0, 2, 3]], backend=backend)
            p = corners[np.array([[0, 1, 2], [0, 2, 3]])[rng.integers(0, 2, count)]]
            uv = np.float32(rng.dirichlet((1.0, 1.0, 1.0), count)[:, :2])
            u, v = uv[:, :1], uv[:, 1:]
            x = (np.float32(1.0) - u - v) * p[:, 0] + u * p[:, 1] + v * p[:, 2]
            n = np.cross(a, b) * np.sign(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) @ np.cross(a, b))[:, None]
            flat = rng.standard_normal((count, 3))
            flat -= n * (flat * n).sum(axis=1)[:, None]
            d = flat + 10.0 ** rng.uniform(-4, 1, (count, 1)) * np.linalg.norm(flat, axis=1)[:, None] * n
            d = np.float32(d / np.linalg.norm(d, axis=1)[:, None])
            for share in again:
                o = x + np.float32(share * np.abs(corners).max()) * np.float32(n)
                again[share] += int((tracer(o, d)[0]["face"] >= 0).sum())
    assert again[LEAVE] == again[0.5 * LEAVE] == 0 < again[0.0]


def test_shapes_are_welded_by_their_own_tolerance() -> None:
    rng = np.random.default_rng(1)
    small, large = rng.random((50, 3)) * 1e-4, 100.0 * rng.random((20, 3))
    points = np.concatenate([small, small + 1e-12, large, large + 1e-5, small[:3]])
    shape = np.concatenate([np.zeros(100, int), np.ones(40, int), np.full(3, 2)])
    group = weld_shapes(points, shape, np.array([1e-10, 1e-4, 1e-10]))
    assert group.max() + 1 == 70
    np.testing.assert_array_equal(group[:50], group[50:100])
    np.testing.assert_array_equal(group[100:120], group[120:140])
    np.testing.assert_array_equal(group[140:], group[:3])
    assert weld(points, 1e-4).max() + 1 < 70  # one tolerance for all joins what is small


def test_a_fine_mesh_keeps_its_edges_in_a_vast_world() -> None:
    def edges(extra: dict) -> int:
        ball = {"type": "sphere", "center": [0.2, 0.1, 1.0], "radius": 0.05}
        scene = psdr.load_dict(room(extra={"ball": ball} | extra))
        number = [s.path for s in scene.description.shapes].index("ball")
        found = scene_adjacency(scene)
        return int((scene.builder.face_shape[found.faces[found.first[:-1]]] == number).sum())

    assert edges({"square": world(1e6)["square"]}) == edges({}) > 100
