"""The boundary term in homogeneous media: a tilted square in a cube of fog, against quadrature and differences.

The light curtain has closed silhouettes of both kinds: what the camera sees, and what volume vertices see of the light.
Motions in the square's plane would hide wrong terms, so one is along its normal.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import warp_psdr as psdr
from tests.gradients.configs import aim, shift, widen
from tests.media.scenes import T, camera, cube, grid, grids, lamp, medium, point, puffs, rgb, sky, square, whole
from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.edges_there import edges_there

#: Some boxes end inside of their interface, and are meant to.
pytestmark = pytest.mark.filterwarnings("ignore:.* is not 0 at the border of its box")

#: Few pixels where sums are compared, and small ones for differences: an edge that crosses their borders is not linear.
SIZE, FINE, BATCHES = 16, 64, 6
SQUARE = "square.to_world"
TILT = np.radians(25.0)
NORMAL = shift(np.sin(TILT), 0.0, np.cos(TILT))
#: Weights of the channels, summed over the pixels.
COLOURS = np.array([1.0, 0.7, 0.4])
#: Derivatives of that sum for the point light by quadrature: with their shadows' exact ends, 490,000 rays of 24 points
#: on each lit stretch, and 200 points on each edge of the square as it is seen.
BULB = np.array([-2.6472, np.nan, -10.9022])
BY_QUADRATURE = [(widen, 0.52288), (aim(0, 1, 0), 1.23087)]
#: Of the batches' mean from the expected one, in standard errors.
Z = 4.0
STEP = 0.04


POSE = T.translate([0.1, 0.05, 0.3]) @ T.rotate([0, 1, 0], 25.0) @ T.scale(0.45)
PAINT = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(0.3, 0.2, 0.1)}}
FOG = medium((0.8, 0.6, 1.0), (0.9, 0.8, 0.7), g=0.3)


def curtain(size=SIZE, **lights):
    """A cube of fog with a tilted square in it, below a light."""
    parts = {
        "sensor": camera([4, 1.0, 0.6], [0, 0, 0], 38.0, size),
        "fog": cube(FOG, turn=15.0),
        "square": {"type": "rectangle", "to_world": POSE, "bsdf": PAINT},
    }
    return psdr.load_dict(whole(**(parts | (lights or {"bulb": point([0.3, 0.2, 2.2], (6.0, 5.0, 4.0))}))))


def derivatives(scene, names, adjoint, boundary="auto", spp=512, depth=2, batches=BATCHES):
    """Return the gradients of the weighted image by the names, one list a batch."""
    psdr.guiding.set_automatic(scene, False)  # batches are not repeated gradients of a fit
    params = psdr.traverse(scene)
    params.requires_grad_only(*names)
    integrator = psdr.PathIntegrator(max_depth=depth, boundary=boundary)
    found = []
    for seed in range(batches):
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=50 + seed)
        found.append([params[name].grad.numpy().astype(np.float64) for name in names])
    return found


def difference(scene, name, tangent, depth, spp, seed, step=STEP):
    """Return the central difference of the image, float64."""
    params = psdr.traverse(scene)
    base = params[name].numpy().copy()
    images = []
    for side in (1.0, -1.0):
        params[name] = (base + side * step * tangent).astype(np.float32)
        params.update()
        images.append(psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=depth), spp=spp, seed=seed).numpy())
    params[name] = base
    params.update()
    return (images[0].astype(np.float64) - images[1]) / (2.0 * step)


def assert_mean(samples, expected, error=0.0, noise=0.02):
    spread = np.hypot(np.std(samples, ddof=1) / np.sqrt(len(samples)), error)
    assert abs(np.mean(samples) - expected) < Z * spread, (np.mean(samples), expected, spread)
    assert spread < noise * abs(expected), "too noisy to tell"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:samples that were not finite")  # rays through the cube's own edges
def test_a_bulb_moves_above_a_square_that_grows_and_turns():
    """Against quadrature; where the square grows, both boundaries are twice as large as their sum."""
    adjoint = np.broadcast_to(COLOURS, (SIZE, SIZE, 3)).astype(np.float32)
    scene = curtain()
    pose = psdr.traverse(scene)[SQUARE].numpy()
    found = derivatives(scene, ["bulb.position", SQUARE], adjoint)
    for axis in (0, 2):
        assert_mean([g[0][axis] for g in found], BULB[axis])
    for motion, expected in BY_QUADRATURE:
        assert_mean([(g[1] * motion(pose)).sum() for g in found], expected)


LIGHTS = {
    "point": {"bulb": point([0.3, 0.2, 2.2], (6.0, 5.0, 4.0))},
    "area": {
        "lamp": lamp(2.2, 0.5),
        "floor": square(-1.3, 1.6, {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.3)}),
    },
    "sun": {"sun": {"type": "directional", "direction": [-0.2, -0.3, -1.0], "irradiance": rgb(1.0, 2.0, 3.0)}},
    "sky": {"sky": sky(1.0, 0.8, 0.6)},
}
VIEW = camera([4, 1.0, 0.6], [0, 0, 0], 38.0, FINE)
LIGHTS["area, parallel"] = LIGHTS["area"] | {
    "sensor": {"type": "orthographic", "to_world": VIEW["to_world"] @ T.scale([1.4, 1.4, 1.0]), "film": VIEW["film"]}
}
#: Light, depth, direction.
ROWS = [
    ("point", 2, NORMAL, "along its normal"),
    ("point", 2, widen, "grows"),
    ("area", 2, NORMAL, "along its normal"),
    ("area", 2, aim(0, 1, 0), "turns"),
    ("area", 2, widen, "grows"),
    ("area, parallel", 2, NORMAL, "along its normal"),
    ("sky", 3, widen, "grows"),
]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:samples that were not finite")
@pytest.mark.parametrize(("light", "depth", "motion", "what"), ROWS, ids=lambda x: x if isinstance(x, str) else "")
def test_derivative_equals_finite_differences(light, depth, motion, what):
    """Of smoothly weighted images, in both modes."""
    name = SQUARE
    scene = curtain(FINE, **LIGHTS[light])
    params = psdr.traverse(scene)
    tangent = motion(params[name].numpy())
    weights = gaussian_filter(difference(scene, name, tangent, depth, 128, 0), (9.0, 9.0, 0.0))
    weights /= np.abs(weights).max()
    expected = [(weights * difference(scene, name, tangent, depth, 128, 1 + i)).sum() for i in range(BATCHES)]
    error = np.std(expected, ddof=1) / np.sqrt(BATCHES)
    adjoint = weights.astype(np.float32)
    found = [(g[0] * tangent).sum() for g in derivatives(scene, [name], adjoint, spp=32, depth=depth)]
    assert_mean(found, np.mean(expected), error)
    inside = [(g[0] * tangent).sum() for g in derivatives(scene, [name], adjoint, boundary=None, spp=32, depth=depth)]
    assert abs(np.mean(inside) / np.mean(expected) - 1.0) > 0.2, "the boundary term does not show"
    image = psdr.render_forward(
        scene, params, {name: tangent}, integrator=psdr.PathIntegrator(max_depth=depth), spp=32, seed=50
    ).numpy()
    np.testing.assert_allclose((weights * image).sum(), found[0], rtol=1e-3)


def room(inside):
    """The square below a lamp and above a floor: in a cube of fog, or all in fog with the camera."""
    parts = {"sensor": camera([4, 1.0, 0.6], [0, 0, 0], 38.0, SIZE), "fog": cube(FOG, turn=15.0)}
    if inside:
        air = {"type": "ref", "id": "air"}
        parts = {
            "air": {**FOG, "id": "air", "scale": 0.4},
            "sensor": camera([2.0, 0.6, 0.4], [0, 0, 0], 50.0, SIZE, medium=air),
            "fog": cube(air, scale=4.0),
        }
    return psdr.load_dict(
        whole(**parts, **LIGHTS["area"], square={"type": "rectangle", "to_world": POSE, "bsdf": PAINT})
    )


ALL = [SQUARE, "floor.to_world", "lamp.to_world", "sensor.to_world", "fog.to_world"]


@pytest.mark.slow
def test_nothing_changes_where_all_moves_together():
    """Sample by sample, whatever vertices in the fog ride on, and at any depth."""
    scene = room(inside=True)
    motion = shift(0.3, -0.5, 0.8)
    adjoint = np.ones((SIZE, SIZE, 3), np.float32)
    parts = [(g * motion(g)).sum() for g in derivatives(scene, ALL, adjoint, spp=16, depth=4, batches=1)[0]]
    assert min(map(abs, parts)) > 0.0
    assert abs(sum(parts)) < 2e-4 * max(map(abs, parts)), parts


#: In the fog or not, parameter, direction, largest share of noise.
DEEP = [
    (False, SQUARE, widen, 0.02),
    (False, "lamp.to_world", shift(0.0, 0.0, 1.0), 0.02),
    (True, SQUARE, aim(0, 1, 0), 0.05),
]


@pytest.mark.slow
@pytest.mark.parametrize(("inside", "name", "motion", "noise"), DEEP, ids=["grows", "lamp", "inside"])
def test_longer_paths_equal_finite_differences(inside, name, motion, noise):
    """Of a weighted sum of pixels, with light that is scattered up to three times."""
    scene = room(inside)
    params = psdr.traverse(scene)
    tangent = motion(params[name].numpy())
    ramp = 1.0 + 0.5 * np.linspace(-1, 1, SIZE)[:, None] + 0.3 * np.linspace(-1, 1, SIZE)[:, None, None]
    adjoint = (ramp * COLOURS).astype(np.float32)
    expected = [(adjoint * difference(scene, name, tangent, 4, 2048, 1 + i)).sum() for i in range(BATCHES)]
    error = np.std(expected, ddof=1) / np.sqrt(BATCHES)
    found = [(g[ALL.index(name)] * tangent).sum() for g in derivatives(scene, ALL, adjoint, spp=1024, depth=4)]
    assert_mean(found, np.mean(expected), error, noise)
    tangents = dict.fromkeys(ALL, 0.0) | {name: tangent}
    options = {"integrator": psdr.PathIntegrator(max_depth=4), "spp": 16, "seed": 50}
    image = psdr.render_forward(scene, params, tangents, **options).numpy()
    once = derivatives(scene, ALL, adjoint, spp=16, depth=4, batches=1)[0][ALL.index(name)]
    np.testing.assert_allclose((adjoint * image).sum(), (once * tangent).sum(), rtol=2e-3)


def assert_guided_equals_unguided(scene, method, depth):
    """Compare the derivatives by three motions of the square."""
    at = psdr.traverse(scene)[SQUARE].numpy()
    adjoint = np.broadcast_to(COLOURS, (SIZE, SIZE, 3)).astype(np.float32)
    found = []
    for boundary in (psdr.boundary.PathSpace(), method):
        grads = derivatives(scene, [SQUARE], adjoint, boundary, spp=512, depth=depth)
        found.append(np.array([[(g[0] * motion(at)).sum() for motion in (NORMAL, widen, aim(0, 1, 0))] for g in grads]))
    spread = np.std(found[1] - found[0], axis=0, ddof=1) / np.sqrt(BATCHES)  # all but the shadows is equal
    plain, guided = (f.mean(axis=0) for f in found)
    assert (np.abs(guided - plain) < Z * spread).all(), (plain, guided, spread)
    assert (spread < 0.05 * np.abs(plain).max()).all(), "too noisy to tell"


KD_TREE, OCTREE = psdr.guiding.KdTree(max_leaves=4096), psdr.guiding.Octree(max_leaves=4096)
GUIDED = {
    "k-d tree": psdr.boundary.PathSpace(guiding=KD_TREE),
    "octree": psdr.boundary.PathSpace(guiding=OCTREE),
    "projective": psdr.boundary.Projective(guiding=OCTREE),
    "uniform": psdr.boundary.Projective(guiding=None),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", GUIDED.values(), ids=GUIDED)
def test_guided_equals_unguided(method):
    """Light that is scattered once or twice, by surfaces and by the fog."""
    assert_guided_equals_unguided(curtain(SIZE, **LIGHTS["area"]), method, 3)


@pytest.mark.parametrize(
    ("parts", "integrator", "words"),
    [
        ({}, {"boundary": psdr.boundary.PathSpace(guiding=psdr.guiding.Grid())}, r"use guiding\.KdTree"),
        ({}, {"hide_emitters": True}, "show the lights"),
        (
            {"smoke": cube(grids(grid(puffs(4), filter_type="nearest")), translate=(9, 9, 9))},
            {},
            "make its filter 'trilinear'",
        ),
    ],
    ids=["guiding", "hidden", "grid"],
)
def test_what_is_not_estimated_is_refused(parts, integrator, words):
    scene = curtain(**LIGHTS["area"], **parts)
    options = {"max_depth": 2} | integrator
    with pytest.raises(ValueError, match=words):
        psdr.plan(scene, names=[SQUARE, "sensor.to_world"], integrator=psdr.PathIntegrator(**options))


def test_interfaces_are_no_edges():
    scene = curtain()
    lines = str(psdr.plan(scene, names=[SQUARE], integrator=psdr.PathIntegrator(max_depth=2)))
    assert "line search" not in lines
    assert len(edges_there(scene).length) < len(scene_adjacency(scene).length)
