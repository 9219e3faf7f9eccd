"""Derivatives of tubes that run through each other, and through themselves: their common curves move with both."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.topology.kinds.tube_overlaps import tube_overlaps
from warp_psdr.topology.tube_pairs import cut_tube_pairs

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, camera, diffuse, floor, load, register
from .test_exact_sphere import LIGHTS, entry, moved_light
from .test_tubes import coordinate

PLUGINS = {"tubes": "bsplinecurve", "cones": "linearcurve"}
VIEW = camera((0.3, -2.2, 1.5), (0.0, 0.0, 0.4), fov=45.0)
POINTS, POSE, OTHER = "body.control_points", "body.to_world", "other.to_world"


def crossed(light: str, plugin: str):
    """A tube, bent and tapered, through another one, over a floor."""
    k = np.linspace(-1.0, 1.0, 7)
    body = np.column_stack([0.8 * k, 0.1 + 0.1 * k, 0.5 + 0.15 * k * k, 0.16 + 0.05 * k])
    other = np.column_stack([0.1 + 0.2 * k, 0.8 * k, 0.45 + 0.2 * k, 0.0 * k + 0.12])
    both = {"body": (body, diffuse(0.7, 0.5, 0.3)), "other": (other, diffuse(0.3, 0.6, 0.5))}
    curves = {n: {"type": plugin, "control_points": points, "bsdf": bsdf} for n, (points, bsdf) in both.items()}
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), **curves, **LIGHTS[light]()}


def looped(light: str, plugin: str):
    """A curve that runs through itself, rooted in a floor."""
    half = np.array([[-1.0, -0.6], [-0.7, -0.3], [-0.3, 0.1], [0.2, 0.5], [0.35, 0.9]])
    path = np.concatenate([half, [[0.0, 1.15]], half[::-1] * [-1.0, 1.0]])
    points = np.column_stack([path[:, 0], np.linspace(-0.06, 0.06, len(path)), path[:, 1], np.full(len(path), 0.1)])
    body = {"type": plugin, "control_points": points, "bsdf": diffuse(0.7, 0.5, 0.3)}
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "body": body, **LIGHTS[light]()}


register(
    {
        f"{name} {kind}, {light}": made(light, plugin)
        for name, made in (("crossed", crossed), ("looped", looped))
        for kind, plugin in PLUGINS.items()
        for light in ("lamp", "sky", "point")
    }
)
CASES = [
    *(
        Case(f"{scene} {kind}, {light}", name, tangent, step, what, 2, 1024, 4096)
        for kind in PLUGINS
        for light in ("lamp", "sky", "point")
        for scene, what, name, tangent, step in (
            ("crossed", "the other tube moves", OTHER, entry(2, 3), 0.005),
            ("crossed", "radii", POINTS, coordinate(3), 0.003),
            ("looped", "radii", POINTS, coordinate(3), 0.003),
            ("looped", "one point", POINTS, coordinate(0, 3), 0.005),
        )
    ),
    *(
        Case(f"{scene} {kind}, lamp", name, tangent, 0.005, what, 2, 1024, 4096)
        for kind in PLUGINS
        for scene in ("crossed", "looped")
        for what, name, tangent in (
            ("the camera moves", "sensor.to_world", entry(0, 3)),
            ("the lamp moves", "light.vertex_positions", moved_light),
        )
    ),
    Case("crossed tubes, lamp", OTHER, entry(2, 3), 0.005, "the other tube moves", 3, 1024, 4096),
    Case("looped tubes, lamp", POSE, entry(0, 3), 0.005, "all moves", 3, 1024, 4096),
]


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("kind", PLUGINS)
@pytest.mark.parametrize("scene", ["crossed", "looped"])
def test_reverse_mode_is_the_transpose(scene: str, kind: str) -> None:
    loaded, params = load(f"{scene} {kind}, lamp")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 16, "seed": 1}
    assert_transposes(loaded, params, [POINTS, POSE, *([OTHER] if scene == "crossed" else [])], options)


def straight(plugin: str, count: int, axis: int, radius: float, height: float = 0.0) -> dict:
    points = np.zeros((count, 4))
    points[:, 2], points[:, 3] = height, radius
    points[:, axis] = np.linspace(-1.5, 1.5, count) + 0.013
    return {"type": plugin, "control_points": points}


def test_the_closed_form_of_two_tubes_under_a_light_from_the_camera() -> None:
    """Both are seen from above, where their heights tell which is in front; nothing else depends on the lower one's."""
    size, a, b, height = 16, 0.4, 0.3, 0.15
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    pose = T.look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]) @ T.scale([0.6, 0.6, 1.0])
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": [np.pi] * 3}}
    scene = {
        "type": "scene",
        "sensor": {"type": "orthographic", "to_world": pose, "film": film},
        "body": straight("bsplinecurve", 8, 0, a) | {"bsdf": diffuse(0.8)},
        "other": straight("bsplinecurve", 8, 1, b, height) | {"bsdf": diffuse(0.2)},
        "sun": sun,
    }
    loaded = psdr.load_dict(scene)
    params = psdr.traverse(loaded)

    def pixels(height: float) -> np.ndarray:
        at = (np.arange(200 * size) + 0.5) / (200 * size) * 1.2 - 0.6
        first = np.sqrt(np.maximum(a * a - at[:, None] ** 2, 0.0))  # along x: by y
        second = np.sqrt(np.maximum(b * b - at[None] ** 2, 0.0))
        in_front = np.clip(((second > 0.0) * (second + height - first)) / 2e-3 + 0.5, 0.0, 1.0)
        in_front = np.where(second > 0.0, np.where(first > 0.0, in_front, 1.0), 0.0)
        image = in_front * 0.2 * second / b + (1.0 - in_front) * 0.8 * first / a
        return image.reshape(size, 200, size, 200).mean(axis=(1, 3))

    exact = (pixels(height + 0.005) - pixels(height - 0.005)) / 0.01
    tangent = np.zeros((4, 4), np.float32)
    tangent[2, 3] = 1.0
    integrator = psdr.PathIntegrator(max_depth=2)
    images = [
        psdr.render_forward(loaded, params, {OTHER: tangent}, integrator=integrator, spp=256, seed=seed).numpy()[..., 0]
        for seed in range(2)
    ]
    estimate = np.mean(images, axis=0)
    assert np.abs(exact).max() > 0.1
    assert (estimate * exact).sum() / (exact**2).sum() == pytest.approx(1.0, abs=0.01)
    assert np.abs(estimate - exact).max() < 0.05 * np.abs(exact).max()


