"""What moves in media that emit light: a sensing plane by quadrature, differences, and what moves together."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients.configs import aim, shift, widen
from tests.media import scenes
from tests.media.scenes import BLACK, T, camera, cube, grid, grids, lamp, puffs, rgb, square, volume, whole
from tests.media.test_boundary import (
    COLOURS,
    FOG,
    KD_TREE,
    OCTREE,
    PAINT,
    POSE,
    SIZE,
    SQUARE,
    STEP,
    assert_guided_equals_unguided,
    assert_mean,
    derivatives,
    difference,
)
from tests.media.test_grid_boundary import TURN

#: Some boxes end inside of their interface, and are meant to.
pytestmark = pytest.mark.filterwarnings("ignore:.* is not 0 at the border of its box")

BATCHES = 8
# ---- The sensing plane ----
#: Extinction of the fog; where the wall behind is; the emission's centre and width, and that of the plane's weight.
SIGMA, WALL, GLOW, WIDTH, SPOT = 0.7, 2.5, np.array([0.2, -0.1, 1.1]), 0.6, 0.4
#: The fog's box, its voxels, and the camera's position, from where nothing of the square is seen in front of the plane.
LOW, HIGH, VOXELS, EYE, FOV = (
    np.array([-2.2, -2.4, -0.5]),
    np.array([2.6, 2.2, 3.0]),
    (70, 92, 96),
    (2.2, 0.0, 0.6),
    70.0,
)
#: The black square: its centre and its half sides.
MIDDLE, U, V = np.array([0.1, 0.05, 1.0]), np.array([0.35, 0.0, 0.1]), np.array([0.0, 0.3, 0.0])
ACROSS = np.cross(U, V) / np.linalg.norm(np.cross(U, V))
#: Motion, derivative of the plane's weighted irradiance, interior term alone: by quadrature and differences.
PLANE = [
    (shift(1.0, 0.0, 0.0), -0.006531, -0.011271),
    (shift(*ACROSS), 0.156948, -0.011824),
    (widen, -0.096829, 0.159394),
]
FINE = 64
#: Means may be so many standard errors apart; of the plane's derivatives, the largest of these.
Z, NOISE = 4.0, 0.005


def sensing_plane():
    """A white plane under fog that shines about a point and absorbs, a black square between them."""
    box = T.translate(list(LOW)) @ T.scale(list(HIGH - LOW))
    axes = zip(VOXELS, LOW[::-1], HIGH[::-1], strict=True)
    centres = [low + (np.arange(n) + 0.5) / n * (high - low) for n, low, high in axes]
    z, y, x = np.meshgrid(*centres, indexing="ij")
    glow = np.exp(-((x - GLOW[0]) ** 2 + (y - GLOW[1]) ** 2 + (z - GLOW[2]) ** 2) / (2.0 * WIDTH**2))
    fog = {**grids(grid(np.full((1, 1, 1), SIGMA), box), 0.0), "emission": grid(glow, box), "id": "fog"}
    pose = np.eye(4)
    pose[:3] = np.stack([U, V, ACROSS, MIDDLE], axis=1)
    air = {"type": "ref", "id": "fog"}
    middle, half = 0.5 * (LOW + HIGH), 0.5 * (HIGH - LOW)
    return whole(
        fog=fog,
        sensor=camera(EYE, [0, 0, 0], FOV, FINE, medium=air),
        border={**cube(air), "to_world": T.translate(list(middle)) @ T.scale(list(half))},
        plane=square(0.0, 1.6, {"type": "diffuse", "reflectance": 1.0}),
        wall=square(WALL, 2.1, BLACK, flipped=True),
        square={"type": "rectangle", "to_world": T(pose), "bsdf": {"type": "twosided", "bsdf": BLACK}},
    )


def plane_weights(scene, fine=4):
    """The adjoint of the image that sums the irradiance of the plane by its weight."""
    pose = psdr.traverse(scene)["sensor.to_world"].numpy().reshape(4, 4).astype(np.float64)
    n = FINE * fine
    u = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    half = np.tan(np.radians(0.5 * FOV))
    x, y = np.meshgrid(-half * u, -half * u)
    d = np.stack([x, y, np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    on_film = (2.0 * half / n) ** 2  # area, at distance 1
    t = np.where(d[..., 2] < -1e-3, -EYE[2] / np.minimum(d[..., 2], -1e-3), 0.0)
    length = t * np.linalg.norm(d, axis=-1)
    at = np.array(EYE) + t[..., None] * d
    area = on_film * t**3 / EYE[2]  # (t^2 / cos) dA: the plane's cosine is EYE z / length, the film's 1 / |d|
    weight = np.exp(-(at[..., 0] ** 2 + at[..., 1] ** 2) / (2.0 * SPOT**2)) * np.pi * area * np.exp(SIGMA * length)
    weight = np.where(t > 0.0, weight, 0.0).reshape(FINE, fine, FINE, fine).sum(axis=(1, 3))
    return np.repeat(weight[..., None] / 3.0, 3, axis=2).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["auto", None], ids=["whole", "interior"])
def test_a_square_moves_above_a_sensing_plane(boundary):
    """Sums and interior terms; with the radiance behind the square alone its edges would have .0140, .0294, .0626."""
    scene = psdr.load_dict(sensing_plane())
    found = derivatives(scene, [SQUARE], plane_weights(scene), boundary, spp=256, depth=2, batches=BATCHES)
    pose = psdr.traverse(scene)[SQUARE].numpy()
    for motion, total, interior in PLANE:
        expected = interior if boundary is None else total
        samples = [(g[0] * motion(pose)).sum() for g in found]
        # Voxels have the emission to .002.
        error = np.hypot(np.std(samples, ddof=1) / np.sqrt(BATCHES), 0.002 * abs(expected))
        assert abs(np.mean(samples) - expected) < Z * error, (np.mean(samples), expected, error)
        assert error < NOISE, "too noisy to tell"


# ---- Differences ----
RAMP = 1.0 + 0.5 * np.linspace(-1, 1, SIZE)[:, None] + 0.3 * np.linspace(-1, 1, SIZE)[:, None, None]
ADJOINT = (RAMP * COLOURS).astype(np.float32)
FLOOR = square(-1.3, 1.6, {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.3)})
GLOWING = {**FOG, "emission": volume((0.9, 0.6, 0.4))}
PUFFS = scenes.grid(0.2 + 2.0 * puffs(8))
PLACE = {"to_world": TURN @ PUFFS["to_world"]}
FLAMES = scenes.grid(4.0 * np.random.default_rng(2).uniform(0.0, 1.0, (3, 3, 4, 3)))
SMOKE = {**grids(PUFFS | PLACE, 0.8, g=0.3), "emission": FLAMES | PLACE}
SIGMA_POSE, FLAMES_POSE = (f"fog.interior_medium.{name}.to_world" for name in ("sigma_t", "emission"))


def fire(medium, light):
    """The square of ``test_boundary.py`` in a cube that shines, above a floor."""
    parts = {
        "sensor": camera([4, 1.0, 0.6], [0, 0, 0], 38.0, SIZE),
        "fog": cube(medium, turn=15.0, scale=1.0 if medium is GLOWING else 1.15),
        "square": {"type": "rectangle", "to_world": POSE, "bsdf": PAINT},
        "floor": FLOOR,
    }
    if light:
        parts["lamp"] = lamp(2.2, 0.5, (2.0, 2.0, 2.0))
    return psdr.load_dict(whole(**parts))


#: Step of differences where the smoke's box moves, whose edges the camera sees: at ``STEP`` they are 4 % off.
BOX_STEP = 0.01
#: Medium, with a lamp, depth, parameter, direction, largest share of noise.
ROWS = [
    ("fog", False, 2, SQUARE, widen, 0.02),
    ("fog", False, 2, SQUARE, aim(0, 1, 0), 0.02),
    ("fog", True, 3, SQUARE, aim(0, 1, 0), 0.02),
    ("fog", True, 3, "floor.to_world", shift(0, 0, 1), 0.02),
    ("smoke", False, 3, SQUARE, widen, 0.02),
    ("smoke", False, 3, SQUARE, aim(0, 1, 0), 0.02),
    ("smoke", False, 3, SIGMA_POSE, shift(0, 0.3, 1), 0.03),
    ("smoke", False, 3, FLAMES_POSE, shift(0, 0.3, 1), 0.03),
]
IDS = [f"{i}-{row[0]}-{row[3]}" for i, row in enumerate(ROWS)]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:samples that were not finite")  # rays through the cube's own edges
@pytest.mark.parametrize(
    ("medium", "light", "depth", "name", "motion", "noise"),
    ROWS,
    ids=IDS,
)
def test_derivative_equals_finite_differences(medium, light, depth, name, motion, noise):
    """Of a weighted sum of pixels; forward mode is the transpose."""
    scene = fire({"fog": GLOWING, "smoke": SMOKE}[medium], light)
    params = psdr.traverse(scene)
    tangent = motion(params[name].numpy())
    step = BOX_STEP if name == SIGMA_POSE else STEP
    images = [difference(scene, name, tangent, depth, 4096, 1 + i, step) for i in range(BATCHES)]
    expected = [(ADJOINT * image).sum() for image in images]
    error = np.std(expected, ddof=1) / np.sqrt(BATCHES)
    names = [SQUARE, "floor.to_world", *([SIGMA_POSE, FLAMES_POSE] if medium == "smoke" else [])]
    grads = derivatives(scene, names, ADJOINT, spp=1024, depth=depth, batches=BATCHES)
    assert_mean([(g[names.index(name)] * tangent).sum() for g in grads], np.mean(expected), error, noise)
    tangents = dict.fromkeys(names, 0.0) | {name: tangent}
    image = psdr.render_forward(
        scene, params, tangents, integrator=psdr.PathIntegrator(max_depth=depth), spp=16, seed=50
    ).numpy()
    once = derivatives(scene, names, ADJOINT, spp=16, depth=depth, batches=1)[0][names.index(name)]
    np.testing.assert_allclose((ADJOINT * image).sum(), (once * tangent).sum(), rtol=2e-3)


#: With a lamp, depth, method.
GUIDED = [
    (False, 2, psdr.boundary.PathSpace(guiding=OCTREE)),
    (True, 3, psdr.boundary.PathSpace(guiding=KD_TREE)),
    (True, 3, psdr.boundary.Projective(guiding=OCTREE)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("light", "depth", "method"), GUIDED, ids=["unlit", "k-d tree", "projective"])
def test_guided_equals_unguided(light, depth, method):
    """Where the fog shines, light does not come from lamps alone: directions that aim at none are guided, too."""
    assert_guided_equals_unguided(fire(GLOWING, light), method, depth)
