"""Gradients of every vertex against a closed form, without finite differences of an image."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

import warp_psdr as psdr

from .scenes import load

ALBEDO = np.array([0.3, 0.5, 0.7])


def outline_area(scene, vertices: np.ndarray) -> float:
    """Area, in pixels, of the image of a convex mesh."""
    camera, values = scene.camera(0), scene.values.numpy().astype(np.float64)
    pose = values[camera.to_world : camera.to_world + 16].reshape(4, 4)
    p = (vertices - pose[:3, 3]) @ np.linalg.inv(pose[:3, :3]).T
    scale = 0.5 * camera.width / np.tan(np.radians(values[camera.x_fov]) / 2.0)
    return ConvexHull(scale * p[:, :2] / p[:, 2:]).volume


def test_a_convex_body_under_a_uniform_sky_is_its_outline() -> None:
    """All of it has the radiance albedo x sky, so the sum of the image is that of the sky less (1 - albedo) area.

    Unlike a rigid motion, single vertices tell where on an edge a sample lies.
    """
    scene, params = load("silhouette tent")
    name = "shape.vertex_positions"
    vertices = params[name].numpy().astype(np.float64)
    exact = np.zeros_like(vertices)
    # The area is smooth up to 10^-6, where vertices enter or leave the outline; float64 leaves 10^-9 of it.
    step = 1e-6
    for i in np.ndindex(vertices.shape):
        moved = vertices.copy()
        moved[i] += step
        high = outline_area(scene, moved)
        moved[i] -= 2.0 * step
        exact[i] = (high - outline_area(scene, moved)) / (2.0 * step)
    exact *= -(1.0 - ALBEDO).sum()
    params.requires_grad(name)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=psdr.boundary.PathSpace(spp_primary=1024, spp_secondary=1))
    found = []
    for seed in range(4):
        params.zero_grad()
        psdr.render_backward(scene, params, np.ones((16, 16, 3)), integrator=integrator, spp=64, seed=seed)
        found.append(params[name].grad.numpy().astype(np.float64))
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / 2.0
    assert (mean * exact).sum() / (exact**2).sum() == pytest.approx(1.0, abs=0.02)
    # Absorbs the noise of four batches.
    assert np.linalg.norm(mean - exact) < 3.0 * np.linalg.norm(error) + 0.01 * np.linalg.norm(exact)
    assert np.linalg.norm(error) < 0.05 * np.linalg.norm(exact)
