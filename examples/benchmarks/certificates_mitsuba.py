"""Mitsuba 3's gradients as pairs of functions, as ``psdr.certify_function`` takes them."""

from collections.abc import Callable

import numpy as np
from common import import_mitsuba

SIZE, ALBEDO, SHIFT = 24, "floor.bsdf.reflectance.value", "shift"
#: Samples a pixel of images, and of gradients.
SPP, SPP_GRAD = 256, 64
FLOOR = [0.5, 0.4, 0.6]
#: Longest step of the shift, and ranges.
OPTIONS = {"units": {SHIFT: 0.2}, "bounds": {ALBEDO: (0.0, 1.0)}}


def stage(mi, lamp: dict, **shapes: dict):
    """Return the scene of a floor, a lamp and other shapes."""
    T = mi.ScalarTransform4f
    scene = {
        "type": "scene",
        "integrator": {
            "type": "prb_projective",
            "max_depth": 3 if "mirror" in shapes else 2,
            "sppi": SPP_GRAD,
            "guiding": "none",
        },
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": T().look_at([0, -3.5, 3], [0, 1.5, 2] if "mirror" in shapes else [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "gaussian"}},
        },
        "floor": {
            "type": "rectangle",
            "to_world": T().scale(3.0),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": FLOOR}},
        },
        "lamp": lamp,
        **shapes,
    }
    return mi.load_dict(scene)


def stages(mi) -> dict[str, tuple]:
    """Return name -> (scene, what is shifted, along which axis) of the cases."""
    T = mi.ScalarTransform4f
    plate = {"type": "rectangle", "to_world": T().translate([0.1, 0.1, 1.0]) @ T().scale(0.4)}
    point = {"type": "point", "position": [0.5, -0.4, 3.0], "intensity": {"type": "rgb", "value": 20.0}}
    panel = {
        "type": "rectangle",
        "to_world": T().translate([0.5, -0.4, 3.0]) @ T().rotate([1, 0, 0], 180) @ T().scale(0.5),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 10.0}},
    }
    mirror = {
        "type": "rectangle",
        "to_world": T().translate([0, 1.5, 1]) @ T().rotate([1, 0, 0], 90) @ T().scale(2.0),
        "bsdf": {"type": "conductor", "material": "none"},
    }
    ball = {"type": "sphere", "center": [0.2, -5.5, 1.6], "radius": 1.5}
    ball |= {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": 3.0}}}
    return {
        "a hard shadow": (stage(mi, point, plate=plate), "plate", (1.0, 0.0, 0.0)),
        "a receiver of a soft shadow": (stage(mi, panel, plate=plate), "floor", (0.0, 0.0, 1.0)),
        "a ball in a mirror": (stage(mi, panel, mirror=mirror, ball=ball), "ball", (1.0, 0.0, 0.0)),
    }


def renderers(threads: int) -> dict[str, tuple[Callable, Callable, dict, dict]]:
    """Return name -> (render, gradient, values, options) of the cases.

    Raises:
        SystemExit: Mitsuba is not installed.
    """
    mi, dr = import_mitsuba(threads)
    mi.set_log_level(mi.LogLevel.Error)  # it finds no silhouettes of hard shadows, and says so at every gradient
    return {name: (*functions(mi, dr, *case), OPTIONS) for name, case in stages(mi).items()}


def functions(mi, dr, scene, moved: str, axis: tuple[float, float, float]) -> tuple[Callable, Callable, dict]:
    """Return (render, gradient, values) of a scene in which a shape is shifted along an axis."""
    params = mi.traverse(scene)
    pose = mi.Transform4f(params[f"{moved}.to_world"])

    def place(values):
        shift, albedo = mi.Float(float(values[SHIFT][0])), mi.Color3f(*map(float, values[ALBEDO]))
        dr.make_opaque(shift, albedo)  # literals are part of kernels, which would be compiled for every value
        return shift, albedo

    def write(shift, albedo):
        params[f"{moved}.to_world"] = mi.Transform4f().translate(shift * mi.Point3f(*axis)) @ pose
        params[ALBEDO] = albedo
        params.update()

    def render(values, seed):
        write(*place(values))
        return np.array(mi.render(scene, spp=SPP, seed=seed % 2**31))

    def gradient(values, adjoint, seed):
        shift, albedo = place(values)
        dr.enable_grad(shift, albedo)
        write(shift, albedo)
        image = mi.render(scene, params, spp=SPP_GRAD, seed=seed % 2**31)
        dr.backward(dr.sum(image * mi.TensorXf(adjoint), axis=None))
        return {SHIFT: np.array(dr.grad(shift)), ALBEDO: np.array(dr.grad(albedo)).reshape(3)}

    return render, gradient, {SHIFT: [0.0], ALBEDO: FLOOR}
