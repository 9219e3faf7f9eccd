"""Images by light tracing: those of the path tracer, a light behind glass in closed form, and what is refused."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import assert_mean, assert_same_mean, blocks

T = psdr.Transform
LIGHT_TRACING = psdr.interior.LightTracing()
#: Batches of a z-test, and the side of its blocks in pixels.
BATCHES, BLOCK = 8, 8


def camera_of(rfilter="gaussian", size=24, **parameters):
    return {
        "type": "perspective",
        "to_world": T.look_at([0.0, -4.0, 1.5], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": rfilter}},
        **({} if parameters.get("type") == "orthographic" else {"fov": 45.0}),
        **parameters,
    }


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def ball(center, **bsdf):
    return {"type": "sphere", "center": center, "radius": 0.4, "bsdf": bsdf}


def room(camera=None, max_depth=5, **objects):
    """A floor, a two-sided wall, a glossy and a diffuse ball, and what is given."""
    wall = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": rgb(0.3, 0.6, 0.7)}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": max_depth},
        "camera": camera or camera_of(),
        "floor": {
            "type": "rectangle",
            "to_world": T.scale(3.0),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)},
        },
        "wall": {
            "type": "rectangle",
            "to_world": T.translate([0.0, 1.5, 1.0]) @ T.rotate([1.0, 0.0, 0.0], 90.0) @ T.scale(2.0),
            "bsdf": wall,
        },
        "glossy": ball([0.3, 0.0, 0.5], type="roughconductor", alpha=0.25),
        "matte": ball([-0.5, 0.0, 0.5], type="diffuse", reflectance=0.7),
        **objects,
    }


def lamp(kind="area"):
    above = T.translate([0.0, 0.0, 2.5]) @ T.rotate([1.0, 0.0, 0.0], 180.0) @ T.scale(0.5)
    return {"type": "rectangle", "to_world": above, "emitter": {"type": kind, "radiance": rgb(8.0, 6.0, 4.0)}}


def aimed(**parameters):
    to_world = T.look_at([-1.0, -2.0, 2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    return {"to_world": to_world, **parameters}


def texels(seed, height, width):
    values = np.random.default_rng(seed).uniform(0.0, 1.0, (height, width, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": values, "raw": True}


SKY = texels(1, 6, 12)["bitmap"] ** 3
WIDE = T.look_at([0.0, -4.0, 1.5], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]) @ T.scale([1.5, 1.5, 1.0])
POINT = {"type": "point", "position": [1.0, -1.0, 2.0], "intensity": rgb(3.0, 2.0, 1.0)}
SPOT = {"type": "spot", **aimed(intensity=rgb(2.0, 4.0, 6.0), cutoff_angle=30.0)}
SUN = {"type": "directional", "direction": [0.3, 0.4, -1.0], "irradiance": 1.5}
ENVIRONMENT = {"type": "constant", "radiance": rgb(0.2, 0.3, 0.5)}
PROJECTOR = {"type": "projector", **aimed(fov=40.0, scale=3.0, irradiance=texels(2, 4, 5))}
GLASS = {"type": "dielectric"}
ROUGH = {"type": "roughdielectric", "alpha": 0.3}
VEIL = {"type": "mask", "opacity": 0.6, "inner": {"type": "twosided", "inner": {"type": "diffuse"}}}
BY_LENS = {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 4.0}
ROOMS = {
    "area": lambda: room(lamp=lamp()),
    "box filter": lambda: room(camera_of("box"), lamp=lamp()),
    "point and spot": lambda: room(camera_of("tent"), point=POINT, spot=SPOT),
    "sun and sky": lambda: room(sun=SUN, sky=ENVIRONMENT),
    "environment map": lambda: room(sky={"type": "envmap", "bitmap": SKY}),
    "projector and directional area": lambda: room(projector=PROJECTOR, lamp=lamp("directionalarea")),
    "glass": lambda: room(max_depth=6, lamp=lamp(), matte=ball([-0.5, -0.3, 0.6], **GLASS)),
    "rough glass and plastic": lambda: room(
        max_depth=6, lamp=lamp(), matte=ball([-0.5, -0.3, 0.6], **ROUGH), glossy=ball([0.3, 0.0, 0.5], type="plastic")
    ),
    "masks and a hidden lamp": lambda: {
        **room(max_depth=6, lamp=lamp(), matte=ball([-0.5, -0.3, 0.6], **VEIL)),
        "integrator": {"type": "path", "max_depth": 6, "hide_emitters": True},
    },
    "thin lens": lambda: room(camera_of(**BY_LENS), lamp=lamp()),
    "orthographic": lambda: room(camera_of(type="orthographic", to_world=WIDE), lamp=lamp()),
}
FAST = {"area"}


def integrators(scene):
    known = {key: scene.description.integrator[key] for key in ("max_depth", "hide_emitters")}
    return psdr.PathIntegrator(**known), psdr.PathIntegrator(**known, interior=LIGHT_TRACING)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n if n in FAST else pytest.param(n, marks=pytest.mark.slow) for n in ROOMS])
def test_the_image_is_that_of_the_path_tracer(name):
    scene = psdr.load_dict(ROOMS[name]())
    found = []
    for integrator in integrators(scene):
        spp = 64 if name in FAST else 256
        images = [psdr.render(scene, integrator=integrator, spp=spp, seed=i).numpy() for i in range(BATCHES)]
        found.append(blocks(np.array(images, np.float64), BLOCK))
    path, light = found
    assert_same_mean(light, path, name)
    # 3 %: the noise of the mean of all pixels, three times that of skies.
    np.testing.assert_allclose(light.mean(), path.mean(), rtol=0.03)


@pytest.mark.slow
def test_a_scene_file_asks_for_it_by_mitsubas_name_and_the_workers_do_not_matter():
    described = {**ROOMS["area"](), "integrator": {"type": "ptracer", "max_depth": 5}}
    scene = psdr.load_dict(described)
    assert "light paths" in str(psdr.plan(scene))
    images = []
    try:
        for workers in (1, 3):
            psdr.set_workers(workers)
            images.append(psdr.render(scene, spp=300, seed=7).numpy())
    finally:
        psdr.set_workers(None)
    np.testing.assert_array_equal(*images)
    named = psdr.render(scene, spp=300, seed=7, integrator=integrators(scene)[1]).numpy()
    np.testing.assert_array_equal(named, images[0])


#: Under water: a point light above an interface, the camera and the floor below it.
HEIGHT_ABOVE, HEIGHT_BELOW, IOR, INTENSITY = 1.0, 2.0, 1.5, 4.0


def under_water(size=8):
    straight_down = T.look_at([0.0, 0.0, 1.5], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "ptracer", "max_depth": 3},
        "camera": {"type": "orthographic", "to_world": straight_down, "film": film},
        "floor": {"type": "rectangle", "to_world": T.scale(2.0), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "surface": {
            "type": "rectangle",
            "to_world": T.translate([0.0, 0.0, HEIGHT_BELOW]) @ T.scale(4.0),
            "bsdf": {"type": "dielectric", "int_ior": IOR, "ext_ior": 1.0},
        },
        "light": {"type": "point", "position": [0.0, 0.0, HEIGHT_BELOW + HEIGHT_ABOVE], "intensity": INTENSITY},
    }


def refracted_radiance(x, y, intensity=INTENSITY, ior=IOR, above=HEIGHT_ABOVE):
    """What the floor sends at (x, y): rings of light between two angles keep their flux."""
    angle = np.linspace(1e-5, 1.2, 40001)
    inner = np.arcsin(np.sin(angle) / ior)
    radius = above * np.tan(angle) + HEIGHT_BELOW * np.tan(inner)
    a, b = np.cos(angle), np.cos(inner)
    reflected = 0.5 * (((a - ior * b) / (a + ior * b)) ** 2 + ((ior * a - b) / (ior * a + b)) ** 2)
    irradiance = intensity * (1.0 - reflected) * np.sin(angle) / (radius * np.gradient(radius, angle))
    return 0.5 / np.pi * np.interp(np.hypot(x, y), radius, irradiance)


def pixel_means(radiance, size=8, fine=16):
    at = (np.arange(size * fine) + 0.5) / (size * fine) * 2.0 - 1.0
    values = radiance(*np.meshgrid(at, at))
    return values.reshape(size, fine, size, fine).mean(axis=(1, 3))


@pytest.mark.slow
def test_a_point_light_behind_glass_is_what_a_quadrature_says():
    """Which no path from the camera finds."""
    scene = psdr.load_dict(under_water())
    found = np.array([psdr.render(scene, spp=4096, seed=i).numpy()[..., 0] for i in range(BATCHES)], np.float64)
    expected = pixel_means(refracted_radiance)
    assert_mean(found, expected, "under water")
    np.testing.assert_allclose(found.mean(axis=0), expected, rtol=0.02)
    path = psdr.PathIntegrator(max_depth=3, caustics=False)
    np.testing.assert_array_equal(psdr.render(scene, integrator=path, spp=16).numpy(), 0.0)


def test_the_plan_says_what_no_path_from_the_camera_finds():
    scene = psdr.load_dict(under_water())
    path = psdr.PathIntegrator(max_depth=3, caustics=False)
    said = [line for line in psdr.plan(scene, integrator=path).lines if "left out" in line]
    assert len(said) == 1 and "interior.LightTracing()" in said[0][2]
    for other, method in ((scene, LIGHT_TRACING), (psdr.load_dict(ROOMS["area"]()), "auto")):
        lines = psdr.plan(other, integrator=psdr.PathIntegrator(interior=method)).lines
        assert not [line for line in lines if "left out" in line]


def test_what_it_does_not_draw_is_refused_by_name():
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    meter = {"type": "radiancemeter", "origin": [0.0, -4.0, 1.5], "direction": [0.0, 1.0, 0.0], "film": film}
    scene = psdr.load_dict({**ROOMS["area"](), "camera": meter})
    with pytest.raises(ValueError, match=r"one ray.*Replay"):
        psdr.render(scene, integrator="ptracer", spp=1)
    scene = psdr.load_dict(ROOMS["box filter"]())
    for block in (0, 65, True):
        with pytest.raises(ValueError, match="expected an integer from 1 to 64"):
            psdr.interior.LightTracing(block=block)


#: A ball of glass between a point light and the floor: its radius and its centre's height, and that of the light.
RADIUS, CENTRE, ABOVE = 0.5, 1.0, 3.0
#: Half of what the film spans: all of it lies in the ball's shadow, and beside the ball as the camera sees it.
HALF_SPAN = 0.2


def under_a_ball(size=8):
    aside = T.look_at([0.0, -2.0, 2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]) @ T.scale(HALF_SPAN)
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    glass = {"type": "dielectric", "int_ior": IOR, "ext_ior": 1.0}
    return {
        "type": "scene",
        "integrator": {"type": "ptracer", "max_depth": 4},
        "camera": {"type": "orthographic", "to_world": aside, "film": film},
        "floor": {"type": "rectangle", "to_world": T.scale(2.0), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "ball": {"type": "sphere", "to_world": T.translate([0.0, 0.0, CENTRE]) @ T.scale(RADIUS), "bsdf": glass},
        "light": {"type": "point", "position": [0.0, 0.0, ABOVE], "intensity": INTENSITY},
    }


def focused_radiance(size=8, rings=4000, around=1440):
    """What the pixels see of the floor: cones of light between two angles keep their flux through the ball."""
    angle = (np.arange(rings) + 0.5) / rings * np.arcsin(RADIUS / (ABOVE - CENTRE))
    # In the plane of the axis: the distance of a ray from the centre turns into the angle at which it meets the ball.
    outer = np.arcsin((ABOVE - CENTRE) * np.sin(angle) / RADIUS)
    inner = np.arcsin(np.sin(outer) / IOR)
    a, b = np.cos(outer), np.cos(inner)
    passed = 1.0 - 0.5 * (((a - IOR * b) / (a + IOR * b)) ** 2 + ((IOR * a - b) / (IOR * a + b)) ** 2)
    # Polar angle of the exit, about the centre and from straight up; both turns are equal.
    polar = outer - angle + np.pi - 2.0 * inner
    slope = np.tan(angle - 2.0 * (outer - inner))
    radius = RADIUS * np.sin(polar) + slope * (CENTRE + RADIUS * np.cos(polar))
    flux = INTENSITY * passed**2 * (np.cos(angle - angle[0]) - np.cos(angle + angle[0])) / around
    phi = 2.0 * np.pi * (np.arange(around) + 0.5) / around
    x, y = radius[:, None] * np.cos(phi), radius[:, None] * np.sin(phi) / np.sqrt(2.0)
    edges = np.linspace(-HALF_SPAN, HALF_SPAN, size + 1)
    weights = np.broadcast_to(flux[:, None] * 2.0 * np.pi, x.shape)
    found = np.histogram2d(y.ravel(), x.ravel(), bins=(edges, edges), weights=weights.ravel())[0]
    return 0.5 / np.pi * found / ((edges[1] - edges[0]) ** 2 * np.sqrt(2.0))


@pytest.mark.slow
def test_a_point_light_behind_a_ball_of_glass_is_what_a_quadrature_says():
    """Its triangles bend the light by a little."""
    found = psdr.render(psdr.load_dict(under_a_ball()), spp=1 << 16).numpy()[..., 0]
    expected = focused_radiance()
    assert expected.max() > 10.0 * np.median(expected)
    np.testing.assert_allclose(found.sum(), expected.sum(), rtol=0.01)
    np.testing.assert_allclose(found, expected, rtol=0.03, atol=0.01 * expected.max())
