"""Derivatives of exact spheres and ellipsoids, all terms together, and of what moves around them."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, camera, diffuse, floor, load, panel, register, sky
from .scenes import ball as coarse

VIEW = camera((0.3, -3.0, 2.0), (0.0, 0.0, 0.4), fov=45.0)
POSE = T.translate([0.1, 0.0, 0.75]).rotate([0, 1, 1], 35.0).scale([0.5, 0.35, 0.45])
BALL, FLOOR, LAMP = "ball.to_world", "floor.to_world", "light.vertex_positions"
LIGHTS = {
    "sky": lambda: {"sky": sky()},
    "lamp": lambda: {"light": panel((0.8, -0.8, 2.5), 0.4)},
    "point": lambda: {"light": {"type": "point", "position": [0.8, -0.8, 2.5], "intensity": 5.0}},
    "sun": lambda: {"light": {"type": "directional", "direction": [-0.4, 0.4, -1.0], "irradiance": 2.0}},
    "spot": lambda: {
        "light": {
            "type": "spot",
            "to_world": T.look_at([0.8, -0.8, 2.5], [0, 0, 0], [0, 1, 0]),
            "intensity": 8.0,
            "cutoff_angle": 40.0,
            "beam_width": 10.0,
        }
    },
}
TILES = np.random.default_rng(0).random((6, 6, 3)).astype(np.float32)


def ellipsoid(**more) -> dict:
    return {"type": "sphere", "to_world": POSE, "bsdf": diffuse(0.7, 0.5, 0.3), **more}


def room(light: str, **ball):
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "ball": ellipsoid(**ball), **LIGHTS[light]()}


def walled():
    """A wall beside a textured ellipsoid: light between the two, and the wall's edges as the ellipsoid sees them."""
    texture = {"type": "bitmap", "bitmap": TILES, "raw": True}
    wall = T.translate([-0.75, 0.1, 0.8]).rotate([0, 1, 0], 80.0).scale(0.6)
    return {
        **room("lamp", exact=True, bsdf={"type": "diffuse", "reflectance": texture})(),
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": {"type": "twosided", "bsdf": diffuse(0.3, 0.6, 0.8)}},
    }


def beside_bent():
    """A coarse ball with interpolated normals beside an ellipsoid."""
    other = coarse((-0.75, 0.1, 0.5), 0.4, diffuse(0.3, 0.6, 0.8), smooth=True)
    return {**room("lamp", exact=True)(), "other": other}


register(
    {
        "exact, bent": beside_bent,
        **{f"exact, {light}": room(light, exact=True) for light in LIGHTS},
        "fine, lamp": room("lamp", resolution=320),
        "exact, wall": walled,
    }
)


def entry(*place):
    def tangent(pose):
        r = 0.0 * pose
        r[place] = 1.0
        return r

    return tangent


def radius(pose):
    r = pose.copy()
    r[:, 3] = 0.0
    return r


def turned(generator):
    """Motion of A by a generator: of rotations if it is skew, else of shears."""

    def tangent(pose):
        r = 0.0 * pose
        r[:3, :3] = np.array(generator, np.float64) @ pose[:3, :3]
        return r

    return tangent


ROTATION = turned([[0, -1, 0.5], [1, 0, 0], [-0.5, 0, 0]])
SHEAR = turned([[0, 0, 1], [0, 0, 0], [0, 0, 0]])


def moved_light(values):
    return 0.0 * values + [1.0, 0.0, 0.0]


CASES = [
    *(
        Case(f"exact, {light}", BALL, tangent, 0.01, what, 2, 512, 4096)
        for light in ("sky", "lamp")
        for what, tangent in (("radius", radius), ("x", entry(0, 3)), ("z", entry(2, 3)))
    ),
    *(
        Case(f"exact, {light}", BALL, tangent, 0.01, what, 2, spp, 4 * spp)
        for light, spp in (("sky", 4096), ("lamp", 8192))
        for what, tangent in (("rotation", ROTATION), ("shear", SHEAR))
    ),
    *(
        Case(f"exact, {light}", BALL, tangent, 0.01, what, 2, 512, 4096)
        for light in ("point", "sun", "spot")
        for what, tangent in (("radius", radius), ("x", entry(0, 3)))
    ),
    Case("exact, lamp", FLOOR, entry(2, 3), 0.01, "the floor moves", 2, 512, 4096),
    Case("exact, lamp", LAMP, moved_light, 0.01, "the lamp moves", 2, 512, 4096),
    Case("exact, point", "light.position", moved_light, 0.01, "the lamp moves", 2, 512, 4096),
    Case("exact, lamp", "sensor.to_world", entry(0, 3), 0.01, "the camera moves", 2, 512, 4096),
    *(
        Case("exact, bent", name, tangent, 0.01, what, depth, 1024, 4096)
        for what, name, tangent, depth in (
            ("radius", BALL, radius, 3),
            ("the mesh moves", "other.vertex_positions", moved_light, 2),
            ("the mesh moves", "other.vertex_positions", moved_light, 3),
        )
    ),
    Case("exact, wall", BALL, radius, 0.01, "radius", 4, 1024, 4096),
    Case("exact, wall", "wall.to_world", entry(0, 3), 0.01, "the wall moves", 4, 1024, 4096),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


def pinhole(center) -> psdr.Scene:
    """A black sphere of radius 1/2 before a sky of radiance 1, and a pinhole in the origin."""
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    view = T.look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])
    ball = {"type": "sphere", "exact": True, "center": center, "radius": 0.5, "bsdf": diffuse(0.0, 0.0, 0.0)}
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 60.0, "to_world": view, "film": film},
            "sky": {"type": "constant", "radiance": 1.0},
            "ball": ball,
        }
    )


