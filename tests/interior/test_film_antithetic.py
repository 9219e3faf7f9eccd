"""Mirrored film points: the whole derivative by cameras and rooms, equal in both modes, less noise than without."""

import functools

import numpy as np
import pytest
import warp as wp
from scipy import stats

import warp_psdr as psdr
from tests.gradients.measure import NO_ROULETTE, shared_random_numbers
from tests.gradients.scenes import rgb
from warp_psdr.kernels.interior.factors.film_points import MIRRORED as MIRRORED_POINTS
from warp_psdr.kernels.interior.factors.film_points import film_form
from warp_psdr.kernels.interior.film_antithetic import make_spread_offset, mirrored_offset, spread_density
from warp_psdr.kernels.sensor.camera import CameraSample, load_mat44, make_camera_ray
from warp_psdr.kernels.sensor.film import filter_extent
from warp_psdr.kernels.sensor.projection import make_projection
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import film_position

SIZE = 16
#: Difference of two means over their standard error that independent batches exceed once in 16,000 tries.
Z = 4.0
#: Noise of correlated differences and of the derivative, and the difference's own error.
SLOPE = 0.02
#: Sums in another order.
ROUNDING = 1e-4
MIRRORED, ALONE = psdr.interior.FilmAntithetic(), psdr.interior.FilmAntithetic(mirrored=False)
CORNERS = np.array([[x, y, z] for x in (-2, 2) for y in (-2.5, 2.5) for z in (-1.5, 1.5)], np.float32)
#: Walls at the ends of x, y and z.
WALLS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def walls(numbers, **more):
    faces = np.array([t for a, b, c, d in (WALLS[i] for i in numbers) for t in ((a, b, c), (a, c, d))], np.int32)
    corners = CORNERS[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = (normal * corners[:, 0]).sum(axis=1) > 0.0
    faces[outwards] = faces[outwards][:, ::-1]
    return {"type": "mesh", "vertices": CORNERS, "faces": faces, "face_normals": True, **more}


def sensor(rfilter="tent", border=True):
    pose = psdr.Transform.look_at([-0.3, -1.5, -0.2], [0.4, 2.0, 0.3], [0, 0, 1])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": rfilter}, "sample_border": border}
    return {"type": "perspective", "fov": 60.0, "to_world": pose, "film": film}


def lit_by_ceiling(**options):
    """A room whose ceiling shines, and whose walls have a colour for each triangle: edges everywhere."""
    colors = np.random.default_rng(1).uniform(0.1, 0.8, (10, 3)).astype(np.float32)
    painted = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "face_color"}}
    lamp = {"type": "area", "radiance": rgb(2.0, 1.8, 1.5)}
    return {
        "type": "scene",
        "sensor": sensor(**options),
        "walls": walls(range(5), face_color=colors, bsdf=painted),
        "ceiling": walls([5], emitter=lamp, bsdf={"type": "diffuse", "reflectance": 0.3}),
    }


def lit_by_point(**options):
    """A room of one shape."""
    metal = {
        "type": "roughconductor",
        "distribution": "ggx",
        "alpha": 0.4,
        "eta": rgb(0.2, 0.9, 1.1),
        "k": rgb(4, 2, 2),
    }
    return {
        "type": "scene",
        "sensor": sensor(**options),
        "walls": walls(range(6), bsdf=metal),
        "lamp": {"type": "point", "position": [0.2, 0.1, 0.6], "intensity": rgb(5.0, 4.0, 3.0)},
    }


SCENES = {"ceiling": lit_by_ceiling(), "gaussian": lit_by_ceiling(rfilter="gaussian"), "point": lit_by_point()}


@functools.cache
def load(name):
    scene = psdr.load_dict(SCENES[name])
    return scene, psdr.traverse(scene)


