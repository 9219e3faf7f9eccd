"""The boundary term beside grids of voxels: a tilted square in smoke, against differences and against fog.

The smoke's box ends before its interface, and its density does not vanish there.
"""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients.configs import aim, shift, widen
from tests.media import scenes
from tests.media.scenes import T, camera, cube, grids, puffs, whole
from tests.media.test_boundary import (
    COLOURS,
    FOG,
    LIGHTS,
    NORMAL,
    PAINT,
    POSE,
    SIZE,
    SQUARE,
    assert_mean,
    derivatives,
    difference,
)

#: Some boxes end inside of their interface, and are meant to.
pytestmark = pytest.mark.filterwarnings("ignore:.* is not 0 at the border of its box")

TURN = T.rotate([0, 0, 1], 15.0)
DENSITY = 0.2 + 2.0 * puffs(8)
ALBEDO = np.random.default_rng(1).uniform(0.2, 0.95, (3, 4, 5, 3))
SIGMA = "smoke.interior_medium.sigma_t.to_world"
COLOUR = "smoke.interior_medium.albedo.to_world"
ALL = [SQUARE, "floor.to_world", "lamp.to_world", "sensor.to_world", SIGMA, COLOUR]
RAMP = 1.0 + 0.5 * np.linspace(-1, 1, SIZE)[:, None] + 0.3 * np.linspace(-1, 1, SIZE)[:, None, None]
ADJOINT = (RAMP * COLOURS).astype(np.float32)
BATCHES = 8
#: Of two media that are one.
Z = 4.0


def grid(values):
    found = scenes.grid(values)
    return found | {"to_world": TURN @ found["to_world"]}


def curtain(medium, light, scale=1.15):
    parts = {
        "sensor": camera([4, 1.0, 0.6], [0, 0, 0], 38.0, SIZE),
        "smoke": cube(medium, turn=15.0, scale=scale),
        "square": {"type": "rectangle", "to_world": POSE, "bsdf": PAINT},
    }
    return psdr.load_dict(whole(**parts, **LIGHTS[light]))


def smoke():
    return grids(grid(DENSITY), grid(ALBEDO), g=0.3)


@pytest.mark.slow
def test_nothing_changes_where_all_moves_together():
    """Sample by sample, also what rides on the box of the grid, and what the smoke emits."""
    shining = grid(np.random.default_rng(2).uniform(0.0, 2.0, (3, 3, 4, 3)))
    scene = curtain({**smoke(), "emission": shining}, "area")
    names = [*ALL, "smoke.interior_medium.emission.to_world"]
    motion = shift(0.3, -0.5, 0.8)
    adjoint = np.ones((SIZE, SIZE, 3), np.float32)
    parts = [(g * motion(g)).sum() for g in derivatives(scene, names, adjoint, spp=16, depth=3, batches=1)[0]]
    assert min(map(abs, parts)) > 0.0
    assert abs(sum(parts)) < 2e-4 * max(map(abs, parts)), parts


#: Light, depth, parameter, direction.
ROWS = [
    ("point", 2, SQUARE, widen, "grows"),
    ("point", 2, SQUARE, NORMAL, "along its normal"),
    ("point", 2, "bulb.position", shift(0, 0, 1), "moves away"),
    ("point", 2, SIGMA, shift(0, 0, 1), "moves up"),
    ("area", 3, SQUARE, NORMAL, "along its normal"),
    ("area", 3, SQUARE, aim(0, 1, 0), "turns"),
    ("area", 3, "floor.to_world", shift(0, 0, 1), "moves up"),
    ("area", 3, "lamp.to_world", shift(0, 0, 1), "moves away"),
    ("area", 3, SIGMA, aim(0.3, 1, 0), "turns"),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "depth", "name", "motion", "what"), ROWS, ids=[f"{r[0]}-{r[2]}-{r[4]}" for r in ROWS]
)
def test_derivative_equals_finite_differences(light, depth, name, motion, what):
    """Of a weighted sum of pixels; forward mode is the transpose."""
    scene = curtain(smoke(), light)
    params = psdr.traverse(scene)
    tangent = motion(params[name].numpy())
    expected = [(ADJOINT * difference(scene, name, tangent, depth, 8192, 1 + i)).sum() for i in range(BATCHES)]
    error = np.std(expected, ddof=1) / np.sqrt(BATCHES)
    names = ALL if light == "area" else [SQUARE, "bulb.position", SIGMA]
    grads = derivatives(scene, names, ADJOINT, spp=512, depth=depth, batches=BATCHES)
    found = [(g[names.index(name)] * tangent).sum() for g in grads]
    assert_mean(found, np.mean(expected), error, noise=0.03)
    tangents = dict.fromkeys(names, 0.0) | {name: tangent}
    options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": 16, "seed": 50}
    image = psdr.render_forward(scene, params, tangents, **options).numpy()
    once = derivatives(scene, names, ADJOINT, spp=16, depth=depth, batches=1)[0][names.index(name)]
    np.testing.assert_allclose((ADJOINT * image).sum(), (once * tangent).sum(), rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("light", "depth"), [("point", 2), ("area", 3)])
def test_a_constant_grid_is_fog(light, depth):
    """The pose of the interface of one is the pose of the other's grid."""
    flat = grids(grid(np.ones((2, 2, 2, 3)) * np.array([0.8, 0.6, 1.0])), (0.9, 0.8, 0.7), g=0.3)
    others = {"point": ["bulb.position"], "area": ["lamp.to_world", "floor.to_world", "sensor.to_world"]}[light]
    found = []
    for scene, place in ((curtain(FOG, light, 1.0), "smoke.to_world"), (curtain(flat, light), SIGMA)):
        names = [SQUARE, *others, place]
        grads = derivatives(scene, names, ADJOINT, spp=512, depth=depth, batches=BATCHES)
        found.append([])
        for g in grads:
            rows = [(g[0] * NORMAL(g[0])).sum()]
            pose = np.array(POSE.matrix)
            rows += [(g[0] * motion(pose)).sum() for motion in (widen, aim(0, 1, 0))]
            rows += [(grad * shift(0.2, 0.1, 1.0)(grad)).sum() for grad in g[1:]]
            found[-1].append(rows)
    one, other = (np.array(f) for f in found)
    spread = np.sqrt((one.var(axis=0, ddof=1) + other.var(axis=0, ddof=1)) / BATCHES)
    gap = np.abs(one.mean(axis=0) - other.mean(axis=0))
    assert (gap < Z * spread).all(), (one.mean(axis=0), other.mean(axis=0), spread)
    assert (spread < 0.05 * np.abs(one.mean(axis=0)).max()).all(), spread
