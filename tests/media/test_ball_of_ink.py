"""A ball of ink that moves and grows before a bulb, light scattered once, against quadrature.

The ball's border is an interface, on which points of the medium ride: nothing is hidden, and the interior term is
whole. Parallel rays weighted by a bell meet the ball; the bulb stands beyond it.
"""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients.configs import shift, widen
from tests.media.scenes import NOTHING, T, medium, point, whole
from tests.path.helpers import assert_mean

#: sigma_t, sigma_s and width of the bell: a dense ink, whose derivatives nearly cancel, and what is sampled, where the
#: bell leaves out the rim, whose rays are noisy.
DENSE, THIN = (1.3, 0.9, 0.5), (0.4, 0.3, 0.25)
BULB = np.array([0.4, 0.3, 2.5])
#: Pixels along a side, and half of what they see.
SIZE, REACH = 32, 1.25
#: Absorbs the facets of the ball and the pixels of the bell, relative.
FACETS = 5e-3
#: Of the batches' mean from the expected one, in standard errors.
Z = 4.0
POSE = "ball.to_world"
TINY = 1e-20
#: Motions of the pose, and the arguments of the quadrature that they change: its size, across the rays, along them.
MOTIONS = {
    "radius": (widen, 1.0),
    "centre": (shift(1.0, 0.0, 0.0), 0.0),
    "lift": (shift(0.0, 0.0, 1.0), 0.0),
}


def bell(x, y, width):
    return np.exp(-((x - 0.3) ** 2 + (y + 0.1) ** 2) / (2.0 * width**2))


def by_quadrature(ink, centre=0.0, lift=0.0, radius=1.0):
    """The bell's integral over the disk of a ball about (centre, 0, lift).

    Imaginary parts move the ball and leave the rays where they are: the radiance is 0 at the rim.
    """
    points, weights = np.polynomial.legendre.leggauss(40)
    # ---- Rays through the disk ----
    psi = 0.25 * np.pi * (points + 1.0)[:, None]
    phi = 2.0 * np.pi * (np.arange(64) + 0.5) / 64
    at, reach = np.real(centre), np.real(radius)
    x, y = at + reach * np.sin(psi) * np.cos(phi), reach * np.sin(psi) * np.sin(phi)
    area = reach**2 * np.sin(psi) * np.cos(psi) * 0.25 * np.pi * weights[:, None] * 2.0 * np.pi / 64
    found = area * bell(x, y, ink[2])
    # ---- What each of them sees ----
    x, y = x[..., None] - centre, y[..., None]
    half = np.sqrt(radius**2 - x**2 - y**2 + 0j)
    z = half * points
    to_bulb = [BULB[0] - centre - x, BULB[1] - y, BULB[2] - lift - z]
    r = np.sqrt(sum(v * v for v in to_bulb))
    along = (x * to_bulb[0] + y * to_bulb[1] + z * to_bulb[2]) / r
    out = -along + np.sqrt(along**2 - (x**2 + y**2 + z**2 - radius**2))
    scattered = ink[1] / (4.0 * np.pi) * np.exp(-ink[0] * (z + half + out)) / r**2
    return (found * (weights * half * scattered).sum(axis=-1)).sum()


def slopes(ink):
    return [by_quadrature(ink, **{name: at + 1j * TINY}).imag / TINY for name, (_, at) in MOTIONS.items()]


def test_the_quadrature_has_the_derivatives_of_differences():
    h = 1e-4
    ends = [[by_quadrature(DENSE, **{n: at + s * h}).real for n, (_, at) in MOTIONS.items()] for s in (1.0, -1.0)]
    differences = (np.array(ends[0]) - ends[1]) / (2.0 * h)
    np.testing.assert_allclose(slopes(DENSE), differences, rtol=2e-3)
    np.testing.assert_allclose(differences[:2], [-0.000982, 0.000388], atol=1e-6)


@pytest.mark.slow
def test_derivatives_equal_quadrature():
    """Image, reverse and forward mode."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    pose = T.look_at([0, 0, -5], [0, 0, 0], [0, 1, 0]) @ T.scale([REACH, REACH, 1.0])
    scene = psdr.load_dict(
        whole(
            sensor={"type": "orthographic", "to_world": pose, "film": film},
            ball={"type": "sphere", "resolution": 96, "bsdf": NOTHING, "interior": medium(THIN[0], THIN[1] / THIN[0])},
            bulb=point(BULB),
        )
    )
    params = psdr.traverse(scene)
    params.requires_grad_only(POSE)
    across = -((np.arange(SIZE) + 0.5) / SIZE * 2.0 - 1.0) * REACH
    weights = bell(across[None, :], across[:, None], THIN[2]) * (2.0 * REACH / SIZE) ** 2 / 3.0
    adjoint = np.broadcast_to(weights[..., None], (SIZE, SIZE, 3)).astype(np.float32)
    options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=None)}
    images, found = [], []
    for seed in range(8):
        params.zero_grad()
        images.append([(psdr.render(scene, spp=64, seed=seed, **options).numpy() * adjoint).sum()])
        psdr.render_backward(scene, params, adjoint, spp=2048, seed=seed, **options)
        grad = params[POSE].grad.numpy().astype(np.float64)
        found.append([(grad * motion(params[POSE].numpy())).sum() for motion, _ in MOTIONS.values()])
    expected = np.array(slopes(THIN))
    spread = np.std(found, axis=0, ddof=1) / np.sqrt(8.0)
    assert_mean(np.array(images), by_quadrature(THIN).real, "image", FACETS)
    bound = Z * spread + FACETS * np.abs(expected)
    assert (bound < 0.02 * np.abs(expected)).all(), "too noisy to tell"
    assert (np.abs(np.mean(found, axis=0) - expected) < bound).all(), (np.mean(found, axis=0), expected, spread)
    for motion, _ in MOTIONS.values():
        tangent = motion(params[POSE].numpy())
        image = psdr.render_forward(scene, params, {POSE: tangent}, spp=64, seed=3, **options).numpy()
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, spp=64, seed=3, **options)
        reverse = (params[POSE].grad.numpy().astype(np.float64) * tangent).sum()
        np.testing.assert_allclose((image * adjoint).sum(), reverse, rtol=2e-3)