@pytest.mark.parametrize("plugin", PLUGINS.values())
def test_chords_have_the_length_of_the_curve(plugin: str) -> None:
    """A thin tube is cut twice by the surface of a thick one, however many segments they have."""
    thin, thick = 0.1, 0.25
    angle = (np.arange(4096) + 0.5) * 2.0 * np.pi / 4096.0
    y, z = thin * np.cos(angle), thin * np.sin(angle)
    ring = np.stack([np.sqrt(thick**2 - y**2), y, z], axis=1)
    length = 2.0 * np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1).sum()
    for counts in ((8, 8), (31, 20)):
        curves = [straight(plugin, n, axis, r) for n, axis, r in zip(counts, (0, 2), (thin, thick), strict=True)]
        joined = np.concatenate([c["control_points"] for c in curves])
        one = {"body": {"type": plugin, "control_points": joined, "curve_starts": [0, counts[0]]}}
        for shapes, other in ((one, 0), ({"body": curves[0], "other": curves[1]}, 1)):
            scene = psdr.load_dict({"type": "scene", "sensor": VIEW, **shapes, **LIGHTS["sky"]()})
            chords, segments, places = cut_tube_pairs(scene, 0, other)
            steps = np.linalg.norm(np.diff(chords.points, axis=1)[:, 0], axis=1)
            assert steps.sum() == pytest.approx(length, rel=2e-3)
            assert segments.shape == places.shape == (len(steps), 2)


def test_what_is_left_out_is_a_segment_through_itself_and_what_mirrors_show() -> None:
    scene, _params = load("looped tubes, sky")
    assert tube_overlaps(scene, 0, False) is None
    found = tube_overlaps(scene, 0, True)
    assert found is not None
    assert "common curve" in found.problem() or found.problem()
    assert psdr.plan(scene, names=["sensor.to_world"]).boundary is not None
