"""Derivatives of curves with a radius that meshes run through: hairs in a scalp, grass in a floor; all terms."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.topology.tube_crossings import cut_tubes

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import ball, camera, diffuse, floor, load, register
from .test_exact_sphere import LIGHTS, entry, moved_light
from .test_tubes import coordinate

POINTS, POSE, FLOOR = "body.control_points", "body.to_world", "floor.to_world"
VIEW = camera((0.3, -2.2, 1.5), (0.0, 0.0, 0.2), fov=45.0)


def stalks(count: int) -> tuple[np.ndarray, list[int]]:
    """Two that grow out of a floor, one bent and tapered, both rooted below it."""
    k = np.linspace(-0.25, 1.0, count)
    bent = np.column_stack([0.5 * k * k - 0.35, 0.35 * k - 0.1, 0.9 * k, 0.26 - 0.16 * k])
    leaning = np.column_stack([0.45 + 0.25 * k, 0.1 - 0.4 * k, 0.7 * k, 0.13 + 0.04 * k])
    return np.concatenate([bent, leaning]), [0, len(bent)]


def rooted(light: str, plugin: str):
    points, starts = stalks(7 if plugin == "bsplinecurve" else 4)
    body = {"type": plugin, "control_points": points, "curve_starts": starts, "bsdf": diffuse(0.7, 0.5, 0.3)}
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "body": body, **LIGHTS[light]()}


def spiked(plugin: str):
    """A coarse ball with a spike through it, whose edges lie in the spike in part, over a floor."""
    k = np.linspace(-1.0, 1.0, 7)
    points = np.column_stack([0.75 * k, -0.25 * k, 0.7 + 0.35 * k, 0.1 + 0.05 * k])
    scalp = ball((0.0, 0.0, 0.7), 0.42, diffuse(0.3, 0.6, 0.5), subdivisions=1)
    body = {"type": plugin, "control_points": points, "bsdf": diffuse(0.7, 0.5, 0.3)}
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "scalp": scalp, "body": body, **LIGHTS["lamp"]()}


PLUGINS = {"tubes": "bsplinecurve", "cones": "linearcurve"}
register(
    {
        **{f"rooted {kind}, {light}": rooted(light, plugin) for kind, plugin in PLUGINS.items() for light in LIGHTS},
        **{f"spiked, {kind}": spiked(plugin) for kind, plugin in PLUGINS.items()},
    }
)
MOTIONS = (
    ("radii", POINTS, coordinate(3), 0.004),
    ("one point", POINTS, coordinate(0, 2), 0.01),
    ("sinks", POSE, entry(2, 3), 0.005),
    ("x", POSE, entry(0, 3), 0.005),
    ("the floor rises", FLOOR, entry(2, 3), 0.005),
)
CASES = [
    Case("rooted tubes, lamp", POSE, entry(2, 3), 0.005, "the tubes sink", 2, 320, 1280),
    *(
        Case(f"rooted {kind}, {light}", name, tangent, step, what, 2, 1024, 4096)
        for kind in PLUGINS
        for light in ("lamp", "sky", "point")
        for what, name, tangent, step in MOTIONS
    ),
    *(
        Case("rooted tubes, lamp", name, tangent, 0.005, what, 2, 1024, 4096)
        for what, name, tangent in (
            ("the floor turns", FLOOR, entry(2, 0)),
            ("the lamp moves", "light.vertex_positions", moved_light),
            ("the camera moves", "sensor.to_world", entry(0, 3)),
        )
    ),
    *(
        Case(f"spiked, {kind}", name, tangent, 0.004, what, 2, 1024, 4096)
        for kind in PLUGINS
        for what, name, tangent in (
            ("radii", POINTS, coordinate(3)),
            ("the spike moves", POSE, entry(2, 3)),
            ("the ball moves", "scalp.vertex_positions", moved_light),
        )
    ),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rooted tubes, lamp", "rooted cones, lamp", "spiked, tubes"])
def test_reverse_mode_is_the_transpose(name: str) -> None:
    scene, params = load(name)
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [POINTS, POSE, FLOOR], options)


def cut_by_plane(plugin: str, points: np.ndarray, size: float) -> tuple[psdr.Scene, float]:
    """A tube and a square at z = 0, of the given half size, and the length of their curves."""
    whole = {"floor": floor(half=size), "body": {"type": plugin, "control_points": points}}
    scene = psdr.load_dict({"type": "scene", "sensor": VIEW, **whole, **LIGHTS["sky"]()})
    chords, _segments, _places = cut_tubes(scene, list(whole).index("body"), None)
    steps = np.linalg.norm(np.diff(chords.points, axis=1)[:, 0], axis=1)
    return scene, float((steps * np.diff(chords.spans, axis=1)[:, 0]).sum())


@pytest.mark.parametrize("plugin", PLUGINS.values())
def test_chords_have_the_length_of_the_curve(plugin: str) -> None:
    """A leaning tube is cut in an ellipse, whatever the size of the triangles and wherever its segments join."""
    lean = np.radians(40.0)
    t = (np.arange(4096) + 0.5) * 2.0 * np.pi / 4096.0
    ellipse = 0.1 * 2.0 * np.pi * np.hypot(np.sin(t) / np.cos(lean), np.cos(t)).mean()
    for count, size in ((8, 100.0), (60 if plugin == "bsplinecurve" else 12, 1.0)):
        k = np.linspace(-1.0, 1.0, count)
        points = np.column_stack([np.sin(lean) * k + 0.03, 0.0 * k + 0.02, np.cos(lean) * k, 0.0 * k + 0.1])
        _scene, length = cut_by_plane(plugin, points, size)
        assert length == pytest.approx(ellipse, rel=3.0e-3)
    # A floor that ends within the tube has a part of the ellipse.
    k = np.linspace(-1.0, 1.0, 8)
    points = np.column_stack([np.sin(lean) * k + 0.5, 0.0 * k, np.cos(lean) * k, 0.0 * k + 0.1])
    assert cut_by_plane(plugin, points, 0.5)[1] == pytest.approx(0.5 * ellipse, rel=3.0e-3)


def test_an_open_end_that_lies_on_a_mesh_is_refused() -> None:
    k = np.linspace(0.0, 1.0, 5)
    for end, refused in ((-0.25, True), (-0.2, False), (-0.4, False)):  # B-splines begin at their second point
        points = np.column_stack([0.0 * k, 0.0 * k, end + k, 0.0 * k + 0.1])
        scene, _length = cut_by_plane("bsplinecurve", points, 1.0)
        for names in ([POSE], [FLOOR]):
            if refused:
                with pytest.raises(ValueError, match="an open end of 'body' lies on 'floor'"):
                    psdr.plan(scene, names=names)
            else:
                psdr.plan(scene, names=names)
