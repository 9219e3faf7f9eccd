"""Surfaces that touch: light between them gives the interior term a tail (``kernels/interior/factors/contact.py``)."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import Case, assert_agrees, derivatives, differences, move
from .scenes import SIZE, T, ball, diffuse, floor, load, mesh, room

BOX = "box.vertex_positions"
ALONG = (1.0, -0.5, 0.0)


def along(values):
    return np.broadcast_to(np.array(ALONG), values.shape)


def sums(depth: int, spp: int, batches: int) -> np.ndarray:
    """Derivative of the sum of the image as the box slides over the floor, one a batch."""
    scene, params = load("room")
    tangent = {BOX: along(params[BOX].numpy()).astype(np.float32)}
    options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": spp}
    return np.array([
        psdr.render_forward(scene, params, tangent, seed=s, **options).numpy().sum(dtype=np.float64)
        for s in range(batches)
    ])  # fmt: skip


def differences_of_sums(depth: int, spp: int, batches: int, step: float) -> np.ndarray:
    scene, params = load("room")
    base = params[BOX].numpy().astype(np.float64)
    options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": spp}
    found = []
    try:
        for seed in range(batches):
            ends = []
            for sign in (1.0, -1.0):
                move(params, {BOX: base + sign * step * along(base)})
                ends.append(psdr.render(scene, seed=seed, **options).numpy().sum(dtype=np.float64))
            found.append((ends[0] - ends[1]) / (2.0 * step))
    finally:
        move(params, {BOX: base})
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("depth", [3, 4])
def test_a_box_that_slides_over_the_floor(depth, mode) -> None:
    case = Case("room", BOX, along, 0.01, "a box on the floor slides", depth=depth, spp=2048, difference_spp=4096)
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
def test_the_light_between_box_and_floor_is_complete() -> None:
    """The sum of all pixels, in which the silhouettes nearly cancel and what happens at the contact shows."""
    derivative, difference = sums(3, 512, 64), differences_of_sums(3, 2048, 64, 0.02)
    error = np.hypot(derivative.std(ddof=1), difference.std(ddof=1)) / 8.0
    mean = difference.mean()
    # Counting the contact at the wrong end of its segment, or twice, changes the sum by 0.3 to 0.4 of it.
    assert 3.0 * error < 0.2 * abs(mean)
    assert abs(derivative.mean() - mean) < 3.0 * error


@pytest.mark.slow
def test_samples_at_a_contact_have_no_heavy_tail(monkeypatch) -> None:
    """Without the weight the samples' largest values grow with their number, and with them the noise of the mean."""
    scene, _params = load("room")
    assert scene.contact_ratio > 0.0
    weighted = sums(3, 64, 24)
    monkeypatch.setattr(scene, "contact_ratio", 0.0)
    plain = sums(3, 64, 24)

    def spread(values: np.ndarray) -> float:
        return float(np.abs(values - np.median(values)).max())

    assert spread(weighted) < 0.5 * spread(plain)


def slid(scene, spp: int, batches: int) -> np.ndarray:
    """Interior derivatives as the camera moves aside: light between walls that meet is what moves against it."""
    options = {"integrator": psdr.PathIntegrator(max_depth=3, boundary=None), "spp": spp}
    aside = np.zeros((4, 4), np.float32)
    aside[0, 3] = 1.0
    params = psdr.traverse(scene)
    return np.array([
        psdr.render_forward(scene, params, {"sensor.to_world": aside}, seed=seed, **options).numpy()
        for seed in range(batches)
    ], np.float64)  # fmt: skip