def moved(name, kind):
    """A parameter and a direction in which it moves."""
    _scene, params = load(name)
    if kind == "camera":
        tangent = np.zeros((4, 4), np.float32)
        tangent[:3, 3] = (1.0, 0.3, 0.5)
        return "sensor.to_world", tangent
    if kind == "turn":
        turn = np.zeros((4, 4))
        turn[:3, :3] = np.cross(np.eye(3), [0.5, 0.2, 0.3])
        return "sensor.to_world", (turn @ params["sensor.to_world"].numpy()).astype(np.float32)
    if kind == "fov":
        return "sensor.x_fov", np.full(1, 10.0, np.float32)
    points = params["walls.vertex_positions"].numpy()
    return "walls.vertex_positions", (points * [0.5, 0.2, -0.4] + [0.1, 0.2, -0.1]).astype(np.float32)


def integrator(method=MIRRORED, depth=3):
    return psdr.PathIntegrator(max_depth=depth, rr_depth=NO_ROULETTE, interior=method)


def adjoint():
    across = np.linspace(-1.0, 1.0, SIZE)[None, :, None]
    return (np.random.default_rng(3).uniform(0.5, 1.5, size=(SIZE, SIZE, 3)) + across).astype(np.float32)


def backward(name, parameter, tangent, method, seeds, *, spp):
    """Derivatives along a tangent, one a seed, by reverse mode."""
    scene, params = load(name)
    params.requires_grad_only(parameter)
    found = []
    for seed in seeds:
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint(), integrator=integrator(method), spp=spp, seed=seed)
        found.append((params[parameter].grad.numpy().astype(np.float64) * tangent).sum())
    assert not any(psdr.invalid_samples(scene).values())
    return np.array(found)


def slope_of(name, kind, *, batches, spp, step=0.02):
    """The derivative over correlated differences of images, and the noise of that ratio."""
    scene, params = load(name)
    parameter, tangent = moved(name, kind)
    value = params[parameter].numpy().copy()
    gradient = backward(name, parameter, tangent, MIRRORED, range(batches), spp=spp)

    def loss(change, seed):
        params[parameter] = (value + change * tangent).astype(np.float32)
        params.update()
        image = psdr.render(scene, integrator=integrator(psdr.interior.Replay()), spp=2 * spp, seed=seed)
        return (image.numpy().astype(np.float64) * adjoint()).sum()

    try:
        with shared_random_numbers():
            slopes = np.array([(loss(step, s) - loss(-step, s)) / (2.0 * step) for s in range(batches)])
    finally:
        params[parameter] = value
        params.update()
    noise = np.hypot(*(x.std(ddof=1) / np.sqrt(len(x)) for x in (slopes, gradient))) / abs(slopes.mean())
    return gradient.mean() / slopes.mean(), noise


def test_slope_of_finite_differences():
    slope, noise = slope_of("ceiling", "turn", batches=16, spp=128)
    assert noise < SLOPE
    assert abs(slope - 1.0) < SLOPE + 2.0 * noise


@pytest.mark.slow
def test_forward_mode_sums_to_reverse_mode():
    scene, params = load("ceiling")
    parameter, tangent = moved("ceiling", "camera")
    reverse = backward("ceiling", parameter, tangent, MIRRORED, [11], spp=8)[0]
    options = {"integrator": integrator(), "spp": 8, "seed": 11}
    image = psdr.render_forward(scene, params, {parameter: tangent}, **options).numpy().astype(np.float64)
    assert abs((image * adjoint()).sum() - reverse) <= ROUNDING * np.abs(image * adjoint()).sum() and abs(reverse) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"), [("ceiling", "camera"), ("gaussian", "turn"), ("gaussian", "fov"), ("point", "walls")]
)
def test_more_slopes_of_finite_differences(name, kind):
    slope, noise = slope_of(name, kind, batches=64, spp=512)
    assert noise < SLOPE
    assert abs(slope - 1.0) < SLOPE + 2.0 * noise


