"""The boundary term in homogeneous media: a tilted square in a cube of fog, against quadrature and differences.

The light curtain has closed silhouettes of both kinds: what the camera sees, and what volume vertices see of the light.
Motions in the square's plane would hide wrong terms, so one is along its normal.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import warp_psdr as psdr
from tests.gradients.configs import aim, shift, widen
from tests.media.scenes import T, camera, cube, grid, grids, lamp, medium, point, puffs, rgb, square, whole
from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.edges_there import edges_there

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


def curtain(size=SIZE, **lights):
    """A cube of fog with a tilted square in it, below a light."""
    pose = T.translate([0.1, 0.05, 0.3]) @ T.rotate([0, 1, 0], 25.0) @ T.scale(0.45)
    paint = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(0.3, 0.2, 0.1)}}
    parts = {
        "sensor": camera([4, 1.0, 0.6], [0, 0, 0], 38.0, size),
        "fog": cube(medium((0.8, 0.6, 1.0), (0.9, 0.8, 0.7), g=0.3), turn=15.0),
        "square": {"type": "rectangle", "to_world": pose, "bsdf": paint},
    }
    return psdr.load_dict(whole(**parts, **(lights or {"bulb": point([0.3, 0.2, 2.2], (6.0, 5.0, 4.0))})))


def derivatives(scene, names, adjoint, boundary="auto", spp=512):
    """Return the gradients of the weighted image by the names, one list a batch."""
    params = psdr.traverse(scene)
    params.requires_grad_only(*names)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=boundary)
    found = []
    for seed in range(BATCHES):
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=50 + seed)
        found.append([params[name].grad.numpy().astype(np.float64) for name in names])
    return found


def assert_mean(samples, expected, error=0.0):
    spread = np.hypot(np.std(samples, ddof=1) / np.sqrt(len(samples)), error)
    assert abs(np.mean(samples) - expected) < Z * spread, (np.mean(samples), expected, spread)
    assert spread < 0.02 * abs(expected), "too noisy to tell"


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
}
#: Light, parameter, direction.
ROWS = [
    ("point", SQUARE, NORMAL, "along its normal"),
    ("point", SQUARE, widen, "grows"),
    ("area", SQUARE, NORMAL, "along its normal"),
    ("area", SQUARE, aim(0, 1, 0), "turns"),
    ("area", SQUARE, widen, "grows"),
]
STEP = 0.04


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:samples that were not finite")
@pytest.mark.parametrize(("light", "name", "motion", "what"), ROWS, ids=lambda x: x if isinstance(x, str) else "")
def test_derivative_equals_finite_differences(light, name, motion, what):
    """Of smoothly weighted images, in both modes."""
    scene = curtain(FINE, **LIGHTS[light])
    params = psdr.traverse(scene)
    base = params[name].numpy().copy()
    tangent = motion(base)

    def difference(seed):
        images = []
        for side in (1.0, -1.0):
            params[name] = (base + side * STEP * tangent).astype(np.float32)
            params.update()
            images.append(psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=2), spp=128, seed=seed).numpy())
        params[name] = base
        params.update()
        return (images[0].astype(np.float64) - images[1]) / (2.0 * STEP)

    weights = gaussian_filter(difference(0), (9.0, 9.0, 0.0))
    weights /= np.abs(weights).max()
    expected = [(weights * difference(1 + i)).sum() for i in range(BATCHES)]
    error = np.std(expected, ddof=1) / np.sqrt(BATCHES)
    adjoint = weights.astype(np.float32)
    found = [(g[0] * tangent).sum() for g in derivatives(scene, [name], adjoint, spp=32)]
    assert_mean(found, np.mean(expected), error)
    inside = [(g[0] * tangent).sum() for g in derivatives(scene, [name], adjoint, boundary=None, spp=32)]
    assert abs(np.mean(inside) / np.mean(expected) - 1.0) > 0.2, "the boundary term does not show"
    image = psdr.render_forward(
        scene, params, {name: tangent}, integrator=psdr.PathIntegrator(max_depth=2), spp=32, seed=50
    ).numpy()
    np.testing.assert_allclose((weights * image).sum(), found[0], rtol=1e-3)


@pytest.mark.parametrize(
    ("parts", "integrator", "words"),
    [
        ({}, {"max_depth": 3}, "set max_depth to 2"),
        ({}, {"boundary": psdr.boundary.Projective()}, r"use boundary\.PathSpace"),
        ({}, {"boundary": psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree())}, r"use boundary\.PathSpace"),
        ({}, {"hide_emitters": True}, "show the lights"),
        ({"ball": {"type": "sphere", "to_world": T.translate([0, 0, -3])}}, {}, "give face_normals"),
        ({"shelf": square(0.3, 0.4)}, {}, "move them apart"),
        ({"smoke": cube(grids(grid(puffs(4))), translate=(9, 9, 9))}, {}, "make the media 'homogeneous'"),
    ],
    ids=["depth", "projective", "guiding", "hidden", "normals", "pierced", "grid"],
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
