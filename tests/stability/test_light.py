"""Light: sources of all sizes and brightnesses against closed forms, and the scaling that light obeys exactly.

A light joins the sweep over brightness by a row of ``LIGHTS``.
"""

import functools
import math

import numpy as np
import pytest

import warp_psdr as psdr

from .record import Case, parameters

#: Scenes that are noted to be at the edge of what floats hold are what is tested.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")

SIZE = 4  # pixels
ALBEDO = 0.6
DOWN = psdr.Transform.rotate([1, 0, 0], 180)


def rgb(value: float) -> dict:
    return {"type": "rgb", "value": [value] * 3}


def scene_dict(lights: dict, *, bsdf=None, fov: float = 1e-3, origin=(0.0, 0.1, 0.4), **more) -> dict:
    """A floor at z = 0, seen at the origin, under lights."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look = psdr.Transform.look_at(list(origin), [0.0, 0.0, 0.0], [0, 1, 0])
    floor = psdr.Transform.scale(10.0)
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": fov, "near_clip": 1e-3, "to_world": look, "film": film},
        "floor": {
            "type": "rectangle",
            "to_world": floor,
            "bsdf": bsdf or {"type": "diffuse", "reflectance": rgb(ALBEDO)},
        },
        **lights,
        **more,
    }


def integrator(depth: int = 2, **options) -> psdr.PathIntegrator:
    return psdr.PathIntegrator(**{"max_depth": depth, "boundary": None, **options})


def invalid(scene) -> bool:
    return any(psdr.invalid_samples(scene).values())


# --- brightness ---

#: name, (brightness) -> the light, name of the brightness.
LIGHTS = [
    (
        "area",
        lambda s: {
            "type": "rectangle",
            "to_world": psdr.Transform.translate([0.5, 0.0, 1.0]) @ DOWN @ psdr.Transform.scale(0.2),
            "emitter": {"type": "area", "radiance": rgb(5.0 * s)},
        },
        "area.emitter.radiance.value",
    ),
    ("sky", lambda s: {"type": "envmap", "bitmap": brightness_map(s)}, "sky.data"),
    ("point", lambda s: {"type": "point", "position": [0.3, 0.4, 1.1], "intensity": rgb(s)}, "point.intensity.value"),
    (
        "spot",
        lambda s: {
            "type": "spot",
            "to_world": psdr.Transform.look_at([-0.8, 0.3, 1.8], [0.1, 0.1, 0.0], [0, 1, 0]),
            "intensity": rgb(4.0 * s),
            "cutoff_angle": 25.0,
            "beam_width": 10.0,
        },
        "spot.intensity.value",
    ),
    (
        "sun",
        lambda s: {"type": "directional", "direction": [0.3, 0.4, -1.0], "irradiance": rgb(s)},
        "sun.irradiance.value",
    ),
]
BLOCKER = "blocker.to_world"
DECADES = (1e-8, 1e-4, 1.0, 1e4, 1e8)


def brightness_map(s: float) -> np.ndarray:
    return (s * np.random.default_rng(5).uniform(0.2, 1.0, (6, 12, 3))).astype(np.float32)


@functools.cache
def lit(s: float) -> dict[str, np.ndarray]:
    """Return image and gradients, boundary term included, under all lights of brightness s."""
    lights = {name: light(s) for name, light, _parameter in LIGHTS}
    raised = psdr.Transform.translate([0.15, 0.0, 0.15]) @ psdr.Transform.scale(0.1)
    blocker = {"type": "rectangle", "to_world": raised, "bsdf": {"type": "twosided", "a": {"type": "diffuse"}}}
    scene = psdr.load_dict(scene_dict(lights, fov=50.0, blocker=blocker))
    params = psdr.traverse(scene)
    reflectance = "floor.bsdf.reflectance.value"
    names = [reflectance, BLOCKER, *(parameter for _name, _light, parameter in LIGHTS)]
    method = psdr.PathIntegrator(max_depth=3, boundary=psdr.boundary.PathSpace())
    params.requires_grad(*names)
    adjoint = np.linspace(0.5, 1.5, 3 * SIZE**2).reshape(SIZE, SIZE, 3)
    found = {"image": psdr.render(scene, integrator=method, spp=8).numpy()}
    psdr.render_backward(scene, params, adjoint, integrator=method, spp=8)
    assert not invalid(scene)
    # All of these are linear in s but the derivatives by the brightness, which do not depend on it.
    order = {name: 1.0 if name in (reflectance, BLOCKER) else 0.0 for name in names}
    found |= {name: params[name].grad.numpy() for name in names}
    order["image"] = 1.0
    return {name: value.astype(np.float64) / s ** order[name] for name, value in found.items()}


def scaling(interior: bool) -> float:
    """Worst difference from brightness 1, relative to the largest number of the image or of the gradient."""
    worst, one = 0.0, lit(1.0)
    for s in DECADES:
        for name, value in lit(s).items():
            if (name == BLOCKER) != interior:
                if not np.isfinite(value).all() or not one[name].any():
                    return math.inf
                worst = max(worst, float(np.abs(value - one[name]).max() / np.abs(one[name]).max()))
    return worst


# --- size ---


def disk(radius: float) -> dict:
    """A disk that brings the irradiance 1 when seen from a unit below: radiance (1 + r^2) / (pi r^2)."""
    radiance = (1.0 + radius**2) / (math.pi * radius**2)
    to_world = psdr.Transform.translate([0.0, 0.0, 1.0]) @ DOWN @ psdr.Transform.scale(radius)
    return {"light": {"type": "disk", "to_world": to_world, "emitter": {"type": "area", "radiance": rgb(radiance)}}}


def polygon_share(vertices: np.ndarray) -> float:
    """Irradiance, over pi, of a polygon of radiance 1 above a horizontal point at the origin [Lambert 1760]."""
    unit = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    after = np.roll(unit, -1, axis=0)
    across = np.cross(unit, after)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, (unit * after).sum(axis=1))
    return abs(float((angle * across[:, 2] / sine).sum())) / (2.0 * math.pi)


def rim(vertices: np.ndarray) -> np.ndarray:
    """Return the outer vertices of a tessellated disk, in order."""
    radius = np.linalg.norm(vertices[:, :2], axis=1)
    outer = vertices[radius > 0.999 * radius.max()]
    unique = np.unique(np.round(outer / radius.max(), 6), axis=0, return_index=True)[1]
    outer = outer[unique]
    return outer[np.argsort(np.arctan2(outer[:, 1], outer[:, 0]))]


def sizes(radii: tuple[float, ...], spp: int) -> float:
    """Worst relative error of radiance, and of its derivatives by brightness and by the light's scale."""
    worst = 0.0
    for radius in radii:
        scene = psdr.load_dict(scene_dict(disk(radius)))
        params = psdr.traverse(scene)
        light = next(s for s in scene.description.shapes if s.path == "light")
        outer = rim(np.asarray(light.vertices, np.float64))
        radiance = float(params["light.emitter.radiance.value"].numpy().flat[0])

        def seen(scale: float, outer=outer, radiance=radiance) -> float:
            return ALBEDO * radiance * polygon_share(outer * [scale, scale, 1.0])

        h = 1e-3
        by_scale = (seen(1.0 + h) - seen(1.0 - h)) / (2.0 * h)
        image = psdr.render(scene, integrator=integrator(), spp=spp).numpy()
        tangent = np.zeros((4, 4), np.float32)
        tangent[:3, :2] = params["light.to_world"].numpy()[:3, :2]
        tangents = {"light.to_world": tangent}
        moved = psdr.render_forward(scene, params, tangents, integrator=integrator(), spp=spp).numpy()
        params.requires_grad("light.emitter.radiance.value")
        psdr.render_backward(scene, params, np.full(image.shape, 1.0 / image.size), integrator=integrator(), spp=spp)
        brighter = float(params["light.emitter.radiance.value"].grad.numpy().sum())
        if invalid(scene):
            return math.inf
        errors = [image.mean(dtype=np.float64) / seen(1.0) - 1.0, brighter * radiance / seen(1.0) - 1.0]
        # Relative to the larger of value and derivative: that of half a space is 0.
        errors.append((moved.mean(dtype=np.float64) - by_scale) / max(abs(by_scale), seen(1.0)))
        worst = max(worst, *(abs(float(e)) for e in errors))
    return worst


