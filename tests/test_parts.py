"""The derivative image term by term."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary.scenes import load
from tests.boundary.test_sdfgrid import GRID
from warp_psdr.kernels.boundary.silhouette.grid_points import VOXEL_ITEM
from warp_psdr.topology.kinds.grid_silhouettes import grid_items, grid_shapes, only

INTEGRATOR = psdr.PathIntegrator(max_depth=2)
#: Float32 sums in another order.
SUMMATION = 1.0e-5


def test_parts_add_up() -> None:
    scene, params = load("soft")
    name = "occluder.vertex_positions"
    given = {name: np.ones_like(params[name].numpy())}
    options = {"integrator": INTEGRATOR, "spp": 16, "seed": 3}
    parts = {k: v.numpy() for k, v in psdr.render_parts(scene, params, given, **options).items()}
    whole = psdr.render_forward(scene, params, given, **options).numpy()
    assert list(parts) == ["interior", "smooth", "edges"]
    assert not parts["smooth"].any() and np.abs(parts["edges"]).max() > 0.1
    np.testing.assert_allclose(sum(parts.values()), whole, atol=SUMMATION * np.abs(whole).max())


@pytest.mark.slow
def test_parts_of_a_linear_grid_add_up() -> None:
    """Creases and smooth silhouettes have samples of their own, so the sums agree within their errors."""
    scene, params = load("grid, lamp")
    given = {GRID: np.ones_like(params[GRID].numpy())}
    sums = []
    for seed in range(8):
        options = {"integrator": INTEGRATOR, "spp": 64, "seed": seed}
        parts = psdr.render_parts(scene, params, given, **options)
        whole = psdr.render_forward(scene, params, given, **{**options, "seed": 50 + seed}).numpy()
        sums.append([*(np.abs(part.numpy().astype(np.float64)).sum() for part in parts.values()), 0.0])
        sums[-1][3] = sum(float(part.numpy().sum()) for part in parts.values()) - float(whole.sum())
    means, errors = np.mean(sums, axis=0), np.std(sums, axis=0, ddof=1) / np.sqrt(8.0)
    assert (means[:3] > 10.0 * errors[:3]).all()
    assert abs(means[3]) < 4.0 * errors[3] < 0.1 * means[2]


def test_items_are_creases_or_not() -> None:
    scene, _params = load("grid, lamp")
    found = grid_items(scene, grid_shapes(scene), None)
    assert found is not None
    both = [only(found, creases) for creases in (True, False)]
    assert all(part is not None for part in both)
    kinds = [set((part.items.numpy()[:, 1] & 3).tolist()) for part in both]
    assert kinds == [{0, 1, 2}, {int(VOXEL_ITEM)}]
    assert sum(len(part.items) for part in both) == len(found.items)
    assert sum(part.aimed for part in both) == found.aimed


def test_what_has_no_parts_is_refused() -> None:
    scene, params = load("silhouette tent")
    with pytest.raises(ValueError, match="at least one tangent"):
        psdr.render_parts(scene, params, {})
