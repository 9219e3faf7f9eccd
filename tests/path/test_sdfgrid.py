"""Images of grids of signed distances: Mitsuba's, and a sphere's closed form."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.peer import MITSUBA_ROUNDING, for_mitsuba

from .helpers import batches, blocks, largest_z, mean_and_variance, z_limit

T = psdr.Transform
PLAIN = T.translate([-0.5, -0.4, 0.1]).scale([1.1, 0.9, 1.0])
SHEARED = T(PLAIN.matrix @ np.array([[1, 0.4, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
TURNED = T(
    T.translate([0.0, 0.0, 0.6]).rotate([1, 2, 3], 40.0).scale([1.1, 0.9, 1.0]).matrix
    @ T.translate([-0.5, -0.5, -0.5]).matrix
)
DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.3, 0.6, 0.7]}}
ROUGH = {"type": "roughconductor", "alpha": 0.2}


def nodes(count: int) -> tuple[np.ndarray, ...]:
    """Return x, y, z of the nodes, each (Z, Y, X)."""
    at = np.linspace(0.0, 1.0, count)
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    return x, y, z


def sphere(count: int, radius: float) -> np.ndarray:
    x, y, z = nodes(count)
    return (np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - radius).astype(np.float32)[..., None]


def blob(count: int) -> np.ndarray:
    x, y, z = nodes(count)
    bumps = 0.06 * np.sin(9.0 * x) * np.sin(8.0 * y + 1.0) * np.sin(10.0 * z)
    return sphere(count, 0.33) + bumps.astype(np.float32)[..., None]


def scene(grid: np.ndarray, pose: psdr.Transform, normals: str, bsdf: dict, **more) -> dict:
    """An object above a floor, under a lamp and a sky."""
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    lamp = T.translate([1, -1, 3]).rotate([1, 0, 0], 180).scale(0.5)
    eye = T.look_at([0, -3, 1.5], [0, 0, 0.4], [0, 0, 1])
    floor = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.4]}}
    light = {"type": "area", "radiance": {"type": "rgb", "value": [8.0, 8.0, 8.0]}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": {"type": "perspective", "fov": 45.0, "to_world": eye, "film": film},
        "floor": {"type": "rectangle", "to_world": T.scale(3.0), "bsdf": floor},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": light},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.3, 0.4]}},
        "body": {"type": "sdfgrid", "grid": grid, "normals": normals, "to_world": pose, "bsdf": bsdf},
        **more,
    }


def scaled(size: float) -> dict:
    """Return the scene with all lengths times ``size``."""
    described = scene(blob(16), T(T.scale(size).matrix @ TURNED.matrix), "analytic", DIFFUSE)
    eye = T.look_at([0, -3 * size, 1.5 * size], [0, 0, 0.4 * size], [0, 0, 1])
    described["sensor"] |= {"to_world": eye, "near_clip": 0.01 * size, "far_clip": 100.0 * size}
    for name in ("floor", "lamp"):
        described[name]["to_world"] = T(T.scale(size).matrix @ described[name]["to_world"].matrix)
    return described


def instanced(described: dict) -> dict:
    """Turn the body by an instance: in Mitsuba grids do not bear rotations of their own."""
    body = {key: value for key, value in described["body"].items() if key != "to_world"}
    copy = {"type": "instance", "to_world": described["body"]["to_world"], "g": {"type": "ref", "id": "group"}}
    return {**described, "group": {"type": "shapegroup", "b": body}, "body": copy}


def assert_mitsubas(described: dict, theirs: dict) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    peer = mi.load_dict(for_mitsuba(mi, theirs))
    images = np.stack([np.array(mi.render(peer, spp=32, seed=i)) for i in range(8)]).astype(np.float64)
    ours = batches(psdr.load_dict(described), count=8, spp=32, max_depth=4)
    (mean_a, var_a), (mean_b, var_b) = (mean_and_variance(blocks(x, 8)) for x in (ours, images))
    z = largest_z(var_a, var_b, mean_a - mean_b, mean_b, MITSUBA_ROUNDING)
    assert z.max() < z_limit(z.size, len(images) - 1)
    assert np.abs(mean_a / mean_b - 1.0).max() < 0.04


@pytest.mark.parametrize(
    ("grid", "pose", "normals", "bsdf"),
    [
        (blob(16), PLAIN, "smooth", DIFFUSE),
        pytest.param(blob(16), PLAIN, "analytic", DIFFUSE, marks=pytest.mark.slow),
        pytest.param(blob(16), SHEARED, "smooth", DIFFUSE, marks=pytest.mark.slow),
        pytest.param(sphere(32, 0.4), PLAIN, "smooth", ROUGH, marks=pytest.mark.slow),
        pytest.param(sphere(32, 0.4), PLAIN, "analytic", {"type": "dielectric"}, marks=pytest.mark.slow),
    ],
    ids=["smooth", "analytic", "sheared", "rough", "glass"],
)
def test_image_is_mitsubas(grid: np.ndarray, pose: psdr.Transform, normals: str, bsdf: dict) -> None:
    described = scene(grid, pose, normals, bsdf)
    assert_mitsubas(described, described)


@pytest.mark.slow_rows("analytic")
@pytest.mark.parametrize("normals", [pytest.param("smooth", marks=pytest.mark.slow), "analytic"])
def test_turned_image_is_mitsubas_instance(normals: str) -> None:
    described = scene(blob(16), TURNED, normals, DIFFUSE)
    assert_mitsubas(described, instanced(described))


@pytest.mark.slow
def test_image_beside_an_exact_sphere_is_mitsubas() -> None:
    ball = {"type": "sphere", "center": [0.6, -0.6, 0.3], "radius": 0.3, "bsdf": DIFFUSE}
    described = scene(blob(16), PLAIN, "smooth", DIFFUSE, ball={**ball, "exact": True})
    assert_mitsubas(described, scene(blob(16), PLAIN, "smooth", DIFFUSE, ball=ball))


@pytest.mark.slow
def test_a_grid_of_a_sphere_is_the_sphere_but_for_its_voxels() -> None:
    """Tri-linear interpolation of a convex function is above it, by h^2 / 8 times its second derivatives at most."""
    count, radius = 33, 0.4
    described = scene(sphere(count, radius), T.translate([-0.5, -0.5, 0.0]), "smooth", DIFFUSE)
    seen = psdr.render_aov(psdr.load_dict(described), "pp:position, nn:sh_normal, ss:shape_index", spp=1)
    on_it = seen["ss"].numpy().reshape(32, 32) == 2.0
    assert on_it.sum() > 50
    towards = seen["pp"].numpy()[on_it].astype(np.float64) - [0.0, 0.0, 0.5]
    distance = np.linalg.norm(towards, axis=1)
    inside = 2.0 / radius / 8.0 / (count - 1) ** 2
    assert (distance < radius + 1e-6).all() and (distance > radius - 1.1 * inside).all()
    cosines = (towards / distance[:, None] * seen["nn"].numpy()[on_it]).sum(axis=1)
    assert (cosines > 1.0 - 1e-3).all()


@pytest.mark.slow
def test_a_cubic_grid_of_a_sphere_is_a_smaller_sphere() -> None:
    """Smoothing adds h^2 / 6 times the Laplacian, 2 / r, to the distance."""
    count, radius = 33, 0.4
    described = scene(sphere(count, radius), T.translate([-0.5, -0.5, 0.0]), "analytic", DIFFUSE)
    described["body"]["interpolation"] = "cubic"
    seen = psdr.render_aov(psdr.load_dict(described), "pp:position, nn:sh_normal, ss:shape_index", spp=1)
    on_it = seen["ss"].numpy().reshape(32, 32) == 2.0
    assert on_it.sum() > 50
    towards = seen["pp"].numpy()[on_it].astype(np.float64) - [0.0, 0.0, 0.5]
    distance = np.linalg.norm(towards, axis=1)
    smoothed = radius - 1.0 / (3.0 * radius * (count - 1) ** 2)
    np.testing.assert_allclose(distance, smoothed, atol=2e-5)
    cosines = (towards / distance[:, None] * seen["nn"].numpy()[on_it]).sum(axis=1)
    assert (cosines > 1.0 - 1e-6).all()


def test_powers_of_two_scale_it_exactly() -> None:
    images = [batches(psdr.load_dict(scaled(2.0**k)), count=1, spp=8, max_depth=4) for k in (0, -13, 20)]
    for image in images[1:]:
        np.testing.assert_array_equal(image, images[0])


@pytest.mark.slow
def test_traced_vertices_lie_on_it() -> None:
    held = psdr.load_dict(scene(sphere(17, 0.4), TURNED, "smooth", DIFFUSE))
    vertex = psdr.trace_sample(held, pixel=(16, 14), sample=0).vertices[0]
    assert vertex.shape == "body" and vertex.face == -1
    local = np.linalg.inv(TURNED.matrix) @ np.append(vertex.position, 1.0)
    assert np.linalg.norm(local[:3] - 0.5) == pytest.approx(0.4, abs=0.002)