# --- extremes ---


def sun_pixel() -> float:
    """Irradiance under a sky of 0.3 with one texel of 4e4, against a quadrature of the interpolated map."""
    sky = np.full((16, 32, 3), 0.3, np.float32)
    sky[4, 8] = 4e4
    up = psdr.Transform.rotate([1, 0, 0], 90)  # the map's +y becomes +z
    scene = psdr.load_dict(scene_dict({"sky": {"type": "envmap", "bitmap": sky, "to_world": up}}))
    found = psdr.render(scene, integrator=integrator(), spp=4096).numpy().mean(dtype=np.float64)
    n = 2048
    y = (np.arange(n) + 0.5) / n * 15.0
    x = (np.arange(2 * n) + 0.5) / (2 * n) * 32.0
    hat_y = np.maximum(1.0 - np.abs(y - 4.0), 0.0)
    hat_x = np.maximum(1.0 - np.abs(x - 8.0), 0.0)
    theta = math.pi * y / 15.0
    inside = theta < 0.5 * math.pi
    d_theta, d_phi = math.pi / n, 2.0 * math.pi / (2 * n)
    extra = (hat_y * np.cos(theta) * np.sin(theta))[inside].sum() * d_theta * hat_x.sum() * d_phi
    irradiance = 0.3 * math.pi + (4e4 - np.float32(0.3)) * extra
    return math.inf if invalid(scene) else abs(found / (ALBEDO / math.pi * irradiance) - 1.0)


