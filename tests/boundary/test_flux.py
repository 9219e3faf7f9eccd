"""The light that reaches a floor past an occluder, against its closed form, to three digits.

The radiance of a diffuse floor under a uniform polygonal light is albedo radiance / pi times Lambert's form factor of
the part of the light that the occluder leaves: both are convex polygons, so what is hidden is the light clipped by the
occluder's shadow, projected from the point onto the light's plane. In float64 its finite differences have six digits,
while the renderer's derivative is wrong by half where one of the velocities of the local form is left out.
"""

import numpy as np
import pytest

import warp_psdr as psdr

from .scenes import camera, diffuse, floor, mesh, panel

ALBEDO, RADIANCE, HEIGHT = 0.7, 8.0, 2.4
LIGHT = np.array([[-0.4, -0.4, HEIGHT], [0.4, -0.4, HEIGHT], [0.4, 0.4, HEIGHT], [-0.4, 0.4, HEIGHT]])
OCCLUDER = np.array([[-0.3, -0.35, 1.4], [0.35, -0.25, 1.5], [0.3, 0.3, 1.45], [-0.3, 0.25, 1.5]])
#: Points a pixel and axis at which the closed form is averaged; the radiance is smooth in a penumbra.
POINTS = 8
STEP = 1e-4
#: Three digits.
TOLERANCE = 0.002
BATCHES = 16
OCCLUDER_NAME, LIGHT_NAME, FLOOR_NAME = "occluder.vertex_positions", "light.vertex_positions", "floor.to_world"
ALONG = np.array([0.3, 0.2, 1.0])


@pytest.fixture(scope="module")
def scene():
    found = psdr.load_dict({
        "type": "scene",
        "sensor": camera((0.1, -2.5, 1.8), (0.1, 0.0, 0.0), fov=34.0, rfilter="box"),
        "floor": floor(bsdf=diffuse(ALBEDO)),
        "occluder": mesh(OCCLUDER, [[0, 1, 2], [0, 2, 3]], diffuse(0.0)),
        "light": panel((0.0, 0.0, HEIGHT), 0.4, RADIANCE),
    })  # fmt: skip
    return found, psdr.traverse(found)


def clip(polygon: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Clip a convex polygon (N, 2) by another, both counter-clockwise [Sutherland and Hodgman 1974]."""
    for a, b in zip(window, np.roll(window, -1, axis=0), strict=True):
        edge = b - a
        side = edge[0] * (polygon[:, 1] - a[1]) - edge[1] * (polygon[:, 0] - a[0])
        kept = []
        for i in range(len(polygon)):
            j = (i + 1) % len(polygon)
            if side[i] >= 0.0:
                kept.append(polygon[i])
            if side[i] * side[j] < 0.0:
                kept.append(polygon[i] + side[i] / (side[i] - side[j]) * (polygon[j] - polygon[i]))
        if len(kept) < 3:
            return np.zeros((0, 2))
        polygon = np.array(kept)
    return polygon


def form_factor(corners: np.ndarray, x: np.ndarray) -> float:
    """Lambert's formula: the integral of cos(theta) over the directions to a polygon above a horizontal receiver."""
    r = corners - x
    r = r / np.linalg.norm(r, axis=1)[:, None]
    s = np.roll(r, -1, axis=0)
    normal = np.cross(r, s)
    sine = np.linalg.norm(normal, axis=1)
    angle = np.arctan2(sine, (r * s).sum(axis=1))
    return 0.5 * abs((angle * normal[:, 2] / sine).sum())


def radiance(x: np.ndarray, occluder: np.ndarray, light: np.ndarray) -> float:
    height = light[0, 2]
    scale = (height - x[2]) / (occluder[:, 2] - x[2])
    shadow = x[:2] + scale[:, None] * (occluder[:, :2] - x[:2])
    # The quadrilateral is bent along its diagonal: two triangles, whose shadows do not overlap.
    hidden = 0.0
    for triangle in (shadow[[0, 1, 2]], shadow[[0, 2, 3]]):
        common = clip(light[:, :2], triangle)
        if len(common):
            hidden += form_factor(np.column_stack([common, np.full(len(common), height)]), x)
    return ALBEDO / np.pi * RADIANCE * (form_factor(light, x) - hidden)


def flux(scene, occluder: np.ndarray, light: np.ndarray, z: float) -> float:
    """Sum of the image's red channel."""
    record, values = scene.camera(0), scene.values.numpy().astype(np.float64)
    pose = values[record.to_world : record.to_world + 16].reshape(4, 4)
    k = np.tan(np.radians(values[record.x_fov]) / 2.0)
    n = record.width * POINTS
    film = (np.arange(n) + 0.5) / n
    total = 0.0
    for t in film:
        for s in film:
            d = pose[:3, :3] @ np.array([(1.0 - 2.0 * s) * k, (1.0 - 2.0 * t) * k, 1.0])
            x = pose[:3, 3] + (z - pose[2, 3]) / d[2] * d
            total += radiance(x, occluder, light)
    return total / POINTS**2


MOTIONS = {
    "occluder moves": (ALONG, 0.0, 0.0),
    "light scales": (np.zeros(3), 1.0, 0.0),
    "floor moves": (np.zeros(3), 0.0, 1.0),
    "all move": (ALONG, 1.0, 1.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", MOTIONS)
def test_the_flux_past_an_occluder(scene, what) -> None:
    found, params = scene
    shift, growth, rise = MOTIONS[what]
    grown = growth * (LIGHT - [0.0, 0.0, HEIGHT])

    def moved(h: float) -> float:
        return flux(found, OCCLUDER + h * shift, LIGHT + h * grown, h * rise)

    exact = (moved(STEP) - moved(-STEP)) / (2.0 * STEP)
    lift = np.zeros((4, 4), np.float32)
    lift[2, 3] = rise
    tangents = {
        OCCLUDER_NAME: np.broadcast_to(shift, (4, 3)).astype(np.float32),
        LIGHT_NAME: grown.astype(np.float32),
        FLOOR_NAME: lift,
    }
    tangents = {name: t for name, t in tangents.items() if np.any(t)}
    # No edge is in view; the interior term is nearly free of noise.
    method = psdr.boundary.PathSpace(spp_primary=1, spp_secondary=4096, guiding=psdr.guiding.KdTree())
    options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=method), "spp": 512}
    sums = [
        psdr.render_forward(found, params, tangents, seed=s, **options).numpy()[..., 0].sum(dtype=np.float64)
        for s in range(BATCHES)
    ]
    ratio = np.array(sums) / exact
    error = ratio.std(ddof=1) / np.sqrt(BATCHES)
    assert 3.0 * error < TOLERANCE, f"too noisy to tell: {ratio.mean():.4f} +- {error:.4f}"
    assert abs(ratio.mean() - 1.0) < TOLERANCE, f"{ratio.mean():.4f} +- {error:.4f} of {exact:.4f}"


@pytest.mark.slow
def test_the_image_is_the_closed_form(scene) -> None:
    found, _params = scene
    image = psdr.render(found, integrator=psdr.PathIntegrator(max_depth=2), spp=8192, seed=3).numpy()
    # Absorbs the noise of 16 x 16 x 8192 samples.
    assert image[..., 0].sum() == pytest.approx(flux(found, OCCLUDER, LIGHT, 0.0), rel=1e-3)