@pytest.mark.slow
def test_what_turns_as_one_looks_the_same() -> None:
    """Walls that turn together do not move against each other, nor against the camera that turns with them."""
    scene, params = load("room")
    turn = np.array([[0.0, -0.3, 0.2], [0.3, 0.0, -0.5], [-0.2, 0.5, 0.0]])
    names = [n for n in params if n.endswith("vertex_positions")]
    tangents = {n: (params[n].numpy() @ turn.T).astype(np.float32) for n in names}
    pose = np.zeros((4, 4))
    pose[:3, :3] = turn
    camera = {"sensor.to_world": (pose @ params["sensor.to_world"].numpy()).astype(np.float32)}
    options = {"integrator": psdr.PathIntegrator(max_depth=4), "spp": 64, "seed": 1}
    image = psdr.render_forward(scene, params, tangents | camera, **options).numpy()
    alone = psdr.render_forward(scene, params, camera, **options).numpy()
    # Were the rate at which a corner opens left out of what is weighted: 5e-3.
    assert np.abs(image).max() < 1.0e-5 * np.abs(alone).max()


ALBEDO, VIEW, WIDE = 0.8, 0.1, 3.0
#: Sum of the image over what the floor receives of radiance 1, for each unit of its length in view.
UNIT = ALBEDO * SIZE * SIZE / VIEW


def wall(profile, end: float, glows: bool):
    """A wall of radiance 1 above a floor that is seen from straight above, up to VIEW in front of it.

    ``profile``: (x, z) from below to above, up to x = 0; ``end``: in y, where it ends.
    """
    corners = [[x, y, z] for x, z in profile for y in (-WIDE, end)]
    faces = [t for k in range(0, len(corners) - 2, 2) for t in ([k, k + 1, k + 3], [k, k + 3, k + 2])]
    half = 0.5 * VIEW
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    pose = T.look_at([half, 0, 2], [half, 0, 0], [0, 1, 0]) @ T.scale([half, half, 1])
    scene = {"sensor": {"type": "orthographic", "to_world": pose, "film": film}, "floor": floor(bsdf=diffuse(ALBEDO))}
    if glows:
        light = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
        return scene | {"wall": mesh(corners, faces, diffuse(0.0), emitter=light)}
    sun = {"type": "directional", "direction": [-1, 0, 0], "irradiance": {"type": "rgb", "value": 2.0 * np.pi}}
    return scene | {"wall": mesh(corners, faces, diffuse(0.5)), "sun": sun}


def seen_from_floor(distance: float, height: float, end: float) -> float:
    """Form factor from the floor in view, so far away from a wall that stands on it, to the wall."""
    if height == 0.0:
        return 0.0
    y = (np.arange(4096) + 0.5) / 4096 * VIEW - 0.5 * VIEW
    if distance == 0.0:
        return 0.5 * np.mean(y < end)
    slant = np.hypot(distance, height)
    sides = [np.arctan(w / distance) - distance / slant * np.arctan(w / slant) for w in (end - y, y + WIDE)]
    return np.mean(sides[0] + sides[1]) / (2.0 * np.pi)


def of_floor(profile, end: float, ratio: float, glows: bool, mode: str) -> list[float]:
    """Interior derivatives of the sum of the image as a wall moves towards the floor in view, one a batch."""
    scene = psdr.load_dict({"type": "scene", **wall(profile, end, glows)})
    scene.contact_ratio = ratio
    params = psdr.traverse(scene)
    name = "wall.vertex_positions"
    tangent = np.broadcast_to(np.float32([1.0, 0.0, 0.0]), params[name].numpy().shape).copy()
    options = {"integrator": psdr.PathIntegrator(max_depth=2 if glows else 3, boundary=None), "spp": 4096}
    sums = []
    for seed in range(8):
        if mode == "forward":
            image = psdr.render_forward(scene, params, {name: tangent}, seed=seed, **options).numpy()
            sums.append(image[..., 0].sum(dtype=np.float64))
        else:
            params.requires_grad(name)
            params.zero_grad()
            red = np.zeros((SIZE, SIZE, 3), np.float32)
            red[..., 0] = 1.0
            psdr.render_backward(scene, params, red, seed=seed, **options)
            sums.append((params[name].grad.numpy().astype(np.float64) * tangent).sum())
    return sums


