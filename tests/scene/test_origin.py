"""Scenes far away from the origin of the world: what the device holds, and what users see of it."""

from types import SimpleNamespace

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene.origin import FAR, find_origin, from_world, shift_of, to_world

#: Scenes that are far from the origin are noted to be so.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")

#: Representable in float32 together with coordinates of a few bits, so that every sum below is exact.
PLACE = np.array([4096.0, -8192.0, 0.0])
TRIANGLE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.5]])
TRANSLATE = psdr.Transform.translate


def scene(place, dtype=np.float64) -> dict:
    """Return a scene that holds every kind of position: meshes, posed shapes, lights, three kinds of cameras."""
    view = TRANSLATE(place) @ psdr.Transform.look_at((0.25, 0.5, 4.0), (0, 0, 0))
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    camera = {"to_world": view, "film": film}
    return {
        "type": "scene",
        "pinhole": {"type": "perspective", **camera},
        "lens": {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0, **camera},
        "parallel": {"type": "orthographic", "to_world": view @ psdr.Transform.scale(2.0), "film": film},
        "mesh": {"type": "mesh", "vertices": (TRIANGLE + place).astype(dtype), "faces": np.array([[0, 1, 2]])},
        "ball": {"type": "sphere", "center": np.array([0.5, 0.5, -1.0]) + place, "radius": 0.5, "resolution": 16},
        "disk": {"type": "disk", "to_world": TRANSLATE(np.array([0.0, 0.0, -2.0]) + place) @ psdr.Transform.scale(3)},
        "point": {"type": "point", "position": np.array([1.0, 2.0, 3.0]) + place, "intensity": 9.0},
        "spot": {
            "type": "spot", "intensity": 20.0,
            "to_world": TRANSLATE(place) @ psdr.Transform.look_at((-1.0, 0.5, 3.0), (0, 0, 0)),
        },
        "sun": {"type": "directional", "direction": [0.1, 0.2, -1.0], "irradiance": 0.2},
    }  # fmt: skip


PLACED = (
    "mesh.vertex_positions", "ball.to_world", "disk.to_world", "point.position", "spot.to_world", "pinhole.to_world",
    "lens.to_world", "parallel.to_world",
)  # fmt: skip


def image(loaded, sensor: int = 0) -> np.ndarray:
    return psdr.render(loaded, sensor=sensor, spp=4, integrator=psdr.PathIntegrator(max_depth=3)).numpy()


def held(loaded) -> np.ndarray:
    """Return all values on the device but the pose of the mesh, which has none where its coordinates are far away."""
    parameters = [p for name, p in loaded.parameters.items() if name != "mesh.to_world"]
    return np.concatenate([loaded.values[p.offset : p.offset + p.size].numpy() for p in parameters])


@pytest.fixture(scope="module")
def pair():
    return psdr.load_dict(scene((0.0, 0.0, 0.0))), psdr.load_dict(scene(PLACE))


def test_a_scene_that_is_near_has_no_origin_and_no_second_array(pair) -> None:
    near, far = pair
    assert not near.origin.any()
    assert psdr.traverse(near)["mesh.vertex_positions"].ptr == near.values.ptr + 4 * near.positions
    # Along z it is near.
    np.testing.assert_array_equal(far.origin, PLACE)
    assert [n for n in far.description.notes if "far from the origin" in n]


@pytest.mark.slow_rows("0", "1", "2")
@pytest.mark.parametrize("sensor", range(3))
def test_far_away_the_device_holds_the_same_bits(pair, sensor: int) -> None:
    near, far = pair
    np.testing.assert_array_equal(held(near), held(far))
    np.testing.assert_array_equal(image(near, sensor), image(far, sensor))


def test_parameters_are_in_world_coordinates(pair) -> None:
    near, far = (psdr.traverse(s) for s in pair)
    assert set(near) - set(far) == {"mesh.to_world"}
    for name in far:
        a, b = near[name].numpy(), far[name].numpy()
        place = shift_of(b.shape, PLACE).reshape(b.shape) if name in PLACED else 0.0
        if name.endswith("vertex_positions"):
            place = PLACE
        np.testing.assert_array_equal((a + place).astype(np.float32), b, err_msg=name)


def test_float32_positions_come_back_with_their_bits() -> None:
    rng = np.random.default_rng(3)
    given = {"mesh": {"type": "mesh", "vertices": (1e4 + rng.random((30, 3))).astype(np.float32),
                      "faces": np.arange(30).reshape(10, 3)}}  # fmt: skip
    loaded = psdr.load_dict({"type": "scene", "camera": {"type": "perspective"}, "sky": {"type": "constant"}} | given)
    assert loaded.origin.all()
    found = psdr.traverse(loaded)["mesh.vertex_positions"].numpy()
    np.testing.assert_array_equal(found, given["mesh"]["vertices"])


