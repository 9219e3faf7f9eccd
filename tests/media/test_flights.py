"""Free flights, and points by transmittance, against their densities: chi-square over bins of the distance.

Grids have cells of 8 voxels; one of the cells along the ray is empty, another one nearly.
"""

import numpy as np
import pytest
import warp as wp

from tests.path.helpers import SIGNIFICANCE, chi_square_p
from warp_psdr.kernels import structs
from warp_psdr.kernels.constants import FILTER_BILINEAR, PHASE_ISOTROPIC, WRAP_CLAMP
from warp_psdr.kernels.interior.differential_ratio_tracking import transmitted_point
from warp_psdr.kernels.medium.flight import FORCED, make_flight
from warp_psdr.kernels.medium.majorant import grid_ray
from warp_psdr.kernels.medium.tracking import make_tracking
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.reading import texture_record
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.vertex import MediaConfig
from warp_psdr.scene.media.super_grid import super_grid

#: Flights of a test, bins of the distance, and points of the quadrature in each.
COUNT, BINS, FINE = 1 << 17, 40, 64
LENGTH, EXTENT = 2.0, 1.5
#: Extinction by channel, from thin to thick.
COLOURS = np.array([0.1, 0.8, 4.0])
#: Number of the stretch, by which the share of forced flights is told.
NUMBER = 1
Q = 1.0 / (FORCED + NUMBER)


def medium_of(values):
    """A medium whose extinction is at the flat offset 0; scale and albedo behind it."""
    m = structs.Medium()
    m.scale, m.albedo, m.albedo_channels, m.emission = len(values), len(values) + 1, 1, -1
    return m, np.append(values, [1.0, 0.7])


def midpoints(length):
    """Points of a quadrature of a ray."""
    n = BINS * FINE
    return (np.arange(n) + 0.5) * (length / n)


def assert_density(t, density, passes, length):
    """Chi-square of distances; those that pass are a bin of their own. ``density``: at ``midpoints``."""
    share = density.reshape(BINS, FINE).mean(axis=1) * (length / BINS)
    assert share.sum() + passes == pytest.approx(1.0, abs=2e-3)
    share = np.append(share, passes)
    found, _ = np.histogram(t[t < length], BINS, (0.0, length))
    found = np.append(found, (t >= length).sum())
    assert (found[share == 0.0] == 0).all() and found.sum() == len(t)
    used = share > 0.0
    assert chi_square_p(found[used], len(t) * share[used] / share.sum()) > SIGNIFICANCE


# ---- Homogeneous ----


@pytest.fixture(scope="module")
def homogeneous():
    """Flights of a homogeneous medium, free and with a share of forced ones; one kernel."""
    config = MediaConfig((PHASE_ISOTROPIC,), True)
    free, forced = make_flight(config, False), make_flight(config, True)

    @wp.kernel(module="unique", enable_backward=False)
    def fly(
        scene: structs.Scene,
        m: structs.Medium,
        length: wp.float32,
        open: wp.bool,
        explores: wp.bool,
        u: wp.array(dtype=wp.vec4),
        number: wp.int32,
        flight_out: wp.array2d(dtype=wp.float32),
    ):
        i = wp.tid()
        f = free(scene, m, length, length, open, u[i], number, True)
        if explores:
            f = forced(scene, m, length, length, open, u[i], number, True)
        flight_out[i, 0] = wp.where(f.collides, f.t, 2.0 * length)
        flight_out[i, 1] = f.inv_p

    def run(sigma, explores, open=False):
        m, values = medium_of(sigma)
        m.sigma_t, m.sigma_t_channels = 0, 3
        scene = structs.Scene()
        scene.values = wp.array(values, dtype=wp.float32)
        scene.media.extent = EXTENT
        u = wp.array(np.random.default_rng(2).random((COUNT, 4)).astype(np.float32), dtype=wp.vec4)
        out = wp.zeros((COUNT, 2), dtype=wp.float32)
        wp.launch(fly, dim=COUNT, inputs=[scene, m, LENGTH, open, explores, u, NUMBER], outputs=[out])
        return out.numpy().astype(np.float64).T

    return run


@pytest.mark.parametrize(
    ("sigma", "explores", "open"),
    [(COLOURS, False, False), (COLOURS, True, False), (0.0 * COLOURS, True, False), (COLOURS, True, True)],
)
def test_flights_in_a_homogeneous_medium(homogeneous, sigma, explores, open):
    """The mean over the channels, and a share that ends on the stretch, also where there is no extinction."""
    t, inv_p = homogeneous(sigma, explores, open)

    def density(at):
        passed = np.exp(-sigma * at[:, None])
        free = (sigma * passed).mean(axis=1)
        if not explores:
            return free
        if open:
            return (1.0 - Q) * free + Q * (1.0 / EXTENT + 1.0 / LENGTH) / (1.0 + at / EXTENT) ** 2
        thick = np.where(sigma > 0.0, sigma, 1e-9)
        cut = (thick * np.exp(-thick * at[:, None]) / -np.expm1(-thick * LENGTH)).mean(axis=1)
        return (1.0 - Q) * free + Q * cut

    passes = (1.0 - Q * explores) * np.exp(-sigma * LENGTH).mean()
    assert_density(t, density(midpoints(LENGTH)), passes, LENGTH)
    collides = t < LENGTH
    np.testing.assert_allclose(1.0 / inv_p[collides], density(t[collides]), rtol=2e-4)
    np.testing.assert_allclose(1.0 / inv_p[~collides], passes, rtol=1e-4)


