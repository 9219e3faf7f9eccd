"""Frames of projected images, and their texels, where a light, a surface or the camera moves."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import STANDARD_ERRORS, assert_transposes
from .scenes import T

SIZE = 8
BATCHES = 4
TEXELS = np.random.default_rng(0).uniform(0.2, 1.0, (4, 5, 3)).astype(np.float32)
IMAGE = {"type": "bitmap", "bitmap": TEXELS, "raw": True}
CONSTANT = {"type": "rgb", "value": [1.0, 0.6, 0.3]}


def film(rfilter):
    return {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": rfilter}}


def lit(irradiance, **objects):
    """A floor under a projector, and more objects; they may take the place of those."""
    lamp = {"type": "projector", "to_world": T.look_at([0.6, -0.4, 1.8], [0.1, 0.2, 0.0], [0, 1, 0]), "fov": 40.0}
    view = T.look_at([0.3, -0.6, 2.5], [0.1, 0.0, 0.0], [0, 1, 0])
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 60.0, "to_world": view, "film": film("gaussian")},
            "floor": {"type": "rectangle", "to_world": T.scale(4)},
            "lamp": {**lamp, "irradiance": irradiance, "scale": 4.0},
            **objects,
        }
    )
    return scene, psdr.traverse(scene)


def moved(scene, params, name, value, integrator, spp, seed):
    base = params[name].numpy().copy()
    params[name] = value.astype(np.float32)
    params.update()
    result = psdr.render(scene, integrator=integrator, spp=spp, seed=seed).numpy().astype(np.float64)
    params[name] = base
    params.update()
    return result


def assert_slope(scene, params, name, tangent, step, depth=2, spp=512, difference_spp=2048, **options):
    """Regress batches of derivatives on a difference; the weights have random numbers of their own."""
    integrator = psdr.PathIntegrator(max_depth=depth, **options)
    base = params[name].numpy().astype(np.float64)

    def difference(seed):
        images = [
            moved(scene, params, name, base + s * step * tangent, integrator, difference_spp, seed) for s in (1, -1)
        ]
        return (images[0] - images[1]) / (2.0 * step)

    def forward(seed):
        tangents = {name: tangent.astype(np.float32)}
        return psdr.render_forward(scene, params, tangents, integrator=integrator, spp=spp, seed=seed).numpy()

    weights = difference(900)
    pairs = [((weights * forward(s)).sum(), (weights * difference(s)).sum()) for s in range(BATCHES)]
    a, b = np.array(pairs, np.float64).T
    error = np.hypot(a.std(ddof=1) / a.mean(), b.std(ddof=1) / b.mean()) / np.sqrt(BATCHES)
    assert error < 0.02
    assert abs(a.mean() / b.mean() - 1.0) < 0.02 + STANDARD_ERRORS * error


def shift(*way):
    tangent = np.zeros((4, 4))
    tangent[:3, 3] = way
    return tangent


def turn(pose, *axis):
    x, y, z = axis
    tangent = np.zeros((4, 4))
    tangent[:3, :3] = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose.numpy()[:3, :3]
    return tangent


def test_the_closed_form_of_a_frame_that_opens_on_a_facing_floor() -> None:
    """The light of a constant image is s E rho 4 tan(fov / 2)^2, all of whose change enters at the frame."""
    pose = T.look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "orthographic", "to_world": pose @ T.scale([2, 2, 1]), "film": film("box")},
            "floor": {"type": "rectangle", "to_world": T.scale(3), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
            "lamp": {"type": "projector", "to_world": pose, "irradiance": CONSTANT, "scale": 4.0, "fov": 50.0},
        }
    )
    params = psdr.traverse(scene)
    integrator = psdr.PathIntegrator(max_depth=2)
    found = psdr.render_forward(scene, params, {"lamp.x_fov": 1.0}, integrator=integrator, spp=256).numpy()
    half = np.radians(25.0)
    exact = 4.0 * 0.5 * 4.0 * 2.0 * np.tan(half) / np.cos(half) ** 2 * np.radians(0.5)
    of_pixel = (4.0 / SIZE) ** 2
    np.testing.assert_allclose(found.sum(axis=(0, 1)) * of_pixel, exact * np.array(CONSTANT["value"]), rtol=5e-3)
    # Where the floor comes nearer, its light is the same: what brightens it leaves at the frame.
    closer = {"floor.to_world": shift(0, 0, 1).astype(np.float32)}
    found = psdr.render_forward(scene, params, closer, integrator=integrator, spp=256).numpy()
    assert np.abs(found.sum(axis=(0, 1))).max() < 0.01 * np.abs(found).sum()


@pytest.mark.parametrize(
    "irradiance",
    [pytest.param(IMAGE, marks=pytest.mark.slow), IMAGE | {"filter_type": "nearest"}],
    ids=["bilinear", "nearest"],
)
def test_the_lamp_turns_and_opens(irradiance) -> None:
    scene, params = lit(irradiance)
    assert_slope(scene, params, "lamp.to_world", turn(params["lamp.to_world"], 0.3, 0.5, 1.0), 0.01)
    assert_slope(scene, params, "lamp.x_fov", np.ones(1), 0.3)
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 64, "seed": 2}
    assert_transposes(scene, params, ["lamp.to_world", "lamp.x_fov"], options)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["floor.to_world", "sensor.to_world"])
def test_the_receiver_and_the_camera_move(name) -> None:
    scene, params = lit(IMAGE)
    assert_slope(scene, params, name, shift(0.5, 0.3, 0.7), 0.01)
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 64, "seed": 2}
    assert_transposes(scene, params, [name], options)


@pytest.mark.slow
@pytest.mark.parametrize("method", [psdr.boundary.PathSpace(), psdr.boundary.EdgeSampling()], ids=["path", "edge"])
def test_light_of_the_frame_between_surfaces(method) -> None:
    wall = T.look_at([-1.2, 0.0, 0.5], [1.0, 0.2, 0.6], [0, 0, 1])
    box = {"type": "cube", "to_world": T.translate([0.4, 0.5, 0.3]) @ T.scale(0.2)}
    scene, params = lit(IMAGE, wall={"type": "rectangle", "to_world": wall}, box=box)
    tangent = turn(params["lamp.to_world"], 0.3, 0.5, 1.0)
    assert_slope(scene, params, "lamp.to_world", tangent, 0.01, depth=3, boundary=method)


@pytest.mark.slow
def test_a_frame_on_an_exact_sphere() -> None:
    scene, params = lit(IMAGE, ball={"type": "sphere", "radius": 0.5, "center": [-0.2, 0.3, 0.3], "exact": True})
    assert_slope(scene, params, "sensor.to_world", shift(0.5, 0.3, 0.7), 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lamp.to_world", "mirror.to_world", "sensor.to_world"])
def test_a_frame_in_a_mirror(name) -> None:
    mirror = T.translate([0, 1.0, 0.9]) @ T.rotate([1, 0.1, 0.05], 85) @ T.scale(0.8)
    view = T.look_at([0.2, -1.6, 1.3], [-0.05, 1.0, 0.35], [0, 0, 1])
    scene, params = lit(
        IMAGE,
        sensor={"type": "perspective", "fov": 22.0, "to_world": view, "film": film("gaussian")},
        mirror={"type": "rectangle", "to_world": mirror, "bsdf": {"type": "conductor"}},
    )
    tangent = shift(0.3, 0.5, 0.3)
    if name == "lamp.to_world":
        tangent = turn(params[name], 0.3, 0.5, 1.0)
    assert_slope(scene, params, name, tangent, 0.01, depth=3, spp=2048, difference_spp=8192)
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 32, "seed": 2}
    assert_transposes(scene, params, [name], options)
