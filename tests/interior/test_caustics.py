"""Light paths that join those of the camera: what these do not find, in images and derivatives, and what is refused."""

from functools import partial

import numpy as np
import pytest

import warp_psdr as psdr
from tests.interior.test_light_tracing import MODES, reverse, weights
from tests.path.helpers import assert_mean, assert_same_mean, blocks
from tests.path.test_light_tracing import (
    BATCHES,
    GLASS,
    INTENSITY,
    LIGHT_TRACING,
    POINT,
    SPOT,
    VEIL,
    ball,
    lamp,
    pixel_means,
    refracted_radiance,
    room,
    under_water,
)
from warp_psdr.topology.behind_glass import lights_behind_glass

JOINS = "light tracing joins"


def said_of(scene, **options):
    plan = psdr.plan(scene, integrator=psdr.PathIntegrator(**options))
    return [line[1:] for line in plan.lines if line[0] == "light by mirrors and glass"]


@pytest.fixture(scope="module")
def water():
    """All light of the point light is refracted."""
    return psdr.load_dict({**under_water(), "integrator": {"type": "path", "max_depth": 3}})


def test_by_itself_it_finds_a_light_behind_glass(water):
    """Against a quadrature."""
    scene = water
    assert said_of(scene, max_depth=3) == [(JOINS, "light shines by mirrors and glass alone")]
    expected = pixel_means(refracted_radiance)
    images = [psdr.render(scene, spp=1024, seed=i).numpy()[..., 0] for i in range(BATCHES)]
    assert_mean(np.array(images, np.float64), expected, "image")


@pytest.mark.slow
def test_derivatives_of_a_light_behind_glass(water):
    """Both modes and all numbers of workers against a quadrature."""
    scene, expected = water, pixel_means(refracted_radiance)
    params = psdr.traverse(scene)
    slopes = {"light.intensity.value": expected / INTENSITY, "floor.bsdf.reflectance.value": 2.0 * expected}
    adjoint = weights(8)
    backward = reverse(scene, params, adjoint, list(slopes), spp=512, seed=1)
    try:
        psdr.set_workers(3)
        params.zero_grad()
        for one, other in zip(backward, reverse(scene, params, adjoint, list(slopes), spp=512, seed=1), strict=True):
            np.testing.assert_array_equal(other, one)
    finally:
        psdr.set_workers(None)
    for (name, slope), gradient in zip(slopes.items(), backward, strict=True):
        # Both are tangents, so that one kernel serves them.
        tangents = {other: float(other == name) for other in slopes}
        found = [psdr.render_forward(scene, params, tangents, spp=512, seed=i).numpy() for i in range(BATCHES)]
        assert_mean(np.array(found, np.float64)[..., 0], slope, name)
        forward = psdr.render_forward(scene, params, tangents, spp=512, seed=1).numpy().astype(np.float64)
        assert gradient.sum() == pytest.approx((forward * adjoint).sum(), rel=MODES)


#: Balls of glass and plastic under lights with and without area, and a mask, whose null lobe shadow rays pass.
CAUSTICS = {
    "point": POINT,
    "spot": SPOT,
    "lamp": lamp(),
    "matte": ball([-0.5, -0.3, 0.6], **GLASS),
    "glossy": ball([0.3, 0.0, 0.5], type="plastic"),
    "veil": {
        "type": "rectangle",
        "to_world": psdr.Transform.translate([0.6, -0.6, 1.3]) @ psdr.Transform.scale(0.5),
        "bsdf": VEIL,
    },
}


