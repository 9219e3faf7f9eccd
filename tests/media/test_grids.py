"""Images of grids: formulas, majorants, updates, equal bits, the plan."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media import scenes
from tests.media.scenes import T, camera, cube, grid, grids, points, sky, whole
from tests.path.helpers import assert_mean, assert_same_mean, batches, blocks
from warp_psdr.scene.media.super_grid import super_grid

#: Some boxes end inside of their interface, and are meant to.
pytestmark = pytest.mark.filterwarnings("ignore:.* is not 0 at the border of its box")

#: Absorbs the width of the camera and the step by which rays leave surfaces, relative.
WIDTH = 1e-3
DATA, ALBEDO = "slab.interior_medium.sigma_t.data", "slab.interior_medium.albedo.data"
SIZE = 4
SCALE = "slab.interior_medium.scale"
#: Extinction along the ray, by channel: a ramp, a step, zeros.
COLUMN = np.array([[0.0, 0.4, 0.5], [0.2, 0.4, 0.0], [0.4, 0.4, 0.0], [0.6, 1.4, 0.0], [0.8, 1.4, 0.9]], np.float32)


def slab():
    """A cube of side 2 with layers of extinction, before a sky of radiance 1, seen along its axis."""
    values = np.ones((5, 4, 3, 3), np.float32) * COLUMN[:, None, None, :]
    return whole(
        sensor=camera([0, 0, 5], [0, 0, 0], up=(0, 1, 0), size=SIZE),
        slab=cube(grids(grid(values), grid(np.zeros((2, 1, 1))), scale=1.5)),
        sky=sky(1.0, 1.0, 1.0),
    )


def set_values(scene, **values):
    params = psdr.traverse(scene)
    for name, value in values.items():
        name = {"data": DATA, "albedo": ALBEDO, "scale": SCALE}[name]
        params[name] = np.broadcast_to(np.asarray(value, np.float32), params[name].numpy().shape)
    params.update()


@pytest.fixture(scope="module")
def loaded():
    return psdr.load_dict(slab())


@pytest.fixture
def scene(loaded):
    set_values(loaded, data=COLUMN[:, None, None, :], albedo=0.0, scale=1.5)
    return loaded


@pytest.mark.parametrize("depth", [1, -1], ids=["ratio tracking", "delta tracking"])
def test_layers_let_exp_minus_tau_pass(scene, depth):
    """Interpolated from centre to centre and constant beyond, the integral is the sum of the voxels."""
    expected = np.exp(-1.5 * 2.0 / 5.0 * COLUMN.sum(axis=0, dtype=np.float64))
    assert_mean(points(batches(scene, spp=1024, max_depth=depth)), expected, "layers", WIDTH)


def test_a_furnace_and_a_medium_that_is_not_there(scene):
    set_values(scene, albedo=1.0)
    assert_mean(batches(scene, spp=256, max_depth=-1).mean(axis=(1, 2)), 1.0, "furnace", WIDTH)
    set_values(scene, data=0.0)
    np.testing.assert_allclose(batches(scene, count=1, spp=4, max_depth=-1), 1.0, rtol=1e-6)


def test_majorants_follow_an_update(scene):
    """One layer much denser than all before: with the former majorants it would be clipped to them."""
    dense = COLUMN.copy()
    dense[2] = 2.5
    set_values(scene, data=dense[:, None, None, :], scale=1.0)
    expected = np.exp(-2.0 / 5.0 * dense.sum(axis=0, dtype=np.float64))
    assert_mean(points(batches(scene, spp=1024, max_depth=-1)), expected, "after an update", WIDTH)


@pytest.mark.slow
def test_a_constant_grid_is_a_homogeneous_medium():
    """As is a constant in a ``heterogeneous`` medium whose box holds the cube."""
    view = {"sensor": camera([3.5, 2.5, 2.0], [0, 0, 0], 40.0, 8), "sky": sky(0.4, 0.5, 0.6), "lamp": scenes.lamp()}
    same = scenes.medium(0.7, 0.8)
    box = T.translate([-1.5, -1.5, -1.5]) @ T.scale(3.0)
    constant = {"type": "constvolume", "value": 0.7, "to_world": box}
    expected = batches(psdr.load_dict(whole(cube=cube(same), **view)), spp=256, max_depth=5)
    for sigma in (grid(np.full((9, 2, 17), 0.7), box, wrap_mode="repeat"), constant):
        found = batches(psdr.load_dict(whole(cube=cube(grids(sigma, 0.8)), **view)), spp=256, max_depth=5)
        assert_same_mean(blocks(found, 4), blocks(expected, 4), "constant", WIDTH)


@pytest.mark.parametrize("wrap", ["clamp", "repeat", "mirror"])
def test_no_value_exceeds_its_cells_majorant(wrap):
    """And each majorant is a value of its cell, or of the next voxel."""
    values = np.random.default_rng(5).uniform(0.0, 1.0, (17, 8, 3, 2)).astype(np.float32)
    most = super_grid(values, wrap).reshape(3, 1, 1)
    padded = np.pad(values.max(axis=3), 1, mode={"clamp": "edge", "repeat": "wrap", "mirror": "symmetric"}[wrap])
    for cell, (first, last) in enumerate(((0, 10), (8, 18), (16, 19))):
        assert most[cell, 0, 0] == pytest.approx(padded[first:last].max(), rel=2e-6)
        assert most[cell, 0, 0] >= padded[first:last].max()


def test_any_number_of_workers_gives_equal_bits(scene):
    set_values(scene, albedo=0.7)
    before = psdr.set_workers(1)
    try:
        first = psdr.render(scene, spp=4, seed=3).numpy()
    finally:
        psdr.set_workers(before)
    np.testing.assert_array_equal(first, psdr.render(scene, spp=4, seed=3).numpy())


def test_the_plan_names_grids(loaded):
    text = str(psdr.plan(loaded))
    assert "1 heterogeneous" in text and "3 x 4 x 5 voxels" in text and "1 x 1 x 1 cells" in text
    wanted = str(psdr.plan(loaded, names=[DATA]))
    assert "media derivatives" in wanted and "clock" in wanted
