"""Discontinuities seen through chains of smooth mirrors and glass: slopes on finite differences, modes, refusals."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.topology.faces import MOST_BOXES, face_tables, mirror_boxes

from .measure import BATCHES, MODES, SEED, Case, assert_agrees, assert_transposes, derivatives, differences, rows, slope
from .mirrors import CASES, ETA, GLASSES, LAMP, NEAR, OCCLUDER, WALL, lamp, wall
from .scenes import SIZE, camera, floor, load, mesh, sky
from .test_table import moved


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("case", [c for c in CASES if not c.slow], ids=str)
def test_the_table_can_tell_a_missing_boundary_term(case: Case) -> None:
    value, error = slope(derivatives(case, "forward", None), differences(case)[2])
    assert abs(value - 1.0) > 0.05 + 3.0 * error


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["unseen in a mirror", "unseen in its mirror"])
def test_the_camera_looks_through_hidden_lights(scene: str) -> None:
    case = Case(scene, NEAR, moved(0.0, 0.0, 1.0), 0.01, "light rises", spp=128, difference_spp=512, hidden=True)
    value, error = slope(derivatives(case, "reverse"), differences(case)[2])
    assert error < 0.03
    assert abs(value - 1.0) < 3.0 * error


@pytest.mark.parametrize(
    ("name", "names", "depth"),
    [
        pytest.param("slab", [GLASSES, ETA, LAMP, "sensor.to_world"], 4, marks=pytest.mark.slow),
        pytest.param("glass ball", [GLASSES, ETA, LAMP, "sensor.to_world"], 4, marks=pytest.mark.slow),
        pytest.param("caustic", [WALL, LAMP, OCCLUDER, "floor.vertex_positions"], 3, marks=pytest.mark.slow),
        pytest.param("point in a mirror", ["light.position", WALL, "floor.to_world"], 3, marks=pytest.mark.slow),
    ],
)
def test_the_modes_are_transposes_of_each_other(name, names, depth) -> None:
    scene, params = load(name)
    assert_transposes(scene, params, names, {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": 16, "seed": 3})


def panes(height: float, count: int) -> dict:
    """Horizontal panes that are not there: all that is seen of them is that they are counted."""
    z = np.repeat(height + 0.01 * np.arange(count), 4)
    x, y = np.tile([-9.0, 9.0, 9.0, -9.0], count), np.tile([-9.0, -9.0, 9.0, 9.0], count)
    faces = np.concatenate([[[4 * k, 4 * k + 1, 4 * k + 2], [4 * k, 4 * k + 2, 4 * k + 3]] for k in range(count)])
    return mesh(np.stack([x, y, z], 1), faces, {"type": "null"})


def under_panes(count: int) -> psdr.Scene:
    """A lamp above panes, and its light on the floor beneath them, which the camera sees through them."""
    objects = {
        "sensor": camera((0.0, -4.5, 2.5), (0.0, 0.2, 0.0), fov=30.0),
        "floor": floor(),
        "lamp": lamp((0.2, 0.0, 2.2), 0.8),
    }
    if count:
        objects["panes"] = panes(0.6, count)
    return psdr.load_dict({"type": "scene", **objects})


def sums_under_panes(count: int, spp: int) -> np.ndarray:
    """Return the derivative of the right half of the floor, by the lamp that moves, of every batch."""
    scene = under_panes(count)
    params = psdr.traverse(scene)
    along = {LAMP: np.zeros_like(params[LAMP].numpy()) + np.float32([1.0, 0.3, -0.4])}
    images = [
        psdr.render_forward(scene, params, along, integrator=psdr.PathIntegrator(), spp=spp, seed=SEED + b).numpy()
        for b in range(BATCHES)
    ]
    if count:
        params.requires_grad_only(LAMP)
        assert "0.00% of the image's light" in str(psdr.plan(scene, params, integrator=psdr.PathIntegrator()))
    return np.array(images, np.float64)[:, 1:, SIZE // 2 :].sum(axis=(1, 2, 3))


@pytest.mark.parametrize("depth", [-1, 17, 1000])
def test_a_path_has_any_length(depth: int) -> None:
    scene, _params = load("slab")
    plan = psdr.plan(scene, names=[LAMP], integrator=psdr.PathIntegrator(max_depth=depth))
    assert isinstance(plan.boundary, psdr.boundary.PathSpace)
    assert "first gradient measures" in str(plan)
    plan = psdr.plan(scene, names=[LAMP], integrator=psdr.PathIntegrator(max_depth=16))
    assert "first gradient measures" not in str(plan)


@pytest.mark.slow
def test_paths_of_eighteen_vertices_are_followed() -> None:
    """Down and up through 8 panes, a floor looks as it does without, where other terms find the lamp's edge."""
    without, through = sums_under_panes(0, 64), sums_under_panes(8, 256)
    value, error = slope(through, without)
    assert error < 0.05, f"too noisy to tell: slope {value:.3f} +- {error:.3f}"
    assert abs(value - 1.0) < 3.0 * error, f"slope {value:.3f} +- {error:.3f}"


