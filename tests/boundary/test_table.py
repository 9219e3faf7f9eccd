"""The table of gradient cases: slope of the whole derivative, interior and boundary, on finite differences."""

import numpy as np
import pytest

from .measure import BATCHES, Case, assert_agrees, derivatives, differences, rows, slope


def moved(*d):
    """Translation of vertices, or of a 4 x 4 pose."""

    def tangent(values):
        if values.shape[-2:] != (4, 4):
            return np.broadcast_to(np.array(d), values.shape)
        t = np.zeros((4, 4))
        t[:3, 3] = d
        return t

    return tangent


def scaled(values):
    return values - values.mean(axis=0)


def turned(axis):
    """Rotation of vertices about their mean, or of a pose about the origin."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]

    def tangent(values):
        pose = values.shape[-2:] == (4, 4)
        generator = np.zeros((4, 4) if pose else (3, 3))
        generator[i, j], generator[j, i] = -1.0, 1.0
        return generator @ values if pose else scaled(values) @ generator.T

    return tangent


def apart(values):
    """Vertices away from the origin, the floor up: nothing keeps its place relative to another."""
    return moved(0.2, 0.1, 1.0)(values) if values.shape[-2:] == (4, 4) else 0.5 * values


def sun_turns(values):
    t = np.zeros((4, 4))
    t[:3, 2] = [0.5, 0.3, 0.2]
    return t


ALONG = moved(1.0, 0.3, 0.4)
SHAPE, OCCLUDER, FLOOR, LIGHT = (
    "shape.vertex_positions",
    "occluder.vertex_positions",
    "floor.to_world",
    "light.to_world",
)
PANEL, BOX = "light.vertex_positions", "box.vertex_positions"
RECEIVER = "receiver moves along its normal"
CASES = [
    # Shapes under constant light: the primary boundary.
    Case("silhouette tent", SHAPE, ALONG, 0.01, "moves", slow=False, smoke=True),
    Case("silhouette tent", SHAPE, scaled, 0.01, "scales"),
    Case("silhouette box", SHAPE, ALONG, 0.01, "moves", difference_spp=2048),
    Case("silhouette gaussian", SHAPE, ALONG, 0.01, "moves"),
    Case("smooth", SHAPE, scaled, 0.01, "scales", spp=2048, difference_spp=4096),
    Case("split", SHAPE, ALONG, 0.01, "moves", difference_spp=2048),
    Case("split", SHAPE, turned(2), 0.02, "turns", difference_spp=2048),
    # Soft shadows.
    Case("soft", OCCLUDER, ALONG, 0.01, "occluder moves", difference_spp=2048, slow=False),
    Case("soft", FLOOR, moved(0.0, 0.0, 1.0), 0.02, RECEIVER, spp=2048, difference_spp=4096, slow=False),
    Case("soft", PANEL, ALONG, 0.02, "light moves"),
    Case("soft", PANEL, scaled, 0.04, "light scales"),
    Case("sky", OCCLUDER, ALONG, 0.01, "occluder moves", difference_spp=8192),
    Case("envmap", OCCLUDER, ALONG, 0.01, "occluder moves", spp=512, difference_spp=8192),
    # Copies that follow one shape, and one pose.
    Case("instances", "group.ball.vertex_positions", ALONG, 0.01, "the shape of both moves", difference_spp=4096),
    Case("instances", "group.ball.vertex_positions", scaled, 0.02, "the shape of both scales", difference_spp=4096),
    Case("instances", "two.to_world", ALONG, 0.01, "the mirrored one moves", difference_spp=4096),
    # A texture with steps at rest, which the moving shape shows, hides, shadows and is lit by.
    Case("checkered", OCCLUDER, ALONG, 0.01, "occluder moves", depth=3, spp=512, difference_spp=4096),
    # Hard shadows.
    Case("point", OCCLUDER, ALONG, 0.01, "occluder moves"),
    Case("point", FLOOR, moved(0.2, 0.1, 1.0), 0.01, RECEIVER, difference_spp=2048),
    Case("point", "light.position", ALONG, 0.01, "light moves"),
    Case("spot", LIGHT, ALONG, 0.01, "light moves"),
    Case("projector", LIGHT, ALONG, 0.01, "light moves", slow=True),
    Case("sun", OCCLUDER, ALONG, 0.005, "occluder moves", difference_spp=8192),
    Case("sun", FLOOR, moved(0.2, 0.1, 1.0), 0.01, RECEIVER, difference_spp=2048),
    Case("sun", LIGHT, sun_turns, 0.01, "light turns", difference_spp=8192),
    # The camera, which moves primary and secondary boundaries.
    Case("soft", "sensor.to_world", ALONG, 0.01, "camera moves", difference_spp=2048),
    Case("soft", "sensor.to_world", turned(0), 0.003, "camera turns", difference_spp=4096),
    Case("soft", "sensor.x_fov", np.ones_like, 0.1, "camera zooms", difference_spp=4096),
    Case("soft", "sensor.principal_point_offset_x", np.ones_like, 0.002, "camera shifts", difference_spp=4096),
    # Everything at once.
    Case("soft", (OCCLUDER, PANEL, FLOOR), apart, 0.01, "all move", difference_spp=2048),
    # Interreflection.
    Case("room", BOX, moved(1.0, -0.5, 0.0), 0.005, "a box on the floor moves", difference_spp=4096),
    Case("floating", BOX, moved(1.0, -0.5, 0.0), 0.005, "a box moves", depth=3, spp=1024, difference_spp=4096),
    Case("floating", BOX, moved(1.0, -0.5, 0.0), 0.005, "a box moves", depth=4, spp=1024, difference_spp=4096),
]


@pytest.mark.slow_rows(
    "soft, receiver moves along its normal, depth 2-reverse",
    "silhouette tent, moves, depth 2-forward",
    "silhouette tent, moves, depth 2-reverse",
    "soft, receiver moves along its normal, depth 2-forward",
)
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow_rows("soft, receiver moves along its normal, depth 2", "silhouette tent, moves, depth 2")
@pytest.mark.parametrize("case", [c for c in CASES if not c.slow], ids=str)
def test_the_table_can_tell_a_missing_boundary_term(case: Case) -> None:
    value, error = slope(derivatives(case, "forward", None), differences(case)[2])
    assert abs(value - 1.0) > 0.05 + 3.0 * error


@pytest.mark.parametrize(
    ("derivative", "message"),
    [(np.zeros(BATCHES), "zero"), (np.full(BATCHES, np.nan), "finite"), (np.full(BATCHES, 0.97), "slope")],
)
def test_a_wrong_derivative_fails(derivative, message) -> None:
    with pytest.raises(AssertionError, match=message):
        assert_agrees(derivative, np.ones(BATCHES))
    assert_agrees(np.full(BATCHES, 1.001), np.ones(BATCHES))
