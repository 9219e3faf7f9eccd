"""Derivatives of images of shapes without triangles, summed over the film, against formulas."""

import numpy as np
import pytest

import warp_psdr as psdr

from .scenes import T, diffuse

BATCHES = 8


def before(half: float, depth: int, **parts) -> tuple[psdr.Scene, dict]:
    """A scene that parallel rays along y look at, in a square of this half side, and options of a gradient."""
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    view = T.look_at([0, -4, 0], [0, 0, 0], [0, 0, 1]).scale([half, half, 1.0])
    sensor = {"type": "orthographic", "to_world": view, "film": film}
    scene = psdr.load_dict({"type": "scene", "sensor": sensor, **parts})
    return scene, {"integrator": psdr.PathIntegrator(max_depth=depth)}


def flux(scene: psdr.Scene, half: float, tangents: dict, spp: int, options: dict) -> tuple[float, float]:
    """The derivative of the integral of the red channel over the square, and its standard error."""
    params = psdr.traverse(scene)
    found = []
    for seed in range(BATCHES):
        image = psdr.render_forward(scene, params, tangents, spp=spp, seed=seed, **options).numpy()
        found.append(image[..., 0].astype(np.float64).sum() * (2.0 * half / 16.0) ** 2)
    return float(np.mean(found)), float(np.std(found, ddof=1) / np.sqrt(BATCHES))


def grown(params, name: str) -> np.ndarray:
    """A pose whose radius grows by one a unit of it."""
    pose = params[name].numpy().astype(np.float64)
    tangent = 0.0 * pose
    tangent[:3, :3] = pose[:3, :3] / np.linalg.norm(pose[:3, 0])
    return tangent.astype(np.float32)


@pytest.mark.slow
def test_a_white_furnace_loses_what_a_body_absorbs() -> None:
    """(albedo - 1) L dA: under a uniform sky a convex body has the radiance albedo L all over."""
    radius, albedo, half = 0.5, 0.3, 0.8
    ball = {"type": "sphere", "exact": True, "radius": radius, "bsdf": diffuse(albedo)}
    scene, options = before(half, 2, sky={"type": "constant", "radiance": 1.0}, ball=ball)
    tangent = grown(psdr.traverse(scene), "ball.to_world")
    mean, error = flux(scene, half, {"ball.to_world": tangent}, 512, options)
    exact = (albedo - 1.0) * 2.0 * np.pi * radius
    assert error < 0.01 * abs(exact) and abs(mean - exact) < 4.0 * error + 1e-3 * abs(exact), (mean, error, exact)


@pytest.mark.slow
@pytest.mark.parametrize("phase", [0.6, 1.9])
def test_the_phase_curve_of_a_lambertian_sphere(phase: float) -> None:
    """2/3 R^2 albedo E (sin a + (pi - a) cos a) / pi, a the angle between sun and viewer: by a and by R."""
    radius, albedo, half, irradiance = 0.5, 0.8, 0.8, 2.0
    ball = {"type": "sphere", "exact": True, "radius": radius, "bsdf": diffuse(albedo)}
    # Light travels away from the sun, which stands at the phase angle from the viewer.
    pose = T.look_at([0, 0, 0], [-np.sin(phase), np.cos(phase), 0.0], [0, 0, 1])
    sun = {"type": "directional", "to_world": pose, "irradiance": irradiance}
    scene, options = before(half, 2, sun=sun, ball=ball)
    scale = 2.0 / 3.0 * radius**2 * albedo * irradiance / np.pi
    turned = np.zeros((4, 4), np.float32)
    turned[:3, 2] = [-np.cos(phase), -np.sin(phase), 0.0]
    rows = [
        ({"sun.to_world": turned}, -scale * (np.pi - phase) * np.sin(phase)),
        (
            {"ball.to_world": grown(psdr.traverse(scene), "ball.to_world")},
            2.0 / radius * scale * (np.sin(phase) + (np.pi - phase) * np.cos(phase)),
        ),
    ]
    for tangents, exact in rows:
        mean, error = flux(scene, half, tangents, 512, options)
        assert error < 0.01 * abs(exact) and abs(mean - exact) < 4.0 * error + 1e-3 * abs(exact), (mean, error, exact)


@pytest.mark.slow
@pytest.mark.parametrize(("gap", "expected", "spp"), [(1e-2, -0.538, 256), (1e-3, -1.070, 512), (1e-4, -1.617, 1024)])
def test_the_outline_of_a_smooth_union_next_to_where_it_parts(gap: float, expected: float, spp: int) -> None:
    """Two balls of radius .5, blended within .1, that part at 2 (r + k ln 2): the area's derivative grows without end.

    Expected are differences of the area, by quadrature in float64. The outline lies on faces of voxels, in the plane
    of symmetry.
    """
    radius, width, half = 0.5, 0.1, 1.3
    apart = 2.0 * (radius + width * np.log(2.0)) + gap
    box = np.array([2.5, 1.4, 1.4])
    at = [np.linspace(-0.5, 0.5, n) * side for n, side in zip((97, 55, 55), box, strict=True)]
    z, y, x = np.meshgrid(*at[::-1], indexing="ij")
    a, b = (np.sqrt((x + side * apart) ** 2 + y**2 + z**2) - radius for side in (0.5, -0.5))
    values = psdr.sdf.smooth_union(a, b, width)
    share = 1.0 / (1.0 + np.exp((a - b) / width))  # of the ball at -x
    slope = 0.5 * (share * (x + 0.5 * apart) / (a + radius) - (1.0 - share) * (x - 0.5 * apart) / (b + radius))
    pose = T.translate(list(-0.5 * box)).scale(list(box))
    grid = {"grid": psdr.sdf.coefficients(values), "interpolation": "cubic", "to_world": pose, "bsdf": diffuse(0.0)}
    scene, options = before(half, 1, sky={"type": "constant", "radiance": 1.0}, body={"type": "sdfgrid", **grid})
    tangent = psdr.sdf.coefficients(slope)
    mean, error = flux(scene, half, {"body.grid": tangent[..., None]}, spp, options)
    # The image shows the sky, which the union hides.
    assert error < 0.015 * abs(expected) and abs(-mean - expected) < 4.0 * error + 0.01 * abs(expected), (mean, error)