@pytest.mark.parametrize(
    ("center", "expected"),
    [((0.0, 0.0, 2.0), (0.893609, 0.0, 0.0, -0.223402)), ((0.4, 0.0, 2.0), (0.913640, 0.021878, 0.0, -0.232786))],
)
def test_area_on_the_film(center, expected) -> None:
    """Derivatives of the area of the ellipse on the film at distance 1, by radius and centre."""
    scene = pinhole(list(center))
    params = psdr.traverse(scene)
    params.requires_grad("ball.to_world")
    psdr.render_backward(
        scene, params, np.ones((32, 32, 3)) / 3.0, spp=256, integrator=psdr.PathIntegrator(max_depth=1)
    )
    pixel = (2.0 * np.tan(np.radians(30.0)) / 32.0) ** 2
    g = -pixel * params["ball.to_world"].grad.numpy().reshape(4, 4)
    # Absorbs the distance at which rays pass the silhouette, and float32.
    np.testing.assert_allclose([np.trace(g[:3, :3]), *g[:3, 3]], expected, atol=2e-4)


def light_below(radius: float, height: float, level: float) -> float:
    """Mean radiance of the white floor at z = ``level`` that a camera at .3 sees in the square [-1, 1]^2 (.3 - z).

    A black sphere hides (R / d)^2 cos(theta) of the uniform sky from a floor that it is wholly above.
    """
    t, w = np.polynomial.legendre.leggauss(24)
    squared = (t[:, None] ** 2 + t**2) * (0.3 - level) ** 2
    h = height - level
    return float((0.25 * w[:, None] * w * (1.0 - radius**2 * h / (h * h + squared) ** 1.5)).sum())


