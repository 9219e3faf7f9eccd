"""Exact spheres, disks and cylinders that shine: samplers, images, and derivatives in material form."""

import numpy as np
import pytest
import warp as wp
from scipy.stats import chi2

import warp_psdr as psdr
from tests.path.helpers import batches
from tests.path.test_exact_sphere import TILES, assert_same
from tests.path.test_exact_sphere import scene as ball_scene
from tests.peer import MITSUBA_ROUNDING, for_mitsuba
from warp_psdr.kernels.emitter.area import make_area, make_pdf_area
from warp_psdr.kernels.primitive.cylinder import CYLINDER
from warp_psdr.kernels.primitive.disk import DISK
from warp_psdr.kernels.primitive.shining import make_shining
from warp_psdr.kernels.primitive.sphere import SPHERE
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene

T = psdr.Transform
SHINING = (SPHERE.number, DISK.number, CYLINDER.number)
NAMES = ("sphere", "disk", "cylinder")
AREA = make_area((0,), SHINING)
PDF = make_pdf_area(SHINING)
SQUARE = make_shining(SHINING).square
#: Share of the sphere's density that is uniform in the cone of directions; the rest is 1 / (2 sqrt(1 - s)).
EVEN = 0.5
POSES = {
    "sphere": T.translate([0.1, 0.0, 1.2]).rotate([0, 1, 1], 35.0).scale([0.4, 0.3, 0.35]),
    "disk": T.translate([0.1, 0.0, 1.0]).rotate([1, 0.3, 0], 155.0).scale([0.4, 0.3, 0.5]),
    "cylinder": T.translate([0.0, -0.3, 1.0]).rotate([1, 0.2, 0], -80.0).scale([0.2, 0.3, 0.7]),
}
SLOPE = 0.02


def light(radiance: float = 2.0) -> dict:
    return {"type": "area", "radiance": {"type": "rgb", "value": [radiance, radiance, radiance]}}


def below(shine: dict, **more) -> psdr.Scene:
    """A white floor that a camera looks at from under a light, which it does not see."""
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    view = T.look_at([0.6, 0.0, 0.3], [0.6, 0.0, 0.0], [0, 1, 0])
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 10.0, "to_world": view, "film": film},
            "floor": {"type": "rectangle", "to_world": T.scale(2.0), "bsdf": white},
            "shine": {"exact": True, "emitter": light(), **shine},
            **more,
        }
    )


@wp.kernel(module="unique", enable_backward=False)
def draw(scene: Scene, number: wp.int32, x: wp.vec3, u: wp.array(dtype=wp.vec2), out: wp.array2d(dtype=wp.float32)):
    i = wp.tid()
    e = scene.emitters[number]
    face = AREA.select_triangle(scene, e, 0.5)
    ls = AREA.sample_point(scene, e, face, triangle_at(scene, face), x, u[i])
    out[i, 0] = ls.u
    out[i, 1] = ls.v
    out[i, 2] = ls.pdf
    out[i, 3] = PDF(scene, e, face, ls.u, ls.v, ls.wi, ls.distance)
    for k in range(3):
        out[i, 4 + k] = ls.wi[k]
    again = SQUARE(triangle_at(scene, face), x, ls.u, ls.v)
    out[i, 7] = again[0]
    out[i, 8] = again[1]


