"""Steps of textures on curves that move, are seen moving, or slide, at every vertex of a path."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import assert_transposes
from .scenes import T, floor
from .test_texture_steps import assert_slope, camera, checkers, load

TO_UV = np.array([[2.0, 0.4, 0.13], [0.0, 3.3, 0.21], [0.0, 0.0, 1.0]])
POSE, POINTS, UV = "body.to_world", "body.control_points", "body.bsdf.reflectance.to_uv"
VIEW = T.look_at([0.3, -2.6, 1.0], [0, 0, 0], [0, 0, 1])


def body(plugin: str, to_uv=TO_UV, height: float = 0.0) -> dict:
    """A thick tube, bent and tapered, whose ends are outside of the picture."""
    k = np.linspace(-1.0, 1.0, 9 if plugin == "bsplinecurve" else 5)
    points = np.column_stack([2.2 * k, 0.2 * k * k, 0.25 * k + height, 0.3 + 0.06 * k])
    bsdf = {"type": "diffuse", "reflectance": checkers(to_uv)}
    return {"type": plugin, "control_points": points, "bsdf": bsdf}


def tangent_of(params, name: str) -> np.ndarray:
    values = params[name].numpy()
    if name == UV:
        return np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 0.7], [0.0, 0.0, 0.0]])
    if values.shape == (4, 4):
        tangent = np.zeros((4, 4))
        tangent[:3, 3] = [1.0, 0.3, 0.6]
        return tangent
    return np.random.default_rng(4).normal(size=values.shape) * np.where(np.arange(values.size) % 4 == 3, 0.2, 1.0)


def case(plugin: str, name: str, slow: bool = True):
    return pytest.param(plugin, name, id=f"{plugin}, {name}", marks=[pytest.mark.slow] * slow)


@pytest.mark.parametrize(
    ("plugin", "name"),
    [
        *(case("bsplinecurve", name) for name in ("sensor.to_world", POSE, POINTS, UV)),
        *(case("linearcurve", name) for name in ("sensor.to_world", POSE, POINTS, UV)),
    ],
)
def test_what_the_camera_sees(plugin: str, name: str) -> None:
    scene, params = load(sensor=camera(VIEW), body=body(plugin), sky={"type": "constant"})
    spp = (512, 8192) if name != UV else (256, 2048)
    assert_slope(scene, params, name, tangent_of(params, name), 2, *spp)
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 64, "seed": 2}
    assert_transposes(scene, params, [name], options)


@pytest.mark.slow
@pytest.mark.parametrize("name", [POSE, POINTS, UV, "floor.to_world"])
def test_what_a_floor_sees(name: str) -> None:
    """The camera looks at a floor alone, which a textured tube above it lights with what it scatters."""
    view = T.look_at([0.0, -2.0, 0.9], [0, -0.4, -0.8], [0, 0, 1])
    made = body("bsplinecurve", np.array([[1.0, 0.4, 0.13], [0.0, 1.3, 0.21], [0.0, 0.0, 1.0]]), 0.1)
    light = {"type": "rectangle", "to_world": T.translate([0.0, -0.8, -0.7]).scale(0.3)}
    light["emitter"] = {"type": "area", "radiance": 20.0}
    scene, params = load(sensor=camera(view), body=made, floor=floor(-0.8, 1.5), light=light)
    assert_slope(scene, params, name, tangent_of(params, name), 3, spp=8192, difference_spp=32768, step=8e-3)
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 16, "seed": 2}
    assert_transposes(scene, params, [name], options)


def test_steps_behind_mirrors_and_along_seams_are_refused() -> None:
    mirror = {"type": "rectangle", "to_world": T.translate([0, 0, -3]), "bsdf": {"type": "conductor"}}
    scene, params = load(sensor=camera(VIEW), body=body("bsplinecurve"), mirror=mirror, sky={"type": "constant"})
    params.requires_grad_only(POSE)
    with pytest.raises(ValueError, match="not known on curves beside smooth mirrors and glass"):
        psdr.plan(scene, params)
    # Three fields around: where angles start anew, two of one colour meet, and a line lies there.
    along = np.diag([1.5, 2.2, 1.0])
    scene, params = load(sensor=camera(VIEW), body=body("bsplinecurve", along), sky={"type": "constant"})
    params.requires_grad_only(UV)
    with pytest.raises(ValueError, match="slide where angles start anew"):
        psdr.plan(scene, params)
