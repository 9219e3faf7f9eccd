"""Scenes scaled by a thousandth and a thousand: images, derivatives, and their noise, are the same.

Scales are powers of two, by which float32 is exact, and random numbers are equal. So not means alone are compared, but
samples: whatever has a unit that is not the scene's shows in some pixel.
"""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media.scenes import T, camera, cube, grid, grids, medium, point, puffs, rgb, square, whole

#: Some boxes end inside of their interface, and are meant to.
pytestmark = pytest.mark.filterwarnings("ignore:.* is not 0 at the border of its box")

SIZE, SPP, DEPTH = 12, 4, 4
SQUARE, SIGMA, VOXELS = (
    "square.to_world",
    "fog.interior_medium.sigma_t.value.value",
    "smoke.interior_medium.sigma_t.data",
)
#: Share of the largest value. Sums in float32 may be added up in another order.
ROUNDING = 1e-5


def scene(k):
    """Fog and smoke above a floor, a square between them, a lamp and a bulb; lengths are k times as large."""
    volume = grid(puffs(4) + 0.05, T.scale(k) @ T.translate([-1.4, -0.5, -0.4]) @ T.scale(0.9))
    fog = cube(medium((0.8 / k, 0.6 / k, 1.0 / k), (0.9, 0.8, 0.7), g=0.3))
    smoke = cube(grids(volume, 0.8, g=-0.2, scale=3.0 / k))
    lamp = {"type": "area", "radiance": rgb(8.0, 7.0, 6.0)}
    parts = {
        "sensor": camera([4 * k, k, 0.6 * k], [0, 0, 0], 38.0, SIZE, near_clip=0.01 * k, far_clip=1e4 * k),
        "fog": fog | {"to_world": T.scale(k) @ T.translate([0.5, 0.0, 0.0]) @ T.scale(0.6)},
        "smoke": smoke | {"to_world": T.scale(k) @ T.translate([-0.9, 0.0, 0.1]) @ T.scale(0.55)},
        "floor": square(-1.3 * k, 1.6 * k, {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.3)}),
        "square": {
            "type": "rectangle",
            "to_world": T.scale(k) @ T.translate([0.4, 0.1, 0.2]) @ T.rotate([0, 1, 0], 25.0) @ T.scale(0.3),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}},
        },
        "lamp": square(2.2 * k, 0.5 * k, flipped=True, emitter=lamp),
        "bulb": point([0.5 * k, -1.5 * k, 1.5 * k], (2.0 * k * k, 3.0 * k * k, 4.0 * k * k)),
    }
    return psdr.load_dict(whole(**parts))


def assert_same(found, expected):
    """Compare to rounding."""
    assert np.abs(expected).max() > 0.0
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=ROUNDING * np.abs(expected).max())


def derivatives(k, names, **options):
    """Return the gradients of the sum of the pixels."""
    loaded = scene(k)
    params = psdr.traverse(loaded)
    params.requires_grad_only(*names)
    integrator = psdr.PathIntegrator(max_depth=DEPTH, **options)
    psdr.render_backward(loaded, params, np.ones((SIZE, SIZE, 3), np.float32), integrator=integrator, spp=SPP, seed=2)
    return [params[name].grad.numpy().astype(np.float64).reshape(params[name].shape) for name in names]


@pytest.fixture(scope="module")
def expected():
    """Image and derivatives at the scale of one."""
    image = psdr.render(scene(1.0), integrator=psdr.PathIntegrator(max_depth=DEPTH), spp=SPP, seed=1).numpy()
    return image, derivatives(1.0, [SIGMA, VOXELS])


@pytest.mark.slow
@pytest.mark.parametrize("k", [2.0**-10, 2.0**10])
def test_images_and_derivatives_by_densities(k, expected):
    """By the density of fog they are k times as large, as its unit says; by voxels, which have a scale, equal."""
    image = psdr.render(scene(k), integrator=psdr.PathIntegrator(max_depth=DEPTH), spp=SPP, seed=1).numpy()
    assert_same(image, expected[0])
    by_sigma, by_voxels = derivatives(k, [SIGMA, VOXELS])
    assert_same(by_sigma / k, expected[1][0])
    assert_same(by_voxels, expected[1][1])


@pytest.mark.slow
@pytest.mark.parametrize("k", [2.0**-10, 2.0**10])
def test_what_moves(k):
    """Interior and boundary term of a square that moves between fog and smoke."""
    found, at_one = (derivatives(scale, [SQUARE])[0] for scale in (k, 1.0))
    assert_same(k * found, at_one)