def inside_glass() -> float:
    """A small shining ball inside one of glass, seen along a diameter: L (1 - F) / n^2 of the straight path."""
    n = 1.5
    glass = {"type": "sphere", "bsdf": {"type": "dielectric", "int_ior": n, "ext_ior": 1.0}}
    black = {"type": "diffuse", "reflectance": rgb(0.0)}
    light = {"type": "sphere", "radius": 0.05, "bsdf": black, "emitter": {"type": "area", "radiance": rgb(2.0)}}
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look = psdr.Transform.look_at([1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 1e-2, "to_world": look, "film": film}
    scene = psdr.load_dict({"type": "scene", "sensor": sensor, "glass": glass, "light": light})
    params = psdr.traverse(scene)
    params.requires_grad("*")
    options = {"integrator": integrator(6), "spp": 4096}
    image = psdr.render(scene, **options).numpy()
    psdr.render_backward(scene, params, np.ones(image.shape), **(options | {"spp": 16}))
    if invalid(scene) or not all(np.isfinite(params[name].grad.numpy()).all() for name in params):
        return math.inf
    fresnel = ((n - 1.0) / (n + 1.0)) ** 2
    return abs(float(image.mean(dtype=np.float64)) / (2.0 * (1.0 - fresnel) / n**2) - 1.0)


def black() -> float:
    """All lights off: image 0, and derivatives that are finite, 0 by the surface and not by the light."""
    lights = {name: light(0.0) for name, light, _parameter in LIGHTS}
    scene = psdr.load_dict(scene_dict(lights, fov=50.0))
    params = psdr.traverse(scene)
    params.requires_grad("*")
    image = psdr.render(scene, integrator=integrator(3), spp=8).numpy()
    psdr.render_backward(scene, params, np.ones(image.shape), integrator=integrator(3), spp=8)
    gradients = {name: params[name].grad.numpy() for name in params}
    if invalid(scene) or not all(np.isfinite(g).all() for g in gradients.values()):
        return math.inf
    if not all(gradients[parameter].any() for _name, _light, parameter in LIGHTS):
        return math.inf
    return float(max(np.abs(image).max(), np.abs(gradients["floor.bsdf.reflectance.value"]).max()))


def many_lights() -> float:
    """1,000 equal point lights on a ring above the point that is seen: every sample brings the same."""
    count, height, radius = 1000, 1.5, 0.7
    angles = 2.0 * math.pi * np.arange(count) / count
    places = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, height)], axis=1)
    lights = {f"p{i}": {"type": "point", "position": p.tolist(), "intensity": rgb(0.01)} for i, p in enumerate(places)}
    scene = psdr.load_dict(scene_dict(lights))
    image = psdr.render(scene, integrator=integrator(), spp=16).numpy()
    params = psdr.traverse(scene)
    params.requires_grad("p7.intensity.value")
    psdr.render_backward(scene, params, np.ones(image.shape), integrator=integrator(), spp=16)
    if invalid(scene) or not np.isfinite(params["p7.intensity.value"].grad.numpy()).all():
        return math.inf
    squared = height**2 + radius**2
    expected = count * 0.01 * ALBEDO / math.pi * height / squared**1.5
    return float(np.abs(image.astype(np.float64) / expected - 1.0).max())