@pytest.mark.slow
def test_mean_is_that_of_replay_and_its_boundary_term():
    parameter, tangent = moved("ceiling", "turn")
    means, errors = [], []
    for method in (MIRRORED, psdr.interior.Replay()):
        found = backward("ceiling", parameter, tangent, method, range(64), spp=64)
        means.append(found.mean())
        errors.append(found.std(ddof=1) / 8.0)
    assert abs(means[0]) > 10.0 * errors[0]
    assert abs(means[0] - means[1]) < Z * np.hypot(*errors)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "gain"), [("ceiling", 3.0), ("gaussian", 6.0)])
def test_mirrored_points_have_less_noise(name, gain):
    scene, params = load(name)
    parameter, tangent = moved(name, "camera")

    def variance(method):
        options = {"integrator": integrator(method), "spp": 16}
        images = [psdr.render_forward(scene, params, {parameter: tangent}, seed=s, **options) for s in range(24)]
        return np.var([image.numpy().astype(np.float64) for image in images], axis=0).sum()

    assert variance(ALONE) > gain * variance(MIRRORED)


def refused(scene, names, said, method=None):
    with pytest.raises(ValueError, match=said):
        psdr.plan(psdr.load_dict(scene), names=names, integrator=method or integrator())


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (lit_by_ceiling(border=False), "sample_border=true"),
        (lit_by_point() | {"walls": walls(range(6), bsdf={"type": "conductor"})}, "smooth mirrors and glass"),
    ],
    ids=["cut filters", "mirrors"],
)
def test_what_has_other_terms_is_refused(scene, said):
    refused(scene, ["sensor.to_world"], said)


def test_other_requests_are_refused():
    method = psdr.PathIntegrator(max_depth=3, interior=MIRRORED, boundary=psdr.boundary.EdgeSampling())
    refused(SCENES["ceiling"], ["ceiling.vertex_positions"], r"stay on surfaces; use boundary\.PathSpace\(\)", method)
    method = integrator(depth=65)
    refused(SCENES["ceiling"], ["sensor.to_world"], "max_depth: got 65, expected 1 to 64", method)
    method = psdr.PathIntegrator(max_depth=3, interior=MIRRORED, boundary=psdr.boundary.PathSpace())
    refused(SCENES["ceiling"], ["sensor.to_world"], "whole without it; leave boundary out", method)


def test_the_plan_names_it():
    plan = psdr.plan(psdr.load_dict(SCENES["ceiling"]), names=["sensor.to_world"], integrator=integrator())
    lines = {item: (decision, reason) for item, decision, reason in plan.lines}
    assert lines["interior"][0].startswith("mirrored film points") and "mirrored fours" in lines["interior"][1]
    assert lines["boundary term"][0] == "none"
    plan = psdr.plan(psdr.load_dict(SCENES["ceiling"]), names=["ceiling.vertex_positions"], integrator=integrator())
    assert plan.boundary == psdr.boundary.PathSpace()


#: The back wall is the plane y = WALL, which the camera sees at an angle.
WALL = 2.5


