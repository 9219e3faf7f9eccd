"""boundary.EdgeSampling() in media: against differences, boundary.PathSpace(), quadrature, and its own transpose."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients.configs import aim, shift, widen
from tests.media import test_glow_boundary as glow
from tests.media import test_grid_boundary as smoke
from tests.media.scenes import T, camera, cube, whole
from tests.media.test_boundary import (
    ALL,
    BATCHES,
    FOG,
    LIGHTS,
    NORMAL,
    PAINT,
    SIZE,
    SQUARE,
    Z,
    assert_mean,
    curtain,
    derivatives,
    difference,
    room,
)

#: Some boxes end inside of their interface, and are meant to.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:.* is not 0 at the border of its box"),
    pytest.mark.filterwarnings("ignore:samples that were not finite"),  # rays through the cube's own edges
]

EDGES, PATHS = psdr.boundary.EdgeSampling(), psdr.boundary.PathSpace()
TURNS, UP, ASIDE = aim(0, 1, 0), shift(0.0, 0.0, 1.0), shift(0.0, 1.0, 0.0)


def beside(x, z):
    """The square in front of the fog or behind it as the camera sees it, above a floor and below a lamp."""
    pose = T.translate([x, 0.05, z]) @ T.rotate([0, 1, 0], 25.0) @ T.scale(0.35)
    parts = {"sensor": camera([4, 1.0, 0.6], [0, 0, 0], 38.0, SIZE), "fog": cube(FOG, turn=15.0, scale=0.8)}
    return psdr.load_dict(
        whole(**parts, **LIGHTS["area"], square={"type": "rectangle", "to_world": pose, "bsdf": PAINT})
    )


SCENES = {
    "in fog": lambda: room(False),
    "all in fog": lambda: room(True),
    "in front": lambda: beside(1.5, 0.2),
    "behind": lambda: beside(-1.5, 0.3),
    "bulb": curtain,
    "sun": lambda: curtain(SIZE, **LIGHTS["sun"]),
    "sky": lambda: curtain(SIZE, **LIGHTS["sky"]),
    "smoke": lambda: smoke.curtain(smoke.smoke(), "area"),
    "fire": lambda: glow.fire(glow.GLOWING, False),
}


def test_nothing_changes_where_all_moves_together():
    """Sample by sample, whatever vertices in the fog ride on, and at any depth: blocks of vertices are kept."""
    scene = room(inside=True)
    motion = shift(0.3, -0.5, 0.8)
    adjoint = np.ones((SIZE, SIZE, 3), np.float32)
    for depth in (4, -1):
        parts = [(g * motion(g)).sum() for g in derivatives(scene, ALL, adjoint, EDGES, 16, depth, 1)[0]]
        assert min(map(abs, parts)) > 0.0
        assert abs(sum(parts)) < 2e-4 * max(map(abs, parts)), parts


#: Scene, depth, samples a pixel, parameter, direction, largest share of noise.
ROWS = [
    ("in fog", 2, 2048, SQUARE, NORMAL, 0.03),
    ("in fog", 4, 1024, SQUARE, NORMAL, 0.05),
    ("in fog", 4, 1024, SQUARE, widen, 0.03),
    ("in fog", 4, 1024, SQUARE, TURNS, 0.03),
    ("in fog", 4, 1024, "floor.to_world", UP, 0.02),
    ("in fog", 4, 1024, "lamp.to_world", UP, 0.02),
    ("all in fog", 4, 1024, SQUARE, TURNS, 0.05),
    ("all in fog", 4, 1024, "sensor.to_world", TURNS, 0.05),
    ("in front", 3, 1024, SQUARE, NORMAL, 0.05),
    ("in front", 3, 1024, SQUARE, ASIDE, 0.03),
    ("behind", 3, 1024, SQUARE, TURNS, 0.04),
    ("behind", 3, 1024, SQUARE, widen, 0.05),
    ("sky", 3, 1024, SQUARE, widen, 0.02),
    ("smoke", 3, 1024, SQUARE, widen, 0.05),
    ("fire", 3, 1024, SQUARE, TURNS, 0.05),
]


@pytest.mark.parametrize(
    ("name", "depth", "spp", "moved", "motion", "noise"), ROWS, ids=[f"{i}-{r[0]}-{r[3]}" for i, r in enumerate(ROWS)]
)
def test_derivative_equals_finite_differences(name, depth, spp, moved, motion, noise):
    """Of a weighted sum of pixels; the boundary term shows, and forward mode is the transpose."""
    scene = SCENES[name]()
    params = psdr.traverse(scene)
    tangent = motion(params[moved].numpy())
    images = [difference(scene, moved, tangent, depth, 4096, 1 + i) for i in range(BATCHES)]
    expected = [(glow.ADJOINT * image).sum() for image in images]
    error = np.std(expected, ddof=1) / np.sqrt(BATCHES)
    found = [(g[0] * tangent).sum() for g in derivatives(scene, [moved], glow.ADJOINT, EDGES, spp, depth)]
    assert_mean(found, np.mean(expected), error, noise)
    inside = [(g[0] * tangent).sum() for g in derivatives(scene, [moved], glow.ADJOINT, None, 64, depth)]
    assert abs(np.mean(inside) / np.mean(expected) - 1.0) > 0.03, "the boundary term does not show"
    integrator = psdr.PathIntegrator(max_depth=depth, boundary=EDGES)
    image = psdr.render_forward(scene, params, {moved: tangent}, integrator=integrator, spp=16, seed=50).numpy()
    once = derivatives(scene, [moved], glow.ADJOINT, EDGES, 16, depth, 1)[0][0]
    np.testing.assert_allclose((glow.ADJOINT * image).sum(), (once * tangent).sum(), rtol=2e-3)


#: Scene, depth, samples a pixel. With the camera in fog, path space has too heavy a tail to compare with.
PAIRS = [
    ("in fog", 2, 512),
    ("in fog", 4, 512),
    ("in front", 3, 256),
    ("behind", 3, 256),
    ("bulb", 3, 256),
    ("sun", 3, 256),
    ("sky", 3, 256),
    ("smoke", 3, 256),
    ("fire", 2, 256),
]


@pytest.mark.parametrize(("name", "depth", "spp"), PAIRS, ids=[f"{n}-{d}" for n, d, _s in PAIRS])
def test_edge_sampling_equals_path_space(name, depth, spp):
    """By independent batches, for three motions of the square."""
    scene = SCENES[name]()
    at = psdr.traverse(scene)[SQUARE].numpy()
    found = []
    for method in (PATHS, EDGES):
        grads = derivatives(scene, [SQUARE], glow.ADJOINT, method, spp, depth)
        found.append(np.array([[(g[0] * motion(at)).sum() for motion in (NORMAL, widen, TURNS)] for g in grads]))
    spread = np.std(found[1] - found[0], axis=0, ddof=1) / np.sqrt(BATCHES)  # the interior term is equal
    paths, edges = (f.mean(axis=0) for f in found)
    assert (np.abs(edges - paths) < Z * spread).all(), (paths, edges, spread)
    assert (spread < 0.15 * np.abs(paths).max()).all(), "too noisy to tell"


def test_a_square_moves_above_a_sensing_plane():
    """By quadrature: in fog that shines about a point, above which a black square moves."""
    scene = psdr.load_dict(glow.sensing_plane())
    found = derivatives(scene, [SQUARE], glow.plane_weights(scene), EDGES, 256, 2, glow.BATCHES)
    pose = psdr.traverse(scene)[SQUARE].numpy()
    for motion, total, _interior in glow.PLANE:
        samples = [(g[0] * motion(pose)).sum() for g in found]
        # Voxels have the emission to .002.
        error = np.hypot(np.std(samples, ddof=1) / np.sqrt(glow.BATCHES), 0.002 * abs(total))
        assert abs(np.mean(samples) - total) < Z * error, (np.mean(samples), total, error)
        assert error < glow.NOISE, "too noisy to tell"
