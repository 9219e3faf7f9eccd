"""What a naive implementation does in the families whose own files do not show it, once for each.

Where the naive code is a formula it stands here; where it is what this library does without a line of its own, that is
taken away.
"""

import math

import numpy as np
import pytest
import warp as wp

from . import test_boundary as boundary
from . import test_coverage as coverage
from . import test_highlights as highlights
from . import test_materials as materials
from . import test_paths as paths
from .sweeps import room


@wp.func
def direction(v: wp.vec3) -> wp.float32:
    return wp.dot(v / wp.sqrt(wp.dot(v, v)), wp.vec3(0.3, 0.8, -0.5))


@wp.kernel(module="unique", enable_backward=False)
def derivative_of_a_direction(v: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    out[i] = wp.length(wp.grad(direction)(v[i]))


def test_singular_a_plain_quotient_has_no_derivative_at_zero() -> None:
    v = wp.array([[0.0, 0.6, 0.8], [0.0, 0.0, 0.0]], dtype=wp.vec3, device="cpu")
    out = wp.zeros(2, dtype=wp.float32, device="cpu")
    wp.launch(derivative_of_a_direction, 2, [v], [out], device="cpu")
    assert np.isfinite(out.numpy()).tolist() == [True, False]


def test_materials_the_reflectance_of_nearly_equal_indices_cancels() -> None:
    worst, c = 0.0, np.float32(0.7)
    for eta in np.linspace(1.000001, 1.00001, 10, dtype=np.float32):
        root = np.sqrt(eta * eta - np.float32(1.0) + c * c)
        r_s, r_p = (c - root) / (c + root), (eta * eta * c - root) / (eta * eta * c + root)
        naive = 0.5 * (float(r_s) ** 2 + float(r_p) ** 2)
        worst = max(worst, abs(naive / materials.interface(float(eta), float(c))[0] - 1.0))
    assert worst > 1e-3


def test_light_points_drawn_by_area_are_all_far_away_on_a_vast_disk() -> None:
    """Irradiance pi R^2 / (1 + R^2) of a disk of radius R a unit away: 1e5 samples, and their largest share."""
    radius = 1e3 * np.sqrt(np.random.default_rng(1).random(100_000))
    terms = np.pi * 1e6 / (1.0 + radius**2) ** 2 / len(radius)
    assert terms.max() > 0.02 * terms.sum() and abs(terms.sum() / np.pi - 1.0) > 0.05


def test_light_uniform_directions_make_a_firefly_of_the_sun() -> None:
    """A sun pixel in a sky is found by one direction in 512."""
    found = np.random.default_rng(1).random((1000, 16)) < 1.0 / 512.0
    estimates = (0.3 * (1.0 - found) + 4e4 * found).mean(axis=1)
    assert estimates.std() / estimates.mean() > 3.0


def test_light_a_float32_sum_of_many_lights_drifts() -> None:
    shares = np.full(1000, 1e-3, np.float32)
    assert abs(float(np.cumsum(shares, dtype=np.float32)[-1]) - 1.0) > 5e-6


@pytest.mark.slow
def test_paths_textbook_replay_has_no_derivative_at_a_reflectance_of_zero() -> None:
    assert paths.relative("conductor", 0.0, 20, 2) < 1e-5
    assert paths.relative("conductor", 0.0, 20, 2, block=0) > 0.5


def test_highlights_points_drawn_evenly_along_an_edge_miss_the_lobe() -> None:
    """A plate's side of 0.2, a unit away in the mirror direction, and a lobe two widths to either side."""
    width = highlights.lobe_width(40.0, 1e-5)
    along = np.random.default_rng(1).random(1000) * highlights.PLATE - 0.5 * highlights.PLATE
    assert (np.abs(along) < 2.0 * width).sum() < 3


@pytest.mark.slow
def test_boundary_without_its_term_a_shadow_does_not_move() -> None:
    z = boundary.compared(room(), method=None, spp=16, primal=256, noise=math.inf)
    assert z > 1.0 and boundary.compared(room(), spp=16, primal=256, noise=math.inf) < 1.0


def test_coverage_projecting_what_is_behind_the_camera_is_wrong() -> None:
    p = coverage.behind(-1.0)
    corners = p.vertices[p.faces[0]]
    x, y = (corners[:, :2] / corners[:, 2:] / np.tan(np.radians(coverage.FOV / 2.0)) * coverage.FILM / 2.0).T
    naive = 0.5 * abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))
    assert abs(naive / coverage.area(p.vertices[p.faces]) - 1.0) > 0.5