@pytest.mark.slow
def test_what_lies_behind_longer_chains_is_refused() -> None:
    scene = under_panes(20)
    params = psdr.traverse(scene)
    for _repeated in range(2):
        with pytest.raises(ValueError, match=r"of the image's light .* set max_depth to 16 or less"):
            psdr.render_forward(scene, params, {LAMP: 1.0}, integrator=psdr.PathIntegrator(), spp=1)
    image = psdr.render_forward(scene, params, {LAMP: 1.0}, integrator=psdr.PathIntegrator(max_depth=16), spp=1)
    assert not image.numpy()[SIZE // 2 :].any()  # the floor is not seen


def test_the_plan_names_the_search() -> None:
    scene, _params = load("slab")
    assert "through mirrors and glass: line search" in str(
        psdr.plan(scene, names=[LAMP], integrator=psdr.PathIntegrator(max_depth=4))
    )
    plain, _params = load("soft")
    assert "line search" not in str(
        psdr.plan(plain, names=["occluder.vertex_positions"], integrator=psdr.PathIntegrator(max_depth=2))
    )


def test_boxes_hold_all_mirrors_and_glass() -> None:
    """Lines are not traced where no ray meets one."""
    scene, _params = load("slab")
    low, high = mirror_boxes(scene)
    held = ((scene.points > low) & (scene.points < high)).all(axis=1)
    glass = next(i for i, shape in enumerate(scene.description.shapes) if shape.path == "glass")
    record = scene.builder.shapes[glass]
    expected = np.zeros(len(held), bool)
    expected[record.first_vertex : record.first_vertex + record.vertex_count] = True
    assert (held == expected).all()
    many = {f"mirror{i}": wall(float(i)) for i in range(MOST_BOXES + 1)}
    joined = psdr.load_dict({"type": "scene", "sensor": camera(), "sky": sky(), **many})
    low, high = mirror_boxes(joined)
    assert ((joined.points > low) & (joined.points < high)).all()


@pytest.mark.parametrize(("name", "one"), [("glass ball", True), ("mirror ball", True), ("faceted glass", False)])
def test_a_smooth_convex_lens_is_one_surface(name: str, one: bool) -> None:
    """No line is halved at the edges of its triangles, behind which it shows the same."""
    scene, _params = load(name)
    _edges, tables = face_tables(scene)
    shape = next(i for i, s in enumerate(scene.description.shapes) if s.path in ("glass", "mirror"))
    group = tables.group.numpy()[: scene.face_count][scene.builder.face_shape == shape]
    assert (len(set(group)) == 1) == one
    assert len(set(tables.group.numpy())) > len(set(group))


@pytest.mark.parametrize(("reflectance", "one"), [(0.9, True), ({"type": "checkerboard"}, False)])
def test_a_seam_of_texture_coordinates_parts_a_lens_if_they_are_read(reflectance, one: bool) -> None:
    sphere = {"type": "sphere", "bsdf": {"type": "conductor", "material": "none", "specular_reflectance": reflectance}}
    scene = psdr.load_dict({"type": "scene", "sensor": camera((0, -4, 0), (0, 0, 0)), "sky": sky(), "ball": sphere})
    assert scene.face_count > 1000  # tessellated
    _edges, tables = face_tables(scene)
    assert (len(set(tables.group.numpy()[: scene.face_count])) == 1) == one
