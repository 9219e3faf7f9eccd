"""Rays that move with the silhouettes of a sphere: closed forms, finite differences, and the explicit boundary term."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, camera, diffuse, floor, load, panel, register, sky
from .test_exact_sphere import pinhole

BALL = "ball.to_world"
POSE = T.translate([0.1, 0.0, 0.8]).rotate([0.0, 0.6, 0.8], 35.0).scale(0.35)
VIEW = camera((0.3, -2.2, 3.0), (0.0, 0.0, 0.2), fov=38.0)
METHODS = [psdr.boundary.SignedDistance(), psdr.boundary.NeuralSignedDistance()]


def sphere(*color, **more) -> dict:
    return {"type": "sphere", "exact": True, "to_world": POSE, "bsdf": diffuse(*color or (0.7, 0.5, 0.3)), **more}


def shadowed(*color, **more) -> dict:
    return {
        "sensor": VIEW,
        "floor": floor(half=6.0),
        "ball": sphere(*color),
        "light": panel((0.8, -0.8, 2.5), 0.4),
    } | more


register(
    {
        "moving rays, sky": lambda: (
            {"sensor": camera((0.3, -2.2, 3.0), (0.0, 0.0, 0.6), fov=38.0, rfilter="box")}
            | {"ball": sphere(), "sky": sky()}
        ),
        "moving rays, lamp": shadowed,
        "moving rays, black": lambda: shadowed(0.0),
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


def shear(pose):
    r = 0.0 * pose
    r[:3, :3] = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 0]]) @ pose[:3, :3]
    return r


CASES = [
    Case("moving rays, sky", BALL, radius, 0.005, "radius", 2, 3072, 2048),
]


@pytest.mark.parametrize(
    ("method", "mode"),
    [(METHODS[0], "forward"), (METHODS[0], "reverse"), (METHODS[1], "reverse")],
    ids=["one place, forward", "one place, reverse", "every step"],
)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str, method) -> None:
    assert_agrees(derivatives(case, mode, method), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=["one place", "every step"])
@pytest.mark.parametrize("name", ["moving rays, lamp", "moving rays, black"])
def test_agrees_with_the_explicit_term(name: str, method) -> None:
    """A ball that shades and is shaded, by its radius, its centre and a shear: z-test over independent batches."""
    scene, params = load(name)
    pose = params[BALL].numpy().astype(np.float64)
    tangents = [radius(pose), entry(0, 3)(pose), entry(1, 3)(pose), entry(2, 3)(pose), shear(pose)]
    y, x = np.mgrid[:16, :16] / 16.0
    adjoint = ((np.sin(3.0 * x + 1.0) * np.cos(4.0 * y) + 0.7)[..., None] * [1.0, 0.6, 0.3]).astype(np.float32)

    def sums(boundary, spp: int) -> np.ndarray:
        params.requires_grad_only(BALL)
        how = psdr.PathIntegrator(max_depth=2, boundary=boundary)
        found = []
        for seed in range(8):
            params.zero_grad()
            psdr.render_backward(scene, params, adjoint, integrator=how, spp=spp, seed=seed)
            g = params[BALL].grad.numpy().astype(np.float64)
            found.append([(g * t).sum() for t in tangents])
        return np.array(found)

    explicit, moving = sums("auto", 512), sums(method, 512)
    error = np.sqrt((explicit.var(axis=0, ddof=1) + moving.var(axis=0, ddof=1)) / 8.0)
    assert (np.abs((moving - explicit).mean(axis=0)) < 4.0 * error).all()
    assert error[0] < 0.03 * abs(explicit[:, 0].mean())


def film_area(scene, boundary, spp: int, seed: int) -> np.ndarray:
    """Derivatives of the area of a black sphere's image, on the film at distance 1, by radius and centre."""
    params = psdr.traverse(scene)
    params.requires_grad(BALL)
    one = np.ones((32, 32, 3)) / 3.0
    psdr.render_backward(
        scene, params, one, spp=spp, seed=seed, integrator=psdr.PathIntegrator(max_depth=1, boundary=boundary)
    )
    g = -((2.0 * np.tan(np.radians(30.0)) / 32.0) ** 2) * params[BALL].grad.numpy().reshape(4, 4)
    return np.array([np.trace(g[:3, :3]), *g[:3, 3]])


@pytest.mark.parametrize("method", [METHODS[0], pytest.param(METHODS[1], marks=pytest.mark.slow)], ids=["one", "every"])
def test_area_on_the_film(method) -> None:
    """The same numbers as those of ``test_exact_sphere.py``."""
    scene = pinhole([0.4, 0.0, 2.0])
    found = np.array([film_area(scene, method, 128, seed) for seed in range(8)])
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    expected = np.array([0.913640, 0.021878, 0.0, -0.232786])
    assert (error < 0.004).all()
    assert (np.abs(found.mean(axis=0) - expected) < 4.0 * error + 1e-3).all()


