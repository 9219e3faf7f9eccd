"""Gradients of every vertex against a closed form, without finite differences of an image."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

import warp_psdr as psdr

from .measure import accumulated
from .scenes import ball, camera, diffuse, floor, load, sky

ALBEDO = np.array([0.3, 0.5, 0.7])


def outline(scene, vertices: np.ndarray) -> ConvexHull:
    """Outline, in pixels from the optical axis, of a convex mesh: its ``volume`` is the area."""
    camera, values = scene.camera(0), scene.values.numpy().astype(np.float64)
    pose = values[camera.to_world : camera.to_world + 16].reshape(4, 4)
    p = (vertices - pose[:3, 3]) @ np.linalg.inv(pose[:3, :3]).T
    scale = 0.5 * camera.width / np.tan(np.radians(values[camera.x_fov]) / 2.0)
    return ConvexHull(scale * p[:, :2] / p[:, 2:])


@pytest.mark.slow
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
        high = outline(scene, moved).volume
        moved[i] -= 2.0 * step
        exact[i] = (high - outline(scene, moved).volume) / (2.0 * step)
    exact *= -(1.0 - ALBEDO).sum()
    params.requires_grad_only(name)
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


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("smooth", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["flat", "interpolated"])
def test_creases_beside_a_silhouette_do_not_count_it_again(smooth: bool, depth: int) -> None:
    """A small ball of 5,120 triangles in a room a hundred times its size: it shines, so only its outline matters.

    The principal point moves all of it across a box filter: a pixel gains what enters on one side less what leaves on
    the other, the lengths of the pixel's two sides inside of the outline. A naive estimator looks past each crease at
    some fixed distance, within which creases of fine meshes run beside their silhouette: 15 % too much.
    """
    shining = {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    shape = ball((0.0, 0.0, 0.0), 0.1, diffuse(0.0), subdivisions=4, smooth=smooth, emitter=shining)
    view = camera((0.11, -1.0, 0.07), (0.02, 0.0, 0.013), fov=20.0, rfilter="box")
    scene = psdr.load_dict({"type": "scene", "sensor": view, "shape": shape, "floor": floor(-5.0, 10.0, diffuse(0.0))})
    params = psdr.traverse(scene)
    name = "sensor.principal_point_offset_x"
    integrator = psdr.PathIntegrator(max_depth=depth)
    image = psdr.render_forward(scene, params, {name: 1.0 / 16.0}, integrator=integrator, spp=2048).numpy()[..., 0]
    hull = outline(scene, params["shape.vertex_positions"].numpy().astype(np.float64))
    # Pixel borders, and how long the outline's chord along each of them is within each row.
    borders = np.arange(-8, 9)
    corners = hull.points[hull.vertices]
    inside = np.zeros((17, 16))
    for i, x in enumerate(borders):
        ends = []
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if (a[0] - x) * (b[0] - x) < 0.0:
                ends.append(a[1] + (x - a[0]) / (b[0] - a[0]) * (b[1] - a[1]))
        if ends:
            inside[i] = np.clip(np.minimum(max(ends), borders[1:]) - np.maximum(min(ends), borders[:-1]), 0.0, None)
    # The film is mirrored, in both directions, and moves towards larger coordinates of the outline.
    exact = (inside[:-1] - inside[1:]).T[::-1, ::-1]
    assert np.linalg.norm(exact) > 1.0
    assert np.linalg.norm(image - exact) < 0.01 * np.linalg.norm(exact)


@pytest.mark.parametrize("angle", [0.0, 0.6])
def test_half_of_a_box_seen_along_its_walls(angle: float) -> None:
    """Orthographic, black before white: with halves a, b, c a (2 c cos + 2 b sin), by a and c, and by x the height.

    Edges of a wall in the plane of rays are one behind the other; on either side of the box one of them counts.
    """
    a, b, c = 0.5, 0.3, 0.4
    pose = psdr.Transform.look_at([0.0, -3.0 * np.cos(angle), 3.0 * np.sin(angle)], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "orthographic",
                "to_world": pose,
                "film": {"type": "hdrfilm", "width": 10, "height": 10, "rfilter": {"type": "box"}},
            },
            "box": {
                "type": "cube",
                "to_world": psdr.Transform.scale([a, b, c]),
                "bsdf": {"type": "diffuse", "reflectance": 0.0},
            },
            "sky": {"type": "constant", "radiance": 1.0},
        }
    )
    params = psdr.traverse(scene)
    params.requires_grad("box.to_world")
    options = {"spp": 4096, "integrator": psdr.PathIntegrator(max_depth=1)}
    height, end = 2.0 * (c * np.cos(angle) + b * np.sin(angle)), 2.0 * np.cos(angle)
    for half, sign in ((slice(0, 5), -1.0), (slice(5, 10), 1.0)):
        adjoint = np.zeros((10, 10, 3), np.float32)
        adjoint[:, half] = -(0.2**2) / 3.0
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, **options)
        g = params["box.to_world"].grad.numpy().reshape(4, 4)
        found = [g[0, 0], g[2, 2], sign * g[0, 3]]
        np.testing.assert_allclose(found, [height, a * end, height], rtol=0.03)


@pytest.mark.slow
def test_horizons_of_mirrors_seen_in_grazing_reflections_move_as_they_should() -> None:
    """A parallel camera that moves aside shifts its image: rows gain what enters at one end less what leaves.

    A mirror of facets with interpolated normals, one seen at 2e-4 radians: rays that enter through the horizon of the
    one before go along it, so far that it matters how far off the surface they started.
    """
    sides, off = 16, 2e-4
    angle = 2.0 * np.pi / sides * np.arange(sides)
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
    following = (np.arange(sides) + 1) % sides
    low, high = np.arange(sides), following
    faces = np.concatenate([np.stack([low, high, high + sides], 1), np.stack([low, high + sides, low + sides], 1)])
    look = np.pi / sides + 0.5 * np.pi - off
    d = np.array([np.cos(look), np.sin(look), 0.0])
    edge = np.array([1.0, 0.0, 0.0])
    width, half = 32, 2.5e-4
    pose = psdr.Transform.look_at(list(edge - d), list(edge), [0, 0, 1]) @ psdr.Transform.scale([half, half, 1.0])
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "orthographic",
                "to_world": pose,
                "film": {"type": "hdrfilm", "width": width, "height": 4, "rfilter": {"type": "box"}},
            },
            "shape": {
                "type": "mesh",
                "vertices": np.concatenate([ring - np.eye(3)[2], ring + np.eye(3)[2]]),
                "faces": faces,
                "face_normals": False,
                "bsdf": {"type": "twosided", "bsdf": {"type": "conductor", "material": "Ag"}},
            },
            "sky": {"type": "constant", "radiance": 1.0},
        }
    )
    params = psdr.traverse(scene)
    tangent = np.zeros((4, 4))
    tangent[:3, 3] = pose.matrix[:3, 0] / half
    integrator = psdr.PathIntegrator(max_depth=3)
    image = psdr.render(scene, integrator=integrator, spp=64).numpy().astype(np.float64)[..., 0]
    moved = psdr.render_forward(scene, params, {"sensor.to_world": tangent}, integrator=integrator, spp=8192).numpy()
    assert image.min() < 0.5  # a pixel in which paths end between the two horizons
    gain = moved.astype(np.float64)[..., 0].mean(axis=0).sum() * 2.0 * half / width
    assert gain == pytest.approx((image[:, 0] - image[:, -1]).mean(), abs=0.03)


def test_needles_at_a_pole_seen_edge_on_count_their_outline_once():
    """A tessellated sphere has the outline of an exact one, also where the camera sees the triangles of a pole edge-on.

    Their images are narrower there than the distance at which rays pass edges.
    """

    def summed(**how) -> float:
        sphere = {"type": "sphere", "center": [0.1, 0.05, 0.2], "radius": 0.45, "bsdf": diffuse(0.0), **how}
        sensor = camera((4.0, 1.0, 0.6), (0.0, 0.0, 0.0), fov=38.0)
        scene = psdr.load_dict({"type": "scene", "sensor": sensor, "sky": sky(), "ball": sphere})
        integrator = psdr.PathIntegrator(max_depth=1)
        tangents = {"ball.to_world": lambda pose: pose * [[1.0, 1.0, 1.0, 0.0]] * [[1.0], [1.0], [1.0], [0.0]]}
        return float(accumulated(scene, tangents, integrator, 256, 1).sum())

    exact = summed(exact=True)
    assert exact < -10.0
    assert summed(resolution=192, face_normals=True) == pytest.approx(exact, rel=0.006)