@pytest.mark.slow
def test_image_and_derivatives_are_those_of_light_tracing():
    """Which draws what the camera's first surface scatters smoothly by light paths, caustics included."""
    scene = psdr.load_dict(room(max_depth=6, **CAUSTICS))
    params = psdr.traverse(scene)
    ways = {
        "joined": psdr.PathIntegrator(max_depth=6, caustics=True),
        "light paths": psdr.PathIntegrator(max_depth=6, interior=LIGHT_TRACING),
        "left out": psdr.PathIntegrator(max_depth=6),
    }

    def batches_of(draw, **options):
        images = [draw(seed=i, **options).numpy() for i in range(BATCHES)]
        return blocks(np.array(images, np.float64), 8)

    images = {way: batches_of(partial(psdr.render, scene), integrator=it, spp=256) for way, it in ways.items()}
    assert_same_mean(images["joined"], images["light paths"], "image")
    assert images["joined"].mean() > 1.01 * images["left out"].mean()
    names = ("point.intensity.value", "matte.bsdf.specular_transmittance.value", "floor.bsdf.reflectance.value")
    for name in names:
        tangents = {other: float(other == name) for other in names}
        draw = partial(psdr.render_forward, scene, params, tangents)
        found = [batches_of(draw, integrator=ways[way], spp=128) for way in ("joined", "light paths")]
        assert_same_mean(*found, name)


@pytest.mark.parametrize("interior", [psdr.interior.Resampled(), psdr.interior.Textbook()], ids=["branches", "divided"])
def test_it_joins_any_method_of_the_camera(interior):
    described = room(max_depth=6, **{**CAUSTICS, "glossy": ball([0.3, 0.0, 0.5], type="roughconductor")})
    del described["veil"]
    scene = psdr.load_dict(described)
    options = {"max_depth": 6, "interior": interior}
    assert said_of(scene, caustics=True, **options) == [(JOINS, "caustics=True")]
    integrator = psdr.PathIntegrator(caustics=True, **options)
    plan = psdr.plan(scene, names=["glossy.bsdf.alpha.value"], integrator=integrator)
    assert plan.seen.caustics is False and plan.light.paths.caustics is True and plan.seen_wanted is plan.wanted


def test_which_scenes_it_joins_by_itself():
    water = under_water()
    cone = {"to_world": psdr.Transform.look_at([0.0, 0.0, 3.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])}
    lights = {
        "point": water["light"],
        "spot": {"type": "spot", **cone},
        "projector": {"type": "projector", "irradiance": 1.0, "fov": 40.0, **cone},
        "directional": {"type": "directional", "direction": [0.0, 0.0, -1.0]},
    }
    for kind, light in lights.items():
        assert lights_behind_glass(psdr.load_dict({**water, "light": light})) == ("light",), kind
    beside = {**water["light"], "position": [0.0, 0.0, 1.0]}
    sheet = {**water, "surface": {**water["surface"], "bsdf": {"type": "thindielectric"}}}
    for scene in (room(max_depth=6, **CAUSTICS), {**water, "light": beside}, sheet):
        scene = psdr.load_dict(scene)
        assert lights_behind_glass(scene) == ()
        assert [decision for decision, _why in said_of(scene)] == ["left out"]
    # Methods that are named are those of Mitsuba's path tracer, and paths of two vertices meet no glass.
    scene = psdr.load_dict(water)
    assert said_of(scene, interior=psdr.interior.Replay())[0][0] == "left out"
    assert said_of(scene, max_depth=2)[0][0] == "left out"
    assert said_of(scene, caustics=False)[0][0] == "left out"


def test_what_it_does_not_differentiate_is_refused_by_name():
    scene = psdr.load_dict(under_water())
    integrator = psdr.PathIntegrator(max_depth=3)
    for name in ("floor.vertex_positions", "camera.to_world", "surface.bsdf.eta", "light.position"):
        with pytest.raises(ValueError, match=r"light shines by mirrors.*light tracing .*caustics=False\) leaves"):
            psdr.plan(scene, names=[name], integrator=integrator)
        psdr.plan(scene, names=[name], integrator=psdr.PathIntegrator(max_depth=3, caustics=False))
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    meter = {"type": "radiancemeter", "origin": [0.0, 0.0, 1.5], "direction": [0.0, 0.1, -1.0], "film": film}
    scene = psdr.load_dict({**under_water(), "camera": meter})
    with pytest.raises(ValueError, match=r"caustics=True: light tracing does not know the one ray.*caustics=False"):
        psdr.plan(scene, integrator=psdr.PathIntegrator(caustics=True))
    assert said_of(scene)[0][0] == "left out"
    with pytest.raises(ValueError, match="caustics: got 1, expected True, False or 'auto'"):
        psdr.PathIntegrator(caustics=1)