@pytest.mark.parametrize("name", PLACED)
@pytest.mark.parametrize("how", ["float64", "float32", "in place"])
def test_an_edit_has_the_effect_that_it_has_nearby(name: str, how: str) -> None:
    near, far = psdr.load_dict(scene((0.0, 0.0, 0.0))), psdr.load_dict(scene(PLACE))
    move = np.array([0.25, 0.125, -0.5])
    for loaded in (near, far):
        params = psdr.traverse(loaded)
        values = params[name].numpy().astype(np.float64)
        values = values + shift_of(values.shape, move).reshape(values.shape)
        if how == "in place":
            params[name].assign(values.astype(np.float32))
            params.update(name)
        else:
            params[name] = values.astype(how)
            params.update()
        np.testing.assert_array_equal(params[name].numpy(), values.astype(np.float32))
    np.testing.assert_array_equal(held(near), held(far))
    if name in ("ball.to_world", "disk.to_world"):
        shape = name.split(".")[0]
        a, b = (psdr.traverse(s)[f"{shape}.vertex_positions"].numpy() for s in (near, far))
        np.testing.assert_array_equal((a + PLACE).astype(np.float32), b)


def test_values_that_are_written_back_keep_the_digits_that_float32_lacks() -> None:
    loaded = psdr.load_dict(scene(PLACE + 1.0 / 3.0))
    params, before = psdr.traverse(loaded), loaded.values.numpy()
    for name in PLACED:
        params[name] = params[name].numpy()
        params.update(name)
    np.testing.assert_array_equal(loaded.values.numpy(), before)


def test_coarse_edits_in_place_warn_once() -> None:
    loaded = psdr.load_dict(scene(1000.0 * PLACE))
    params = psdr.traverse(loaded)
    values = params["mesh.vertex_positions"].numpy()
    params["mesh.vertex_positions"].assign(values + np.float32(1.0))
    with pytest.warns(RuntimeWarning, match="steps of 0"):
        params.update("mesh.vertex_positions")
    params["mesh.vertex_positions"].assign(values)
    params.update("mesh.vertex_positions")


@pytest.mark.slow
def test_gradients_need_no_conversion(pair) -> None:
    gradients = []
    for loaded in pair:
        params = psdr.traverse(loaded)
        params.requires_grad(*PLACED[:6])
        integrator = psdr.PathIntegrator(max_depth=2, boundary=None)
        psdr.render_backward(loaded, params, np.ones((12, 12, 3)), spp=4, integrator=integrator)
        gradients.append({name: params[name].grad.numpy() for name in params.requested})
    near, far = gradients
    for name, gradient in near.items():
        assert gradient.any(), name
        np.testing.assert_array_equal(gradient, far[name], err_msg=name)


@pytest.mark.parametrize("axis", range(3))
def test_where_far_begins(axis: int) -> None:
    radius = 0.5 * np.linalg.norm(np.ptp(TRIANGLE, axis=0))
    center = 0.5 * (TRIANGLE.min(axis=0) + TRIANGLE.max(axis=0))
    for ratio, far in ((0.99, False), (1.01, True)):
        place = np.zeros(3)
        place[axis] = ratio * FAR * radius
        found = find_origin([SimpleNamespace(vertices=TRIANGLE - center + place)])
        assert (found != 0.0).tolist() == [far and i == axis for i in range(3)]
        # A multiple of a power of two near the centre.
        assert not far or (np.abs(found - place).max() <= 0.5 * radius and found[axis] == round(found[axis]))


def test_conversions() -> None:
    shift = np.full(3, 1.0e6)
    stored = np.array([0.1, 0.2, 0.3], np.float32)
    world = to_world(stored, shift)
    kept, edited = from_world(world, stored, shift)
    np.testing.assert_array_equal(kept, stored)
    assert not edited.any()
    kept, edited = from_world(world + np.float32([0.0, 1.0, 0.0]), stored, shift)
    np.testing.assert_array_equal(edited, [False, True, False])
    np.testing.assert_array_equal(kept, np.float32([0.1, 1.1875, 0.3]))
    exact, _ = from_world(shift + 0.4, stored, shift)
    np.testing.assert_allclose(exact, 0.4, rtol=1e-7)


def test_vertices_that_leave_the_origin_warn() -> None:
    sky = {"type": "constant"}
    mesh = {"type": "mesh", "vertices": TRIANGLE, "faces": np.array([[0, 1, 2]])}
    loaded = psdr.load_dict({"type": "scene", "camera": {"type": "perspective"}, "mesh": mesh, "sky": sky})
    params = psdr.traverse(loaded)
    params["mesh.vertex_positions"] = TRIANGLE + np.array([2e3, 0.0, 0.0])
    with pytest.warns(RuntimeWarning, match=r"scene\.origin"):
        params.update()
    params["mesh.vertex_positions"] = TRIANGLE + np.array([10.0, 0.0, 0.0])
    params.update()