def assert_received(sums: list[float], expected: float, lost: float) -> None:
    """Compare derivatives, one a batch, with what is expected, of which so much may be lost."""
    error = np.std(sums, ddof=1) / np.sqrt(len(sums))
    assert error < 0.01 * UNIT
    assert abs(np.mean(sums) - expected * UNIT) < 4.0 * error + lost * UNIT


UPRIGHT, BEVEL = [(0.0, 0.0), (0.0, 0.6)], 0.003


@pytest.mark.slow
@pytest.mark.parametrize("mode", [pytest.param("forward", marks=pytest.mark.slow), "reverse"])
@pytest.mark.parametrize(
    ("profile", "end", "ratio", "glows"),
    [
        pytest.param(UPRIGHT, WIDE, 0.004, True, id="on the floor"),
        pytest.param(UPRIGHT, WIDE, 0.004, False, id="on the floor, lit", marks=pytest.mark.slow),
        pytest.param(UPRIGHT, 0.0, 0.06, True, id="that ends", marks=pytest.mark.slow),
        pytest.param([(0.0, 0.005), (0.0, 0.6)], WIDE, 0.02, True, id="above a gap"),
        pytest.param([(0.0, 0.005), (0.0, 0.6)], WIDE, 0.02, False, id="above a gap, lit", marks=pytest.mark.slow),
        pytest.param([(0.0, 0.0), (0.0, 0.02)], WIDE, 0.02, True, id="of little height", marks=pytest.mark.slow),
        pytest.param([(-BEVEL, 0.0), (0.0, BEVEL), (0.0, 0.6)], WIDE, 0.02, True, id="with a bevelled edge"),
    ],
)
def test_light_next_to_a_wall_that_moves(profile, end, ratio, glows, mode) -> None:
    """The interior term of all that the floor receives, in closed form: it falls off ahead, from F(0+)."""
    sums = of_floor(profile, end, ratio, glows, mode)
    low = profile[0][1]
    top = profile[-1][1]

    def received(x: float) -> float:
        return seen_from_floor(x, top, end) - seen_from_floor(x, low, end)

    assert_received(sums, received(0.0) - received(VIEW), 0.002)


@pytest.mark.slow
def test_light_next_to_a_round_wall_that_moves() -> None:
    """A quarter of a cylinder: what the floor receives falls with the root of the distance, of which some is lost."""
    radius = 0.6
    turn = np.linspace(0.0, 0.5 * np.pi, 65)
    profile = list(zip(radius * (np.cos(turn) - 1.0), radius * np.sin(turn), strict=True))
    # A weight that goes by the distance of p alone loses 0.06.
    expected = 0.5 * np.sqrt(1.0 - (radius / (radius + VIEW)) ** 2)
    assert_received(of_floor(profile, WIDE, 0.02, True, "forward"), expected, 0.01)


@pytest.mark.slow
def test_a_speck_makes_no_corner_noisy() -> None:
    """The weight follows from the two surfaces that meet, whatever else there is."""
    speck = ball((0.5, 0.5, 1.5), 0.02, diffuse(0.5))
    images = [slid(psdr.load_dict({"type": "scene", **room(), **more}), 16, 1) for more in ({}, {"speck": speck})]
    beside = np.abs(images[0] - images[1]).max(axis=(0, 3)) > 0.0
    assert np.abs(images[0]).max() > 0.1
    # Paths that meet it.
    assert beside.mean() < 0.2


@pytest.mark.slow
def test_what_the_weight_loses_is_of_second_order(monkeypatch) -> None:
    """At ten times its width it loses some percent; a weight that is lower on average would lose five times as much."""
    scene, _params = load("room")
    expected = slid(scene, 512, 16)
    monkeypatch.setattr(scene, "contact_ratio", 10.0 * scene.contact_ratio)
    change = slid(scene, 512, 16) - expected
    mean = expected.mean(axis=0)
    lost = (change * mean).sum(axis=(1, 2, 3)) / (mean * mean).sum()
    error = lost.std(ddof=1) / 4.0
    assert error < 0.01
    assert abs(lost.mean()) < 0.03
