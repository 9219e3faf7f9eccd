"""The étendue between two squares that grids block, for tests of what samples their silhouettes."""

import numpy as np
import warp as wp
from scipy.stats import chi2

import warp_psdr as psdr
from tests.path.test_sdfgrid import nodes
from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.kernels.primitive.dispatch import make_hit
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.topology.kinds.grid_silhouettes import grid_items, grid_shapes

HIT = make_hit((LINEAR_GRID.number, CUBIC_GRID.number))
#: Batches of an estimate, whose deviation tells its error.
BATCHES = 20
#: Standard errors of a comparison of two estimates.
LIMIT = 4.0
#: The squares of the étendue: heights of receiver and light, half their sides, about (.5, .5).
LOW, HIGH, HALF = wp.constant(-0.2), wp.constant(1.2), wp.constant(0.6)
#: Bins of lines that touch: the octant of the point about a middle, and the axis that is nearest to the direction.
BINS = 48


@wp.func
def bin_of(p: wp.vec3, w: wp.vec3) -> wp.float64:
    """Number of the bin of a line that touches at p, from the middle, and runs along w."""
    n = wp.where(p[0] > 0.0, 1, 0) + wp.where(p[1] > 0.0, 2, 0) + wp.where(p[2] > 0.0, 4, 0)
    axis = wp.argmax(wp.vec3(wp.abs(w[0]), wp.abs(w[1]), wp.abs(w[2])))
    return wp.float64(6 * n + 2 * wp.int32(axis) + wp.where(w[wp.int32(axis)] > 0.0, 1, 0))


@wp.func
def is_free(scene: Scene, x: wp.vec3, out: wp.vec3, w: wp.vec3) -> wp.bool:
    """Whether a line passes from square to square."""
    if w[2] <= 1.0e-4:
        return False
    up = (HIGH - x[2]) / w[2]
    down = (x[2] - LOW) / w[2]
    y = x + up * w
    z = x - down * w
    beside = wp.max(wp.max(wp.abs(y[0] - 0.5), wp.abs(y[1] - 0.5)), wp.max(wp.abs(z[0] - 0.5), wp.abs(z[1] - 0.5)))
    if beside > HALF:
        return False
    tri = triangle_at(scene, 0)
    o = x + 1.0e-5 * out
    return HIT(scene, tri, o, w, up).face < 0 and HIT(scene, tri, o, -w, down).face < 0


@wp.kernel(module="unique", enable_backward=False)
def block(more: Scene, less: Scene, seed: wp.int32, out: wp.array(dtype=wp.float64)):
    t = wp.tid()
    state = wp.rand_init(seed, t)
    x = wp.vec3(0.5 + HALF * (2.0 * wp.randf(state) - 1.0), 0.5 + HALF * (2.0 * wp.randf(state) - 1.0), LOW)
    y = wp.vec3(0.5 + HALF * (2.0 * wp.randf(state) - 1.0), 0.5 + HALF * (2.0 * wp.randf(state) - 1.0), HIGH)
    length = wp.length(y - x)
    d = (y - x) / length
    a = wp.where(HIT(more, triangle_at(more, 0), x, d, length).face >= 0, 1.0, 0.0)
    b = wp.where(HIT(less, triangle_at(less, 0), x, d, length).face >= 0, 1.0, 0.0)
    area = 16.0 * HALF * HALF * HALF * HALF
    out[t] = wp.float64(area * d[2] * d[2] / (length * length) * (a - b))


def shapes(count: int) -> np.ndarray:
    """Two spheres, blended."""
    x, y, z = nodes(count)
    a = np.sqrt((x - 0.38) ** 2 + (y - 0.45) ** 2 + (z - 0.5) ** 2) - 0.22
    b = np.sqrt((x - 0.66) ** 2 + (y - 0.55) ** 2 + (z - 0.5) ** 2) - 0.17
    return (-0.05 * np.log(np.exp(-a / 0.05) + np.exp(-b / 0.05)))[..., None].astype(np.float32)


def growth(count: int) -> np.ndarray:
    x, y, _z = nodes(count)
    return -(1.0 + 0.5 * np.sin(5.0 * x) * np.cos(4.0 * y))[..., None]


def loaded(grid: np.ndarray, pose: np.ndarray | None = None, **kind: str) -> psdr.Scene:
    body = {"type": "sdfgrid", "grid": grid, **kind}
    if pose is not None:
        body["to_world"] = psdr.Transform(pose)
    return psdr.load_dict(
        {"type": "scene", "body": body, "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
    )


def spread(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean of samples (N, ...), and its standard error."""
    means = samples.reshape(BATCHES, -1, *samples.shape[1:]).mean(axis=1)
    return means.mean(axis=0), means.std(axis=0, ddof=1) / np.sqrt(BATCHES)


def assert_shares_agree(techniques: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Chi-square test of two samplers of one measure: weights (N,) and their bins (N,) of each."""
    means, variances, told = [], [], np.ones(BINS, bool)
    for weights, bins in techniques:
        places = bins.astype(int)
        mean, square = (np.bincount(places, weights**k, minlength=BINS) / len(weights) for k in (1, 2))
        means.append(mean)
        variances.append((square - mean * mean) / len(weights))
        # Of fewer samples errors are not normal.
        told &= np.bincount(places[weights > 0.0], minlength=BINS) >= 50
    assert told.sum() >= BINS // 2, told
    squares = (means[0] - means[1])[told] ** 2 / (variances[0] + variances[1])[told]
    assert squares.sum() < chi2.ppf(1.0 - 1e-4, told.sum()), (squares.round(1), *means)


def touches(
    touch: wp.Kernel, shape: tuple[int, int], scene: psdr.Scene, tangent: np.ndarray | float, towards: int, seed: int
) -> np.ndarray:
    """What a kernel writes, (samples, columns); ``tangent``: of the values of the grid."""
    tangents = np.zeros(len(scene.values), np.float32)
    p = scene.parameters["body.grid"]
    tangents[p.offset : p.offset + p.size] = np.ravel(tangent)
    found = grid_items(scene, grid_shapes(scene), None)
    assert found is not None
    out = wp.zeros(shape, dtype=wp.float64, device="cpu")
    inputs = [scene.data(), found, wp.array(tangents, dtype=wp.float32, device="cpu"), towards, seed]
    wp.launch(touch, dim=shape[0], inputs=inputs, outputs=[out], device="cpu")
    return out.numpy()


def sums(
    touch: wp.Kernel, shape: tuple[int, int], scene: psdr.Scene, tangent: np.ndarray | float, towards: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Means and their standard errors, of the columns that a kernel writes."""
    return spread(touches(touch, shape, scene, tangent, towards, seed))


def blocked(grid: np.ndarray, tangent: np.ndarray, **kind: str) -> tuple[float, float]:
    """The derivative of what is blocked by differences of the same rays, and its standard error."""
    rays, step = 2_000_000, 0.002
    out = wp.zeros(rays, dtype=wp.float64, device="cpu")
    more, less = (loaded((grid + k * step * tangent).astype(np.float32), **kind) for k in (1.0, -1.0))
    wp.launch(block, dim=rays, inputs=[more.data(), less.data(), 5], outputs=[out], device="cpu")
    mean, error = spread(out.numpy() / (2.0 * step))
    return float(mean), float(error)