def sphere_coordinates(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Points of the unit sphere of octahedral coordinates."""
    z = 1.0 - np.abs(a) - np.abs(b)
    x = np.where(z < 0.0, np.where(a < 0.0, np.abs(b) - 1.0, 1.0 - np.abs(b)), a)
    y = np.where(z < 0.0, np.where(b < 0.0, np.abs(a) - 1.0, 1.0 - np.abs(a)), b)
    return np.stack([x, y, z], axis=1) / np.sqrt(x * x + y * y + z * z)[:, None]


def uniform_numbers(name: str, a: np.ndarray, b: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two numbers that are uniform if points are drawn as they should be from e, in the coordinates of the kind."""
    if name == "disk":
        return np.arctan2(b, a) / (2.0 * np.pi) % 1.0, a * a + b * b
    if name == "cylinder":
        distance = np.hypot(e[0], e[1])
        if distance < 1.0:
            return a / (2.0 * np.pi) % 1.0, b
        turn = (a - np.arctan2(e[1], e[0]) + np.pi) % (2.0 * np.pi) - np.pi
        return 0.5 + 0.5 * turn / np.arccos(1.0 / distance), b
    q, distance = sphere_coordinates(a, b), np.linalg.norm(e)
    axis = e / distance
    across = np.linalg.qr(np.column_stack([axis, np.eye(3)[:, :2]]))[0][:, 1:]
    around = np.arctan2(q @ across[:, 1], q @ across[:, 0]) / (2.0 * np.pi) % 1.0
    if distance < 1.0:
        return 0.5 + 0.5 * q @ axis, around
    cosine = (e - q) @ axis / np.linalg.norm(e - q, axis=1)
    s = (1.0 - cosine) / (1.0 - np.sqrt(1.0 - 1.0 / distance**2))
    return EVEN * s + (1.0 - EVEN) * (1.0 - np.sqrt(np.maximum(1.0 - s, 0.0))), around


FAR_POINT, NEAR_POINT, INSIDE = (0.6, 0.2, -0.5), (0.12, 0.03, 0.76), (0.0, 0.1, 1.2)
SEEN_FROM = [
    *((name, FAR_POINT, "") for name in NAMES),
    ("sphere", NEAR_POINT, ""),
    ("sphere", INSIDE, "flipped"),
    ("sphere", FAR_POINT, "flipped"),
    ("cylinder", INSIDE, "flipped"),
]


def test_points_are_drawn_from_what_faces_the_receiver() -> None:
    """Chi-square over cells; densities against cones of directions; the inverse; far, near, inside, flipped."""
    random, count, cells = np.random.default_rng(3), 200_000, 12
    for name, place, flipped in SEEN_FROM:
        case, x = (name, place, flipped), np.array(place)
        shape = {
            "type": name,
            "exact": True,
            "to_world": POSES[name],
            "emitter": light(),
            "flip_normals": bool(flipped),
        }
        scene = psdr.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "shape": shape})
        pose = np.asarray(psdr.traverse(scene)["shape.to_world"].numpy(), np.float64).reshape(4, 4)
        e = np.linalg.solve(pose[:3, :3], x - pose[:3, 3])
        u = wp.array(random.random((count, 2)).astype(np.float32), dtype=wp.vec2, device=scene.device)
        out = wp.zeros((count, 9), dtype=wp.float32, device=scene.device)
        wp.launch(draw, dim=count, inputs=[scene.data(), 0, wp.vec3(*x), u], outputs=[out], device=scene.device)
        a, b, pdf, again, *w, first_of, second_of = out.numpy().astype(np.float64).T
        drawn_from = np.stack([first_of, second_of], axis=1)
        # Float32 next to poles and axes, where one of the two is free.
        assert (np.abs(drawn_from - u.numpy()) < 1e-4).mean() > 0.995, case
        # A flipped sphere is drawn evenly from outside as well, where its inside is out of sight.
        seen_from = 0.5 * e / np.linalg.norm(e) if flipped else e
        first, second = uniform_numbers(name, a, b, seen_from)
        counts = np.histogram2d(first, second, bins=cells, range=[[-1e-6, 1 + 1e-6], [0, 1 + 1e-6]])[0]
        expected = count / cells**2
        assert counts.sum() == count
        assert ((counts - expected) ** 2 / expected).sum() < chi2.ppf(1.0 - 1e-4, cells**2 - 1), case
        front = pdf > 0.0
        if not flipped and name != "disk":
            assert front.mean() > 0.999, case
        np.testing.assert_allclose(again[front], pdf[front], rtol=1e-4)
        # The share of samples in small cones is that of the density: E[1 / pdf] over a cone is its solid angle.
        w = np.stack(w, axis=1)
        middle = np.median(w[front], axis=0)
        axis, cosine = middle / np.linalg.norm(middle), 0.999
        inside = front & (w @ axis > cosine)
        values = np.where(inside, 1.0 / np.where(front, pdf, 1.0), 0.0)
        error = values.std(ddof=1) / np.sqrt(count)
        assert abs(values.mean() - 2.0 * np.pi * (1.0 - cosine)) < 4.0 * error, case


