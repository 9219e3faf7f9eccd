"""Factors that are exactly zero keep their derivative; the textbook's division loses it, which is shown, not hidden."""

import numpy as np
import pytest

import warp_psdr as psdr

from . import measure, scenes

#: One-sided differences of second order, since roulette-free primal paths still end where all is black: the images
#: are polynomials of low degree in these parameters, so this only absorbs rounding and the cubic part.
ONE_SIDED = 2e-2
STEP = 1e-2
DEPTH, SPP = 4, 64


def black_wall():
    scene = scenes.gap_scene()
    scene["floor"]["vertex_color"] = scene["floor"]["vertex_color"] * np.array([0.0, 1.0, 0.0], np.float32)
    return scene, "floor.vertex_color", {}


def black_ceiling():
    # Its derivative exists from depth 4 on: floor, ceiling, floor, light.
    scene = scenes.gap_scene()
    scene["ceiling"]["bsdf"]["reflectance"] = scenes.rgb(0.0, 0.0, 0.0)
    return scene, "ceiling.bsdf.reflectance.value", {}


def dark_light():
    scene = scenes.gap_scene()
    scene["point"] = {"type": "point", "position": [0.3, 0.2, 1.0], "intensity": scenes.rgb(0.0, 0.0, 0.0)}
    return scene, "point.intensity.value", {}


def dark_panel():
    scene = scenes.gap_scene()
    scene["ceiling"]["emitter"]["radiance"]["bitmap"][1:3, 1:3] = 0.0
    return scene, "ceiling.emitter.radiance.data", {}


def black_texels():
    scene = scenes.dome_scene()
    scene["sky"] = scenes.environment()
    scene["sky"]["bitmap"][2:4, 3:7] = 0.0
    return scene, "sky.data", {}


def black_sky():
    scene = scenes.dome_scene()
    scene["sky"]["radiance"] = scenes.rgb(0.0, 0.0, 0.0)
    return scene, "sky.radiance.value", {}


def dull_metal():
    scene = scenes.rough_scene()
    scene["floor"]["bsdf"]["specular_reflectance"] = scenes.rgb(0.0, 0.5, 0.0)
    return scene, "floor.bsdf.specular_reflectance.value", {}


def dull_mirror():
    scene = scenes.mirror_scene()
    scene["room"]["bsdf"]["specular_reflectance"] = scenes.rgb(0.0, 0.5, 0.0)
    return scene, "room.bsdf.specular_reflectance.value", {}


def unseen_metal():
    """A blend of weight 0: the metal has no part in the image."""
    return scenes.blend_scene(0.0), "floor.bsdf.weight.value", {}


def unseen_paint():
    """A blend of weight 1: the paint has no part in the image."""
    return scenes.blend_scene(1.0), "floor.bsdf.weight.value", {}


def dark_glass():
    scene = scenes.glass_scene()
    scene["ball"]["bsdf"]["specular_transmittance"] = scenes.rgb(0.0, 0.5, 0.0)
    return scene, "ball.bsdf.specular_transmittance.value", {}


def dark_plate():
    """Light shines through it by shadow rays and by paths."""
    scene = scenes.gap_scene()
    sheet = {"type": "thindielectric", "int_ior": 1.3, "specular_transmittance": scenes.rgb(0.0, 0.5, 0.0)}
    to_world = psdr.Transform.translate([0.3, 0.0, 0.7]) @ psdr.Transform.scale(0.7)
    scene["plate"] = {"type": "rectangle", "to_world": to_world, "bsdf": sheet}
    scene["point"] = {"type": "point", "position": [0.3, 0.2, 1.0], "intensity": scenes.rgb(0.5, 0.5, 0.5)}
    return scene, "plate.bsdf.specular_transmittance.value", {}


CASES = [
    black_wall,
    black_ceiling,
    dark_light,
    dark_panel,
    black_texels,
    black_sky,
    dull_metal,
    dull_mirror,
    dark_glass,
    dark_plate,
    unseen_metal,
    unseen_paint,
]
#: Where textbook replay divides by the zero, with all light beyond the factor lost.
TEXTBOOK_LOSES = {black_wall, black_ceiling, dull_metal, dull_mirror, dark_glass, dark_plate}


#: What is requested beside it, so that kernels are those of ``test_table.py``.
TOGETHER = {black_wall: "*"}

#: Every case compiles kernels of its own, so the fast subset has most of them in one mode.
FAST_FORWARD, FAST_REVERSE = (
    {black_wall, dull_mirror, black_texels},
    {black_wall, dark_light, dull_metal, dark_glass, dark_plate},
)


def rows():
    for make in CASES:
        for mode, fast in (("forward", FAST_FORWARD), ("reverse", FAST_REVERSE)):
            marks = () if make in fast else pytest.mark.slow
            yield pytest.param(make, mode, marks=marks, id=f"{make.__name__}-{mode}")


@pytest.fixture(scope="module")
def black(request):
    """(make, scene, parameters, name, tangent, one-sided difference); the tangent is that of values that are zero."""
    node, name, _ = request.param()
    scene = psdr.load_dict({"type": "scene", **node})
    params = psdr.traverse(scene)
    base = params[name].numpy()
    # A weight of 1, the other end of its range, goes down.
    tangent = -np.ones(base.shape) if request.param is unseen_paint else np.where(base == 0.0, 1.0, 0.0)
    assert tangent.any()
    with measure.shared_random_numbers():
        zero, one, two = (
            measure.image_at(scene, params, name, (base + k * STEP * tangent).astype(np.float32), DEPTH, SPP, 3)
            for k in range(3)
        )
    difference = (4.0 * one - two - 3.0 * zero) / (2.0 * STEP)
    assert np.abs(difference).max() > 1e-3
    return request.param, scene, params, name, tangent, difference


def slope(black, block, mode):
    """Regression of the derivative on the difference; same random numbers, so that noise cancels."""
    make, scene, params, name, tangent, difference = black
    options = {"integrator": measure.integrator(DEPTH, block), "spp": SPP, "seed": 3}
    if mode == "forward":
        image = psdr.render_forward(scene, params, {name: tangent}, **options).numpy().astype(np.float64)
        got = (image * difference).sum()
    else:
        params.requires_grad_only(TOGETHER.get(make, name))
        params.zero_grad()
        psdr.render_backward(scene, params, difference, **options)
        got = (params[name].grad.numpy().astype(np.float64) * tangent).sum()
    return got / (difference**2).sum()


@pytest.mark.slow_rows(
    "black_wall-forward",
    "dark_light-reverse",
    "black_texels-forward",
    "dull_metal-reverse",
    "dull_mirror-forward",
    "dark_glass-reverse",
    "dark_plate-reverse",
)
@pytest.mark.parametrize(("black", "mode"), list(rows()), indirect=["black"])
def test_derivative_at_zero(black, mode):
    assert slope(black, 8, mode) == pytest.approx(1.0, abs=ONE_SIDED)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("black", CASES, indirect=True, ids=lambda f: f.__name__)
def test_textbook_replay_loses_what_it_divides_by(black, mode):
    expected = slope(black, 0, mode)
    if black[0] in TEXTBOOK_LOSES:
        assert expected < 0.9
    else:
        assert expected == pytest.approx(1.0, abs=ONE_SIDED)
