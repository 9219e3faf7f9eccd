"""Mitsuba's gradients under ``certify_function``: an albedo's are right, those of a hard shadow are found wrong."""

import numpy as np
import pytest

import warp_psdr as psdr

pytestmark = pytest.mark.slow

SIZE, ALBEDO, SHIFT = 24, "floor.bsdf.reflectance.value", "shift"
BUDGET = 60.0
#: Samples a pixel of images, and of gradients.
SPP, SPP_GRAD = 256, 64


def functions(mi, dr):
    """Return (render, gradient, values) of a plate that moves between a point light and a floor."""
    T = mi.ScalarTransform4f
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb_projective", "max_depth": 2, "sppi": SPP_GRAD},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": T().look_at([0, -3.5, 3], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "gaussian"}},
            },
            "floor": {
                "type": "rectangle",
                "to_world": T().scale(3.0),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.4, 0.6]}},
            },
            "plate": {"type": "rectangle", "to_world": T().translate([0.1, 0.1, 1.0]) @ T().scale(0.4)},
            "light": {"type": "point", "position": [0.5, -0.4, 3.0], "intensity": {"type": "rgb", "value": 20.0}},
        }
    )
    params = mi.traverse(scene)
    pose = mi.Transform4f(params["plate.to_world"])

    def place(values):
        shift, albedo = mi.Float(float(values[SHIFT][0])), mi.Color3f(*map(float, values[ALBEDO]))
        return shift, albedo

    def write(shift, albedo):
        params["plate.to_world"] = mi.Transform4f().translate(mi.Point3f(shift, 0.0, 0.0)) @ pose
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

    return render, gradient, {SHIFT: [0.0], ALBEDO: [0.5, 0.4, 0.6]}


def test_a_right_and_a_wrong_gradient_of_mitsuba() -> None:
    mi = pytest.importorskip("mitsuba")
    if "llvm_ad_rgb" not in mi.variants():
        pytest.skip("Mitsuba has no LLVM variant here")
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)  # it finds no silhouettes of the shadow, and says so at every gradient
    dr = pytest.importorskip("drjit")
    units = {SHIFT: 0.2}
    certificate = psdr.certify_function(*functions(mi, dr), units=units, bounds={ALBEDO: (0.0, 1.0)}, budget=BUDGET)
    assert certificate[ALBEDO].verdict == "within"
    assert certificate[SHIFT].verdict == "biased" and certificate[SHIFT].slope.value < 0.9