@pytest.mark.parametrize("textured", [pytest.param(False, marks=pytest.mark.slow), True])
def test_image_is_mitsubas(textured: bool) -> None:
    """Three lights that the camera sees as well, beside a lamp; glossy and diffuse things around them."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    tiles = {"type": "bitmap", "bitmap": TILES, "raw": True, "filter_type": "nearest"}
    radiance = tiles if textured else {"type": "rgb", "value": [2.0, 3.0, 1.0]}

    def held(**form) -> dict:
        described = ball_scene({"type": "roughconductor", "alpha": 0.2}, center=[0.0, 0.4, 0.4], radius=0.4)
        places = {
            "sphere": {"center": [-0.8, 0.0, 0.6], "radius": 0.25},
            "disk": {"to_world": T.translate([0.7, -0.3, 0.6]).rotate([1, 0.5, 0], 60.0).scale([0.3, 0.2, 1.0])},
            "cylinder": {"p0": [-0.4, -0.7, 0.2], "p1": [0.3, -0.8, 0.3], "radius": 0.1},
        }
        for name, place in places.items():
            emitter = {"type": "area", "radiance": radiance}
            described[f"{name}_light"] = {"type": name, "emitter": emitter, **place, **form}
        return described

    theirs = mi.load_dict(for_mitsuba(mi, held()))
    images = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(8)]).astype(np.float64)
    assert_same(batches(psdr.load_dict(held(exact=True)), count=8, spp=64, max_depth=4), images, MITSUBA_ROUNDING)


def gradients(scene: psdr.Scene, name: str, weights: np.ndarray, spp: int = 4096) -> np.ndarray:
    """Gradients of the weighted image by the interior term alone, batch by batch."""
    params = psdr.traverse(scene)
    params.requires_grad_only(name)
    found = []
    for seed in range(8):
        params.zero_grad()
        options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=None), "spp": spp, "seed": seed}
        psdr.render_backward(scene, params, weights, **options)
        found.append(params[name].grad.numpy().astype(np.float64).reshape(params[name].numpy().shape))
    return np.array(found)


@pytest.mark.slow
def test_irradiance_from_a_sphere() -> None:
    """pi L cos(theta) (R / D)^2 by radius and height; nothing is hidden, and the interior is all of it."""
    scene = below({"type": "sphere", "center": [0.0, 0.0, 1.2], "radius": 0.4})
    weights = np.full((4, 4, 3), 1.0 / 48.0, np.float32)
    t = np.tan(np.radians(5.0)) * 0.3 * np.polynomial.legendre.leggauss(6)[0]
    w = np.polynomial.legendre.leggauss(6)[1]

    def mean(radius: float, height: float) -> float:
        squared = (0.6 + t[:, None]) ** 2 + t**2
        return float((0.25 * w[:, None] * w * 2.0 * radius**2 * height / (squared + height**2) ** 1.5).sum())

    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=2), spp=4096).numpy()
    assert image.mean() == pytest.approx(mean(0.4, 1.2), rel=3e-3)
    g = gradients(scene, "shine.to_world", weights)
    found = np.stack([np.trace(g[:, :3, :3], axis1=1, axis2=2), g[:, 2, 3]], axis=1)
    step = 1e-5
    exact = [
        (mean(0.4 + step, 1.2) - mean(0.4 - step, 1.2)) / (2.0 * step),
        (mean(0.4, 1.2 + step) - mean(0.4, 1.2 - step)) / (2.0 * step),
    ]
    error = found.std(axis=0, ddof=1) / np.sqrt(8.0)
    assert (error < 0.005 * np.abs(exact)).all(), error
    assert (np.abs(found.mean(axis=0) - exact) < 4.0 * error).all(), (found.mean(axis=0), error, exact)


@pytest.mark.slow
@pytest.mark.parametrize("kind", NAMES)
def test_pose_against_finite_differences(kind: str) -> None:
    """Every number of the pose, the floor's height and the radiance, in reverse mode."""
    scene = below({"type": kind, "to_world": POSES[kind]})
    params = psdr.traverse(scene)
    weights = np.full((4, 4, 3), 1.0 / 48.0, np.float32)
    for name, places in (
        ("shine.to_world", list(np.ndindex(3, 4))),
        ("floor.to_world", [(2, 3)]),
        ("shine.emitter.radiance.value", [(0,)]),
    ):
        base = params[name].numpy().astype(np.float64)
        g = gradients(scene, name, weights)
        scale = np.abs(g.mean(axis=0)).max()
        for place in places:

            def image(step: float, seed: int, name=name, base=base, place=place) -> float:
                moved = base.copy()
                moved[place] += step
                params[name] = moved.astype(np.float32)
                params.update()
                options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 4096, "seed": 50 + seed}
                return float((weights * psdr.render(scene, **options).numpy().astype(np.float64)).sum())

            difference = np.array([(image(0.02, s) - image(-0.02, s)) / 0.04 for s in range(8)])
            params[name] = base.astype(np.float32)
            params.update()
            one = g[(slice(None), *place)]
            error = np.sqrt((one.var(ddof=1) + difference.var(ddof=1)) / 8.0)
            assert error < 0.02 * scale
            assert abs(one.mean() - difference.mean()) < 4.0 * error + 0.004 * scale, (name, place)


