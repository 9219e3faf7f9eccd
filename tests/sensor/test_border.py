"""Pixel filters at the border of the film: with and without samples beyond it, in closed form."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import assert_mean
from tests.sensor.test_film import FILTERS

SIZE = 8
#: Of a quotient of sums of equal terms, relative.
ROUNDING = 2e-7
#: Biases of the image, a quotient of two sums over some 1e4 samples, and of its tabulated filters.
QUOTIENT = 1e-3
#: Where the lit part of the film ends, in pixels from the top left: left of the first and below the second.
EDGES = (1.3, 5.9)
WIDE = {"wide tent": {"radius": 2.5}, "wide gaussian": {"stddev": 1.5}}
NAMES = ["box", "tent", "wide tent", "gaussian", "wide gaussian"]
BATCHES = 8


def scene_of(name: str, border: bool | None, edges=(SIZE, 0.0), beyond=False, crop=None):
    """Return a luminous rectangle on a film of SIZE x SIZE pixels; ``beyond``: it goes on beyond the film."""
    low = -5.0 if beyond else -1.0
    right, top = 2.0 * edges[0] / SIZE - 1.0, 1.0 - 2.0 * edges[1] / SIZE
    corners = [[low, low, 0], [right, low, 0], [right, top, 0], [low, top, 0]]
    film = {
        "type": "hdrfilm",
        "width": SIZE,
        "height": SIZE,
        "rfilter": {"type": name.split()[-1], **WIDE.get(name, {})},
        **(crop or {}),
    }
    if border is not None:
        film["sample_border"] = border
    pose = psdr.Transform.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0))
    light = {
        "type": "mesh",
        "vertices": np.array(corners, np.float32),
        "faces": np.array([[0, 1, 2], [0, 2, 3]]),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}},
    }
    sensor = {"type": "orthographic", "to_world": pose, "film": film}
    node = {"type": "scene", "integrator": {"type": "path", "max_depth": 1}, "sensor": sensor, "light": light}
    scene = psdr.load_dict(node)
    return scene, psdr.traverse(scene)


def share(name: str, low: float, high: float, border: bool, first: int, size: int) -> np.ndarray:
    """Return the share of each pixel's filter, along an axis, between two places on the film."""
    _kind, radius, stddev, cdf = FILTERS[name]
    centre = first + np.arange(size) + 0.5

    def within(low: float, high: float) -> np.ndarray:
        return cdf(high - centre, radius, stddev) - cdf(low - centre, radius, stddev)

    if border:
        return within(low, high)
    return within(max(low, first), min(high, first + size)) / within(first, first + size)


@pytest.mark.slow_rows(
    "gaussian-False",
    "wide gaussian-None",
    "wide gaussian-False",
    "tent-False",
    "wide tent-None",
    "wide tent-False",
    "box-None",
    "gaussian-None",
    "box-False",
    "tent-None",
)
@pytest.mark.parametrize("border", [None, False])
@pytest.mark.parametrize("name", NAMES)
def test_a_white_square_that_fills_the_film_is_white(name: str, border: bool | None) -> None:
    """Mitsuba's default: nothing beyond the film counts; so with a crop window, in images and derivatives."""
    for crop in (None, {"crop_offset_x": 1, "crop_offset_y": 2, "crop_width": 7, "crop_height": 5}):
        scene, params = scene_of(name, border, crop=crop)
        image = psdr.render(scene, spp=64).numpy()
        np.testing.assert_allclose(image, 1.0, rtol=ROUNDING)
        name_of_light = "light.emitter.radiance.value"
        moved = psdr.render_forward(scene, params, {name_of_light: 1.0}, spp=64).numpy()
        np.testing.assert_allclose(moved, 1.0, rtol=ROUNDING)
        params.requires_grad(name_of_light)
        params.zero_grad()
        weights = np.random.default_rng(1).uniform(size=image.shape).astype(np.float32)
        psdr.render_backward(scene, params, weights, spp=64)
        np.testing.assert_allclose(params[name_of_light].grad.numpy().sum(), weights.sum(), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("crop", [False, True])
@pytest.mark.parametrize("border", [False, True])
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in ("tent", "wide gaussian") else pytest.mark.slow) for n in NAMES]
)
def test_images_and_derivatives_near_the_border(name: str, border: bool, crop: bool) -> None:
    """Two edges of a luminous rectangle, in pixels whose filters the border cuts.

    The image is a product of cumulative filters; its derivative by an edge's place is the filter there. Vertices move
    the edges, and so does the camera, the other way.
    """
    window = {"crop_offset_x": 1, "crop_offset_y": 2, "crop_width": 4, "crop_height": 5} if crop else None
    x0, y0, width, height = (1, 2, 4, 5) if crop else (0, 0, SIZE, SIZE)
    scene, params = scene_of(name, border, EDGES, beyond=True, crop=window)
    across = share(name, -99.0, EDGES[0], border, x0, width)
    down = share(name, EDGES[1], 99.0, border, y0, height)
    step = 1e-4
    slope = [share(name, -99.0, EDGES[0] + s * step, border, x0, width) / (2.0 * step) for s in (-1.0, 1.0)]
    expected = {"image": np.outer(down, across), "derivative": np.outer(down, slope[1] - slope[0])}
    pixel = 2.0 / SIZE
    vertices = np.zeros((4, 3), np.float32)
    vertices[:, 0] = pixel
    pose = np.zeros((4, 4), np.float32)
    pose[0, 3] = -pixel
    moves = {"light.vertex_positions": vertices, "sensor.to_world": pose}

    def grey(images: list) -> np.ndarray:
        return np.stack([image.numpy()[..., 0] for image in images]).astype(np.float64)

    found = grey([psdr.render(scene, spp=256, seed=i) for i in range(BATCHES)])
    assert_mean(found, expected["image"], f"{name}, image", rounding=QUOTIENT)
    for parameter, tangent in moves.items():
        given = {parameter: tangent}
        found = grey([psdr.render_forward(scene, params, given, spp=256, seed=i) for i in range(BATCHES)])
        assert_mean(found, expected["derivative"], f"{name}, {parameter}", rounding=QUOTIENT)
    weights = np.random.default_rng(1).normal(size=(height, width, 3)).astype(np.float32)
    params.requires_grad(*moves)
    for seed in range(2):
        params.zero_grad()
        psdr.render_backward(scene, params, weights, spp=256, seed=seed)
        for parameter, tangent in moves.items():
            forward = psdr.render_forward(scene, params, {parameter: tangent}, spp=256, seed=seed).numpy()
            pulled = (params[parameter].grad.numpy().astype(np.float64) * tangent).sum()
            assert pulled == pytest.approx((forward.astype(np.float64) * weights).sum(), rel=1e-4)