@pytest.mark.slow
def test_irradiance_below_a_black_sphere() -> None:
    """By radius and height of the sphere, and by the height of the floor that receives the light."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    view = T.look_at([0, 0, 0.3], [0, 0, 0], [0, 1, 0])
    ball = {"type": "sphere", "exact": True, "center": [0.0, 0.0, 1.2], "radius": 0.5, "bsdf": diffuse(0.0, 0.0, 0.0)}
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 90.0, "to_world": view, "film": film},
            "floor": floor(half=0.4, bsdf=diffuse(1.0, 1.0, 1.0)),
            "sky": {"type": "constant", "radiance": 1.0},
            "ball": ball,
        }
    )
    params = psdr.traverse(scene)
    params.requires_grad("ball.to_world", "floor.to_world")
    integrator = psdr.PathIntegrator(max_depth=2)
    found = []
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(scene, params, np.ones((8, 8, 3)) / 192.0, spp=2048, seed=seed, integrator=integrator)
        by_ball = params["ball.to_world"].grad.numpy().reshape(4, 4)
        by_floor = params["floor.to_world"].grad.numpy().reshape(4, 4)
        found.append([np.trace(by_ball[:3, :3]), by_ball[2, 3], by_floor[2, 3]])
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(8.0)
    at, step = np.array([0.5, 1.2, 0.0]), 1e-5
    exact = [(light_below(*(at + step * e)) - light_below(*(at - step * e))) / (2.0 * step) for e in np.eye(3)]
    assert (error < 0.01 * np.abs(exact)).all(), error / np.abs(exact)
    np.testing.assert_allclose(mean, exact, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "other"), [("exact, wall", "wall.to_world"), ("exact, bent", "other.vertex_positions")]
)
def test_reverse_mode_is_the_transpose(name: str, other: str) -> None:
    scene, params = load(name)
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [BALL, other, LAMP], options)


@pytest.mark.slow
def test_is_the_fine_tessellations() -> None:
    """10^5 triangles, by every number of the pose, and the same floor and lamp."""
    found = {}
    for name in ("exact, lamp", "fine, lamp"):
        scene, params = load(name)
        params.requires_grad_only(BALL, FLOOR, LAMP)
        batches = []
        for seed in range(8):
            params.zero_grad()
            options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 512, "seed": seed}
            psdr.render_backward(scene, params, np.ones((*scene_shape(scene), 3)), **options)
            batches.append(np.concatenate([params[n].grad.numpy().ravel() for n in (BALL, FLOOR, LAMP)]))
        found[name] = np.array(batches, np.float64)
    a, b = found["exact, lamp"], found["fine, lamp"]
    gap, error = a.mean(axis=0) - b.mean(axis=0), np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 8.0)
    scale = np.abs(b.mean(axis=0)).max()
    assert (np.abs(gap) < 5.0 * error + 0.01 * scale).all(), gap / scale
    assert (error < 0.02 * scale).all()


def scene_shape(scene) -> tuple[int, int]:
    camera = scene.camera(0)
    return camera.crop_height, camera.crop_width


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["primary_silhouette", "secondary_silhouette"])
def test_samples_are_drawn_again(kind: str) -> None:
    scene, params = load("exact, lamp")
    params.requires_grad_only(BALL)
    options = {"kind": kind, "params": params, "integrator": psdr.PathIntegrator(max_depth=2), "spp": 16}
    traces = [psdr.trace_sample(scene, sample=n, **options) for n in range(0, 4096, 32)]
    places = [place for trace in traces for place in trace.places if place.what == "point"]
    assert len(places) > 8 and "point: ball (diffuse): position" in "".join(map(str, traces))
    local = np.array([(np.linalg.inv(POSE.matrix) @ np.append(p.position, 1.0))[:3] for p in places])
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "boundary", "problem"),
    [
        ({}, psdr.boundary.EdgeSampling(), "does not know 'ball'"),
        (
            {"ball": ellipsoid(exact=True, bsdf={"type": "dielectric"})},
            psdr.boundary.SignedDistance(),
            "does not know smooth mirrors",
        ),
    ],
)
def test_what_has_no_terms_is_refused(change: dict, boundary, problem: str) -> None:
    scene = psdr.load_dict({"type": "scene", **room("lamp", exact=True)(), **change})
    params = psdr.traverse(scene)
    params.requires_grad(BALL)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=boundary)
    with pytest.raises(ValueError, match=problem):
        psdr.plan(scene, params, integrator=integrator)


def test_light_tracing_is_refused() -> None:
    scene = psdr.load_dict({"type": "scene", **room("lamp", exact=True)()})
    with pytest.raises(ValueError, match=r"does not know 'ball', an exact 'sphere'; use interior.Replay"):
        psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=2, interior=psdr.interior.LightTracing()))


@pytest.mark.parametrize("method", [psdr.interior.Resampled(), psdr.interior.Antithetic()])
def test_interior_methods_without_it_are_refused(method) -> None:
    metal = {"type": "roughconductor", "alpha": 0.3}
    scene = psdr.load_dict({"type": "scene", **room("lamp", exact=True, bsdf=metal)()})
    integrator = psdr.PathIntegrator(max_depth=2, interior=method)
    with pytest.raises(ValueError, match=rf"{type(method).__name__}\(\) does not know 'ball'"):
        psdr.plan(scene, names=["ball.bsdf.alpha.value"], integrator=integrator)


@pytest.mark.slow
@pytest.mark.parametrize("method", [psdr.interior.Textbook(), psdr.interior.Radiative()])
def test_interior_methods_agree(method) -> None:
    """The interior term of the pose, by equal random numbers or in the mean."""
    scene, params = load("exact, lamp")
    params.requires_grad_only(BALL, FLOOR)
    found = []
    for interior in (psdr.interior.Replay(), method):
        batches = []
        for seed in range(8):
            params.zero_grad()
            integrator = psdr.PathIntegrator(max_depth=3, rr_depth=99, interior=interior, boundary=None)
            psdr.render_backward(
                scene, params, np.ones((*scene_shape(scene), 3)), integrator=integrator, spp=256, seed=seed
            )
            batches.append(np.concatenate([params[n].grad.numpy().ravel() for n in (BALL, FLOOR)]))
        found.append(np.array(batches, np.float64))
    a, b = found
    gap, error = a.mean(axis=0) - b.mean(axis=0), np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 8.0)
    assert (np.abs(gap) < 5.0 * error + 1e-4 * np.abs(a.mean(axis=0)).max()).all()
    assert np.linalg.norm(error) < 0.05 * np.linalg.norm(a.mean(axis=0))