@pytest.mark.slow
@pytest.mark.parametrize("kind", NAMES)
@pytest.mark.parametrize("method", [psdr.interior.Textbook(), psdr.interior.Radiative()])
def test_interior_methods_and_modes_agree(kind: str, method) -> None:
    texture = {"type": "bitmap", "bitmap": TILES, "raw": True}
    scene = below({"type": kind, "to_world": POSES[kind], "emitter": {"type": "area", "radiance": texture}})
    params = psdr.traverse(scene)
    names = ["shine.to_world", "shine.emitter.radiance.data", "floor.to_world"]
    params.requires_grad_only(*names)
    found = []
    for interior in (psdr.interior.Replay(), method):
        params.zero_grad()
        integrator = psdr.PathIntegrator(max_depth=3, rr_depth=99, interior=interior, boundary=None)
        psdr.render_backward(scene, params, np.ones((4, 4, 3)), integrator=integrator, spp=4096)
        found.append(np.concatenate([params[n].grad.numpy().ravel() for n in names]).astype(np.float64))
    np.testing.assert_allclose(found[0], found[1], atol=0.05 * np.abs(found[0]).max())
    random = np.random.default_rng(1)
    tangents = {n: random.normal(size=params[n].numpy().shape).astype(np.float32) for n in names}
    for n in ("shine.to_world", "floor.to_world"):
        tangents[n][3] = 0.0
    integrator = psdr.PathIntegrator(max_depth=3, rr_depth=99, boundary=None)
    image = psdr.render_forward(scene, params, tangents, integrator=integrator, spp=4096).numpy().astype(np.float64)
    params.zero_grad()
    psdr.render_backward(scene, params, np.ones((4, 4, 3)), integrator=integrator, spp=4096)
    total = sum(float((params[n].grad.numpy().astype(np.float64) * tangents[n]).sum()) for n in names)
    assert total == pytest.approx(image.sum(), abs=1e-4 * np.abs(image).sum())


@pytest.mark.parametrize(
    ("boundary", "problem"),
    [
        (psdr.boundary.SignedDistance(), "does not know exact shapes that shine"),
        (psdr.boundary.EdgeSampling(), "does not know 'shine'"),
    ],
)
def test_what_it_does_not_do_is_refused(boundary, problem: str) -> None:
    scene = below({"type": "sphere", "to_world": POSES["sphere"]})
    with pytest.raises(ValueError, match=problem):
        psdr.plan(scene, names=["floor.to_world"], integrator=psdr.PathIntegrator(max_depth=2, boundary=boundary))