# ---- Grids ----

#: Voxels along z of a grid from 0 to 1; the second of its four cells is empty, the third nearly.
VOXELS = 32
COLUMN = np.concatenate([np.linspace(1.0, 3.0, 7), np.zeros(10), np.full(7, 0.02), np.linspace(0.5, 6.0, 8)])
ORIGIN, DIRECTION = np.array([0.2, 0.3, -0.25]), np.array([0.28, 0.0, 0.96])
#: Where the ray enters the grid's box, and where it leaves it.
NEAR, FAR = 0.25 / 0.96, 1.25 / 0.96


def sigma_at(t):
    """Extinction along the ray: straight lines between centres of voxels."""
    z = (ORIGIN[2] + t * DIRECTION[2]) * VOXELS - 0.5
    inside = (t > NEAR) & (t < FAR)
    return np.where(inside, np.interp(z, np.arange(VOXELS), COLUMN), 0.0)


def depth_at(t):
    """int sigma dt from the ray's origin, at midpoints of equal steps."""
    sigma, step = sigma_at(t), t[1] - t[0]
    return (np.cumsum(sigma) - 0.5 * sigma) * step


@pytest.fixture(scope="module")
def grids():
    """Tracked flights, with and without a clock, and points by transmittance; one kernel."""
    config = MediaConfig((PHASE_ISOTROPIC,), False, True)
    free, clocked = make_tracking(config, False)[0], make_tracking(config, True)[0]

    @wp.kernel(module="unique", enable_backward=False)
    def fly(
        scene: structs.Scene,
        m: structs.Medium,
        o: wp.vec3,
        d: wp.vec3,
        length: wp.float32,
        number: wp.int32,
        free_out: wp.array(dtype=wp.float32),
        clocked_out: wp.array(dtype=wp.float32),
        point_out: wp.array(dtype=wp.vec2),
    ):
        i = wp.tid()
        sampler = sampler_at(i, 0, wp.uint32(7))
        f = free(scene, m, o, d, length, length, sampler, number, True)
        free_out[i] = wp.where(f.collides, f.t, 2.0 * length)
        f = clocked(scene, m, o, d, length, length, sampler, number, True)
        clocked_out[i] = wp.where(f.collides, f.t, 2.0 * length)
        g = texture_record(scene, m.sigma_t)
        r = grid_ray(scene, g, o, d, length)
        point = transmitted_point(scene, g, r, 1.0, 1.0 / (r.t1 - r.t0), sampler_at(i, 0, wp.uint32(8)))
        point_out[i] = wp.vec2(point.t, point.total)

    m, values = medium_of(COLUMN)
    m.sigma_t, m.sigma_t_channels = 0, GRID
    majorants = super_grid(COLUMN.reshape(VOXELS, 1, 1, 1), "clamp")
    assert len(majorants) == 4 and majorants[1] == 0.0
    record = structs.Texture()
    record.filter, record.wrap, record.channels = FILTER_BILINEAR, WRAP_CLAMP, 1
    record.width, record.height, record.first = 1, 1, VOXELS
    record.to_uv, record.second = len(values), len(values) + 12
    scene = structs.Scene()
    scene.values = wp.array(np.concatenate([values, np.eye(3, 4).reshape(-1), majorants]), dtype=wp.float32)
    scene.textures = wp.array([record], dtype=structs.Texture)
    out = wp.zeros(COUNT, dtype=wp.float32), wp.zeros(COUNT, dtype=wp.float32), wp.zeros(COUNT, dtype=wp.vec2)
    inputs = [scene, m, wp.vec3(*ORIGIN), wp.vec3(*DIRECTION), LENGTH, NUMBER]
    wp.launch(fly, dim=COUNT, inputs=inputs, outputs=list(out))
    return [a.numpy().astype(np.float64) for a in out]


def test_flights_through_a_grid(grids):
    """sigma T, and none collides where there is no density."""
    t = midpoints(LENGTH)
    depth = depth_at(t)
    assert_density(grids[0], sigma_at(t) * np.exp(-depth), np.exp(-depth[-1]), LENGTH)


def test_flights_through_a_grid_beside_a_clock(grids):
    """(sigma + epsilon) T exp(-epsilon t): they end in empty cells, too."""
    t = midpoints(LENGTH)
    rate = Q / (FAR - NEAR)
    passed = np.exp(-depth_at(t) - rate * np.clip(t - NEAR, 0.0, FAR - NEAR))
    inside = (t > NEAR) & (t < FAR)
    assert_density(grids[1], (sigma_at(t) + rate * inside) * passed, passed[-1], LENGTH)


def test_points_by_transmittance(grids):
    """Weighted with what ratio tracking says of all its points they have T for their density, in empty cells, too.

    A point is kept with its weight over the largest, so that those which are kept are drawn by T alone.
    """
    at, total = grids[2].T
    largest = 10.0 * (FAR - NEAR)
    assert total.max() < largest
    t = midpoints(LENGTH)
    passed = np.where((t > NEAR) & (t < FAR), np.exp(-depth_at(t)), 0.0)
    whole = passed.mean() * LENGTH
    error = total.std(ddof=1) / np.sqrt(COUNT)
    assert abs(total.mean() - whole) < 5.0 * error + 1e-3 * whole
    kept = at[np.random.default_rng(4).random(COUNT) * largest < total]
    assert len(kept) > 5000
    assert_density(kept, passed / whole, 0.0, LENGTH)