@pytest.mark.slow
def test_a_limit_of_steps_is_a_bias() -> None:
    """And the plan says so."""
    scene = pinhole([0.4, 0.0, 2.0])
    method = psdr.boundary.NeuralSignedDistance(max_steps=24)
    found = np.array([film_area(scene, method, 512, seed) for seed in range(8)])[:, 0]
    error = found.std(ddof=1) / np.sqrt(len(found))
    assert abs(found.mean() - 0.913640) > 6.0 * error
    params = psdr.traverse(scene)
    params.requires_grad(BALL)
    said = str(psdr.plan(scene, params, integrator=psdr.PathIntegrator(max_depth=1, boundary=method)))
    assert "at most 24: biased" in said


@pytest.mark.slow
@pytest.mark.parametrize("rfilter", ["box", "tent", "gaussian"])
@pytest.mark.parametrize("border", [False, True])
def test_filters_agree_with_the_explicit_term(rfilter: str, border: bool) -> None:
    """A sphere that the film's border cuts, pixel by pixel: the image of the derivative, weighted by itself."""
    view = camera((0.3, -2.2, 3.0), (0.35, 0.0, 0.8), fov=16.0, rfilter=rfilter)
    view["film"]["sample_border"] = border
    scene = psdr.load_dict({"type": "scene", "sensor": view, "ball": sphere(0.0), "sky": sky()})
    params = psdr.traverse(scene)
    given = {BALL: radius(params[BALL].numpy()).astype(np.float32)}

    def images(boundary, spp: int) -> np.ndarray:
        how = psdr.PathIntegrator(max_depth=1, boundary=boundary)
        return np.array(
            [psdr.render_forward(scene, params, given, spp=spp, seed=s, integrator=how).numpy() for s in range(8)]
        ).astype(np.float64)[..., 0]

    explicit, moving = images("auto", 256), images(METHODS[0], 1024)
    assert np.abs(explicit.mean(axis=0)).max() > 1.0
    error = np.sqrt((explicit.var(axis=0, ddof=1) + moving.var(axis=0, ddof=1)) / 8.0)
    resolved = error > 1e-3  # elsewhere both are zero to rounding
    z = (moving - explicit).mean(axis=0)[resolved] / error[resolved]
    assert np.mean(z**2) < 2.0 and np.abs(z).max() < 7.0
    weights = explicit.mean(axis=0)
    sums = (weights * (moving - explicit)).sum(axis=(1, 2)) / (weights**2).sum()
    assert abs(sums.mean()) < 4.0 * sums.std(ddof=1) / np.sqrt(8.0) + 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=["one", "every"])
def test_forward_and_reverse_mode_are_transposes(method) -> None:
    scene, params = load("moving rays, lamp")
    options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=method), "spp": 8, "seed": 3}
    assert_transposes(scene, params, [BALL], options)


def union(distance: float, nodes: int = 17) -> np.ndarray:
    """Values (Z, Y, X, 1) of two spheres that are blended, their centres ``distance`` apart."""
    x = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, nodes)] * 3, indexing="ij"), axis=-1)[..., ::-1]
    a = np.linalg.norm(x - [0.5 - 0.5 * distance, 0.5, 0.5], axis=-1) - 0.2
    b = np.linalg.norm(x - [0.5 + 0.5 * distance, 0.47, 0.52], axis=-1) - 0.16
    return -0.06 * np.log(np.exp(-a / 0.06) + np.exp(-b / 0.06))[..., None]


def grid(*color, values=None) -> dict:
    turned = T.translate([0.1, 0.0, 0.75]).rotate([0.0, 0.6, 0.8], 35.0).translate([-0.5, -0.5, -0.5])
    given = (union(0.26) if values is None else values).astype(np.float32)
    bsdf = diffuse(*color or (0.7, 0.5, 0.3))
    return {"type": "sdfgrid", "grid": given, "interpolation": "cubic", "to_world": turned, "bsdf": bsdf}


register(
    {
        "moving rays, grid": lambda: {
            "sensor": camera((0.3, -2.2, 3.0), (0.0, 0.0, 0.7), fov=30.0, rfilter="box"), "ball": grid(), "sky": sky()
        },
        "moving rays, grid's shadow": lambda: shadowed() | {"ball": grid(0.0), "light": panel((0.8, -0.8, 2.8), 0.4)},
    }
)  # fmt: skip
GRID = "ball.grid"


def inflated(values):
    return -np.ones_like(values)