CASES = [
    Case(
        family="light",
        name="brightness 1e-8 to 1e8, image and interior gradients",
        hard="light is linear: nothing may be compared with a constant",
        naive="`radiance > 1e-6` and `max(pdf, 1e-6)` cut dim scenes off",
        bound=8e-7,
        measure=lambda: scaling(True),
        slow=True,
    ),
    Case(
        family="light",
        name="brightness 1e-8 to 1e8, boundary gradient",
        hard="as above, for jumps of radiance",
        naive="a tolerance of the jump drops the shadows of dim lights",
        bound=2.5e-7,
        measure=lambda: scaling(False),
        slow=True,
    ),
    Case(
        family="light",
        name="disks of radius 1e-5 to 1",
        slow=True,
        hard="densities of 1e10 per area; 1 / r^2 of a light that is nearly a point",
        naive="areas below an epsilon are skipped; a light's own surface hides it",
        bound=5e-4,
        measure=lambda: sizes((1e-5, 1e-4, 1e-2, 1.0), 256),
    ),
    Case(
        family="light",
        name="disks of radius 10 to 1e3: half a space",
        hard="a light 1e3 times larger than its distance, seen at grazing angles",
        naive="points drawn by area are all far away: no sample in 1e5 counts",
        bound=2e-2,
        measure=lambda: sizes((10.0, 100.0, 1000.0), 4096),
        slow=True,
    ),
    Case(
        family="light",
        name="a sun pixel of 4e4 in a sky of 0.3",
        hard="nearly all of the light in one of 512 texels",
        naive="uniform directions: a firefly a pixel",
        bound=3e-5,
        measure=sun_pixel,
    ),
    Case(
        family="light",
        name="a light inside glass",
        hard="next-event estimation cannot see it; radiance scales with the squared index",
        naive="black, or too bright by n^2",
        bound=5.5e-5,
        measure=inside_glass,
        slow=True,
    ),
    Case(
        family="light",
        name="all lights off",
        hard="selection by power without any power; MIS weights of nothing",
        naive="0 / 0",
        bound=0.0,
        measure=black,
        slow=True,
    ),
    Case(
        family="light",
        name="1,000 lights",
        hard="probabilities of 1e-3 that must add up to 1",
        naive="a float32 cumulative sum drifts by 1e-5",
        bound=2e-5,
        measure=many_lights,
        slow=True,
    ),
]


@pytest.mark.parametrize("case", parameters(CASES))
def test_light(case, check) -> None:
    check(case)