@functools.cache
def make_points(kinds):
    camera_ray = make_camera_ray(kinds[0])[0]
    project = make_projection(kinds[0])[0]
    spread_offset = make_spread_offset(kinds[1])

    @wp.kernel(module="unique", enable_backward=False)
    def points(
        scene: Scene,
        camera: Camera,
        pixel: wp.vec2i,
        u: wp.array(dtype=wp.vec4),
        out: wp.array(dtype=wp.vec3),
    ):
        """Points of the wall, in fours."""
        i = wp.tid()
        sample = CameraSample()
        offset = mirrored_offset(spread_offset(camera, u[i // wp.static(MIRRORED_POINTS)]), i)
        sample.film = film_position(camera, pixel[0], pixel[1], offset)
        ray = camera_ray(scene, camera, sample)
        out[i] = ray.o + ((WALL - ray.o[1]) / ray.d[1]) * ray.d

    @wp.kernel(module="unique", enable_backward=False)
    def densities(
        scene: Scene,
        camera: Camera,
        pixel: wp.vec2i,
        x: wp.array(dtype=wp.vec3),
        out: wp.array2d(dtype=wp.float32),
    ):
        """Density of points per area, and the factor of ``film_form``."""
        i = wp.tid()
        at = project(scene, camera, x[i], wp.vec2())
        q = wp.float32(1.0)
        for axis in range(2):
            away = at.pixel[axis] - wp.float32(pixel[axis]) - 0.5
            q *= wp.where(wp.abs(away) < filter_extent(camera), spread_density(camera, away), 0.0)
        n = wp.vec3(0.0, -1.0, 0.0)
        cosine = wp.abs(wp.dot(n, wp.normalize(x[i] - at.origin)))
        out[i, 0] = q * cosine * at.per_area
        out[i, 1] = cosine * at.per_area
        m = load_mat44(scene.values, camera.to_world)
        fov = scene.values[camera.x_fov]
        width = wp.float32(camera.width)
        height = wp.float32(camera.height)
        form = film_form(x[i], n, m, fov, 0.0, 0.0, width, height, wp.vec2(), 1.0)
        out[i, 2] = 0.25 * width * width * wp.exp(form)

    return points, densities


@pytest.mark.parametrize("rfilter", ["tent", "gaussian"])
def test_mirrored_points_have_their_density_on_a_surface(rfilter):
    """Chi-square over cells of the wall: p_A = q cos(theta) / (d^2 cos^3(theta_film)) times the pixels of a unit."""
    scene = psdr.load_dict(lit_by_ceiling(rfilter=rfilter))
    config, camera, device = psdr.plan(scene).config, scene.camera(0), scene.device
    points, densities = make_points((config.camera, config.filter))
    pixel, count = wp.vec2i(12, 4), 400_000
    u = wp.array(np.random.default_rng(5).random((count // 4, 4), dtype=np.float32), dtype=wp.vec4, device=device)
    x = wp.zeros(count, dtype=wp.vec3, device=device)
    wp.launch(points, dim=count, inputs=[scene.data(), camera, pixel, u], outputs=[x], device=device)
    x = x.numpy()[:, ::2].astype(np.float64)  # x and z of the wall
    edges = [np.linspace(column.min() - 1e-3, column.max() + 1e-3, 21) for column in x.T]
    fine = 24
    middles = [(a[:-1, None] + (np.arange(fine) + 0.5) / fine * np.diff(a)[:, None]).ravel() for a in edges]
    grid = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 2)
    where = np.insert(grid, 1, WALL, axis=1).astype(np.float32)
    out = wp.zeros((len(where), 3), dtype=wp.float32, device=device)
    inputs = [scene.data(), camera, pixel, wp.array(where, dtype=wp.vec3, device=device)]
    wp.launch(densities, dim=len(where), inputs=inputs, outputs=[out], device=device)
    density, factor, form = out.numpy().astype(np.float64).T
    np.testing.assert_allclose(form, factor, rtol=1e-4)
    cells = density.reshape(20, fine, 20, fine).mean(axis=(1, 3)) * np.outer(*map(np.diff, edges))
    np.testing.assert_allclose(cells.sum(), 1.0, atol=2e-3)  # of the sum over points of a cell
    # The four points of a sample are not independent of each other, but each of them is of those of other samples.
    for of_four in range(4):
        observed = np.histogram2d(*x[of_four::4].T, bins=edges)[0].ravel()
        expected = (cells / cells.sum()).ravel() * observed.sum()
        rare = expected < 5.0
        observed = np.append(observed[~rare], observed[rare].sum())
        expected = np.append(expected[~rare], expected[rare].sum())
        keep = expected > 0.0
        assert stats.chisquare(observed[keep], expected[keep] * observed.sum() / expected[keep].sum()).pvalue > 1e-5