def apart(values):
    """The spheres move apart."""
    return ((union(0.265) - union(0.255)) / 0.01).reshape(values.shape)


def grown(pose):
    """The grid grows about the centre of its box."""
    r = radius(pose)
    r[:3, 3] = -0.5 * pose[:3, :3].sum(axis=1)
    return r


GRIDS = [
    Case("moving rays, grid", GRID, inflated, 0.002, "all values", 2, 1024, 2048),
    Case("moving rays, grid", GRID, apart, 0.01, "apart", 2, 3072, 6144),
    Case("moving rays, grid", BALL, grown, 0.005, "grows", 2, 3072, 6144),
    Case("moving rays, grid's shadow", GRID, inflated, 0.002, "all values", 2, 4096, 16384),
]


@pytest.mark.parametrize("case", rows(GRIDS))
def test_smooth_grids_match_finite_differences(case: Case) -> None:
    """Blended spheres, which shade themselves: by all values at once, as they move apart, and by the pose."""
    assert_agrees(derivatives(case, "reverse", METHODS[0]), differences(case)[2])


REFUSED = {
    "an ellipsoid": ({"ball": sphere(to_world=T.translate([0, 0, 1]).scale([0.3, 0.4, 0.5]))}, {}, "ellipsoid"),
    "two spheres": ({"other": sphere(to_world=T.translate([3, 0, 0]))}, {}, "one shape"),
    "no sphere": ({"ball": {**sphere(), "exact": False, "face_normals": True}}, {"names": ["floor.to_world"]}, "one"),
    "the floor moves": ({}, {"names": [BALL, "floor.to_world"]}, "'floor' moves"),
    "the camera moves": ({}, {"names": ["sensor.to_world"]}, "the camera"),
    "longer paths": ({}, {"max_depth": 3}, "max_depth"),
    "an edge in sight": ({"floor": floor(half=0.7)}, {}, "an edge of 'floor'"),
    "a lamp in sight": ({"light": panel((0.0, 0.0, 1.5), 0.2)}, {}, "an edge of 'light'"),
    "a sky beside meshes": ({"sky": sky()}, {}, "one area light"),
    "a grid that is open": ({"ball": grid(values=union(0.26) - 0.2)}, {}, "border of its box"),
    "a mesh in the box": (
        {"ball": grid(), "wall": {**floor(), "to_world": T.translate([0.1, 0, 1.15]).scale(0.1)}}, {}, "into the box",
    ),
    "a stretched grid": ({"ball": {**grid(), "to_world": T.translate([0, 0, 1]).scale([1, 1, 0.5])}}, {}, "similarity"),
    "a point light": (
        {"light": {"type": "point", "position": [0.8, -0.8, 2.5], "intensity": 5.0}}, {}, "whose shadows are hard",
    ),
    "a wall that hides": (
        {"wall": {**floor(), "to_world": T.translate([4, 0, 1]).rotate([0, 1, 0], 90.0).scale(0.5)}},
        {}, "'wall' stands",
    ),
    "another interior": ({}, {"interior": psdr.interior.Radiative()}, "interior.Replay"),
    "parallel rays": (
        {"sensor": {k: v for k, v in {**VIEW, "type": "orthographic"}.items() if k != "fov"}},
        {}, "'perspective'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_refused(what: str) -> None:
    changes, options, said = REFUSED[what]
    options = dict(options)
    scene = psdr.load_dict({"type": "scene", **shadowed(**changes)})
    names = options.pop("names", [BALL])
    integrator = psdr.PathIntegrator(**{"max_depth": 2, "boundary": METHODS[0], **options})
    with pytest.raises(ValueError, match=said):
        psdr.plan(scene, names=names, integrator=integrator)


def test_tri_linear_grids_are_refused() -> None:
    x = np.stack(np.meshgrid(*[np.linspace(0, 1, 9)] * 3, indexing="ij"), axis=-1)
    values = (np.linalg.norm(x - 0.5, axis=-1) - 0.3).astype(np.float32)[..., None]
    linear = {"type": "sdfgrid", "grid": values, "normals": "analytic", "bsdf": diffuse(0.5)}
    scene = psdr.load_dict({"type": "scene", "sensor": VIEW, "sky": sky(), "ball": linear})
    with pytest.raises(ValueError, match="tri-linear grids"):
        psdr.plan(scene, names=[GRID], integrator=psdr.PathIntegrator(max_depth=2, boundary=METHODS[0]))


@pytest.mark.parametrize("options", [{"max_steps": 0}, {"step_scale": 1.5}, {"step_scale": 0.0}, {"spp_secondary": 4}])
def test_options_out_of_range(options: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        psdr.boundary.SignedDistance(**options)
