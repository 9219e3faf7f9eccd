"""Lens distortion: rays and projections against OpenCV's formulas, images, and lenses that are refused."""

import functools

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.path.helpers import assert_same_mean
from warp_psdr.kernels.interior.factors.light_motion import make_importance_gradient
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.sensor.projection import make_projection
from warp_psdr.kernels.structs import Camera, Scene

WIDTH, HEIGHT, FOV = 64, 48, 60.0
#: In OpenCV's order, and of the fisheye.
OPENCV = {"k1": -0.25, "k2": 0.08, "p1": 0.01, "p2": -0.02, "k3": -0.01, "k4": 0.03, "k5": 0.01, "k6": 0.002}
FISHEYE = {"k1": 0.1, "k2": -0.02, "k3": 0.003, "k4": 0.001}
AFFINE = {"pixel_aspect": 1.1, "skew": 0.05}
POSE = psdr.Transform.look_at([0.3, -4.0, 2.5], [0.0, 0.0, 0.4], [0.0, 0.1, 1.0])
LENSES = {
    "opencv": {"distortion": "opencv", **OPENCV, **AFFINE},
    "fisheye": {"distortion": "fisheye", **FISHEYE, **AFFINE},
    "affine": AFFINE,
    "opencv, thin lens": {**OPENCV, "type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.0},
    "fisheye, thin lens": {
        "distortion": "fisheye",
        **FISHEYE,
        "type": "thinlens",
        "aperture_radius": 0.1,
        "focus_distance": 2.0,
    },
}
#: What float32 leaves of a film position, pixels.
ROUNDING = 1e-3


def load(**parameters):
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": FOV, "to_world": POSE, "film": film, "principal_point_offset_x": 0.03}
    return psdr.load_dict({"type": "scene", "sensor": sensor | parameters, "sky": {"type": "constant"}})


def formulas(x, y, lens):
    """OpenCV's formulas: pixels, from the film's corner, of points (x, y, 1) with x to the right and y down."""
    k = {name: lens.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")}
    r2 = x * x + y * y
    if lens.get("distortion") == "fisheye":
        r = np.sqrt(r2)
        t = np.arctan(r)
        factor = (t + k["k1"] * t**3 + k["k2"] * t**5 + k["k3"] * t**7 + k["k4"] * t**9) / r
        u, v = x * factor, y * factor
    else:
        factor = 1.0 + k["k1"] * r2 + k["k2"] * r2**2 + k["k3"] * r2**3
        factor /= 1.0 + k["k4"] * r2 + k["k5"] * r2**2 + k["k6"] * r2**3
        u = x * factor + 2.0 * k["p1"] * x * y + k["p2"] * (r2 + 2.0 * x * x)
        v = y * factor + k["p1"] * (r2 + 2.0 * y * y) + 2.0 * k["p2"] * x * y
    f = 0.5 * WIDTH / np.tan(np.radians(0.5 * FOV))
    u, v = u + lens.get("skew", 0.0) * v, lens.get("pixel_aspect", 1.0) * v
    return np.stack([f * u + WIDTH * (0.5 - 0.03), f * v + 0.5 * HEIGHT], axis=-1)


@functools.cache
def make_round_trip(kind):
    camera_ray, _origin = make_camera_ray(kind)
    project, film_gradient, film_velocity = make_projection(kind)

    @wp.kernel(module="unique", enable_backward=False)
    def round_trip(
        scene: Scene,
        camera: Camera,
        film: wp.array(dtype=wp.vec2),
        lens: wp.vec2,
        v: wp.vec3,
        point_out: wp.array(dtype=wp.vec3),
        film_out: wp.array(dtype=wp.vec2),
        valid_out: wp.array(dtype=wp.int32),
        slope_out: wp.array(dtype=wp.vec2),
        gradient_out: wp.array(dtype=wp.vec2),
        area_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        sample = CameraSample()
        sample.film = film[i]
        sample.lens = lens
        ray = camera_ray(scene, camera, sample)
        x = ray.o + 3.0 * ray.d
        at = project(scene, camera, x, lens)
        point_out[i] = x
        film_out[i] = at.sample.film
        valid_out[i] = at.valid
        slope_out[i] = film_velocity(scene, camera, at, v)
        across = film_gradient(scene, camera, at, wp.vec2(1.0, 0.0))
        down = film_gradient(scene, camera, at, wp.vec2(0.0, 1.0))
        gradient_out[i] = wp.vec2(wp.dot(across, v), wp.dot(down, v))
        # |du x dv|, of the gradients' parts across the ray: pixels a unit of area.
        area_out[i] = wp.abs(wp.dot(wp.cross(across, down), ray.d)) / at.per_area

    return round_trip


def trips(scene, film, lens=(0.0, 0.0), v=(0.3, -0.5, 0.2)):
    camera = scene.camera(0)
    kinds = (wp.vec3, wp.vec2, wp.int32, wp.vec2, wp.vec2, wp.float32)
    out = [wp.zeros(len(film), dtype=kind, device="cpu") for kind in kinds]
    given = wp.array(film.astype(np.float32), dtype=wp.vec2, device="cpu")
    inputs = [scene.data(), camera, given, wp.vec2(*lens), wp.vec3(*v)]
    wp.launch(make_round_trip(camera.kind), len(film), inputs=inputs, outputs=out, device="cpu")
    return [a.numpy().astype(np.float64) for a in out]


def in_camera(points):
    """Points of the camera's space with OpenCV's axes."""
    local = (points - POSE.matrix[:3, 3]) @ POSE.matrix[:3, :3]
    return local * [-1.0, -1.0, 1.0]


@pytest.mark.slow_rows("opencv", "fisheye, thin lens")
@pytest.mark.parametrize("name", LENSES)
def test_rays_and_projection_are_inverse_and_have_the_formulas_positions(name):
    lens = LENSES[name]
    disk = (0.3, -0.2) if "thin" in name else (0.0, 0.0)
    film = np.random.default_rng(0).uniform(0.0, 1.0, (300, 2))
    point, again, valid, slope, gradient, area = trips(load(**lens), film, disk)
    assert valid.all()
    np.testing.assert_allclose(again * [WIDTH, HEIGHT], film * [WIDTH, HEIGHT], atol=ROUNDING)
    local = in_camera(point)
    # Through a lens, the point in focus on the same ray lies on the pinhole's.
    focus = lens.get("focus_distance", 1.0)
    start = lens.get("aperture_radius", 0.0) * np.array([-disk[0], -disk[1], 0.0])
    sharp = start + (local - start) * focus / local[:, 2:]
    expected = formulas(sharp[:, 0] / focus, sharp[:, 1] / focus, lens)
    np.testing.assert_allclose(film * [WIDTH, HEIGHT], expected, atol=ROUNDING)
    # The image of a moved point, by the same formulas.
    v, h = in_camera(POSE.matrix[:3, 3] + np.array([0.3, -0.5, 0.2])), 1e-5
    moved = []
    for sign in (1.0, -1.0):
        there = start + (local + sign * h * v - start) * focus / (local + sign * h * v)[:, 2:]
        moved.append(formulas(there[:, 0] / focus, there[:, 1] / focus, lens))
    np.testing.assert_allclose(slope, (moved[0] - moved[1]) / (2.0 * h), atol=1e-3)
    np.testing.assert_allclose(gradient, slope, atol=1e-4)
    np.testing.assert_allclose(area, 1.0, rtol=1e-4)


@pytest.mark.parametrize("name", ["opencv", "fisheye"])
def test_the_formulas_are_opencvs(name):
    cv2 = pytest.importorskip("cv2")
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (100, 1, 3)) * [1.0, 0.8, 0.0] + [0.0, 0.0, 1.0]
    lens = LENSES[name]
    f = 0.5 * WIDTH / np.tan(np.radians(0.5 * FOV))
    matrix = np.array([[f, 0.0, WIDTH * 0.47 - 0.5], [0.0, 1.1 * f, 0.5 * HEIGHT - 0.5], [0.0, 0.0, 1.0]])
    zero = np.zeros(3)
    if name == "fisheye":
        found = cv2.fisheye.projectPoints(points, zero, zero, matrix, np.array(list(FISHEYE.values())), alpha=0.05)[0]
    else:
        lens = {**lens, "skew": 0.0}  # cv2 does not read it
        found = cv2.projectPoints(points, zero, zero, matrix, np.array(list(OPENCV.values())))[0]
    # The centre of a pixel has whole numbers there.
    expected = formulas(points[:, 0, 0], points[:, 0, 1], lens) - 0.5
    np.testing.assert_allclose(found.reshape(-1, 2), expected, atol=ROUNDING)


@pytest.mark.parametrize("name", ["opencv", "fisheye"])
def test_undistorted_images_are_those_of_the_plain_camera(name):
    cv2 = pytest.importorskip("cv2")
    # A sky of slow waves: resampling it leaves no error to speak of.
    y, x = np.mgrid[0:64, 0:128] / 64.0
    sky = np.stack([1.0 + 0.5 * np.sin(2.0 * np.pi * (k * x + y)) for k in (2, 2, 3)], axis=-1).astype(np.float32)
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": FOV, "to_world": POSE, "film": film}
    lens = {"distortion": "opencv", **OPENCV} if name == "opencv" else {"distortion": "fisheye", **FISHEYE}
    plain, bent = (
        psdr.render(
            psdr.load_dict({"type": "scene", "sensor": sensor | more, "sky": {"type": "envmap", "data": sky}}),
            integrator=psdr.PathIntegrator(max_depth=1),
            spp=64,
        ).numpy()
        for more in ({}, lens)
    )
    f = 0.5 * WIDTH / np.tan(np.radians(0.5 * FOV))
    matrix = np.array([[f, 0.0, 0.5 * WIDTH - 0.5], [0.0, f, 0.5 * HEIGHT - 0.5], [0.0, 0.0, 1.0]])
    if name == "fisheye":
        found = cv2.fisheye.undistortImage(bent, matrix, np.array(list(FISHEYE.values())), Knew=matrix)
    else:
        found = cv2.undistort(bent, matrix, np.array(list(OPENCV.values())))
    inside = np.s_[8:-8, 8:-8]
    assert np.abs(bent - plain)[inside].max() > 0.1
    np.testing.assert_allclose(found[inside], plain[inside], atol=0.02)


def test_what_a_lens_folds_onto_the_film_is_not_seen():
    """Far beside the axis this polynomial turns back: a point there has an image on the film, and no ray."""
    scene = load(k1=-0.2, principal_point_offset_x=0.0)
    camera = scene.camera(0)
    project = make_projection(camera.kind)[0]

    @wp.kernel(module="unique", enable_backward=False)
    def seen(scene: Scene, camera: Camera, x: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.int32)):
        out[wp.tid()] = project(scene, camera, x[wp.tid()], wp.vec2(0.0, 0.0)).valid

    p = np.array([0.3, -0.3, 2.2, -2.2])  # 2.2 (1 - 0.2 2.2^2) is 0.07
    points = np.stack([p, 0.0 * p, 0.0 * p + 1.0], axis=1) @ POSE.matrix[:3, :3].T + POSE.matrix[:3, 3]
    out = wp.zeros(4, dtype=wp.int32, device="cpu")
    inputs = [scene.data(), camera, wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")]
    wp.launch(seen, 4, inputs=inputs, outputs=[out], device="cpu")
    assert out.numpy().tolist() == [1, 1, 0, 0]


@pytest.mark.parametrize("name", [pytest.param("fisheye, thin lens", marks=pytest.mark.slow), "opencv"])
def test_the_derivative_of_the_importance(name):
    """Light paths whose vertices move need the gradient of the logarithm, the area of the lens included."""
    scene, v, h = load(**LENSES[name]), np.array([0.3, -0.5, 0.2]), 1e-2
    camera = scene.camera(0)
    gradient, project = make_importance_gradient(camera.kind), make_projection(camera.kind)[0]

    @wp.kernel(module="unique", enable_backward=False)
    def importance(
        scene: Scene,
        camera: Camera,
        x: wp.array(dtype=wp.vec3),
        v: wp.vec3,
        h: wp.float32,
        out: wp.array(dtype=wp.vec2),
    ):
        i = wp.tid()
        lens = wp.vec2(0.3, -0.2)
        slope = wp.dot(gradient(scene, camera, project(scene, camera, x[i], lens), x[i]), v)
        above = project(scene, camera, x[i] + h * v, lens).per_area
        below = project(scene, camera, x[i] - h * v, lens).per_area
        out[i] = wp.vec2(slope, 0.5 * (wp.log(above) - wp.log(below)) / h)

    film = np.random.default_rng(3).uniform(0.1, 0.9, (100, 2))
    points = trips(scene, film, (0.3, -0.2))[0]
    out = wp.zeros(len(points), dtype=wp.vec2, device="cpu")
    places = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(
        importance, len(points), inputs=[scene.data(), camera, places, wp.vec3(*v), h], outputs=[out], device="cpu"
    )
    slope, difference = out.numpy().T
    np.testing.assert_allclose(slope, difference, atol=2e-3)
    assert np.abs(difference).max() > 0.1


#: Samples of a pixel, stratified by Sobol' points.
SPP = 128


def picture(n=9):
    """A smooth picture, which bilinear filters show alike."""
    u = np.linspace(0.0, 2.0 * np.pi, n)
    wave = 0.5 + 0.3 * np.sin(u)[:, None] * np.cos(1.3 * u)[None, :]
    return np.stack([wave, wave.T, 0.5 + 0.4 * np.cos(u)[:, None] * np.ones(n)], axis=-1).astype(np.float32)


def plane(sensor):
    """A picture that shines on a plane across the axis."""
    shines = {"type": "area", "radiance": {"type": "bitmap", "bitmap": picture(), "raw": True}}
    facing = psdr.Transform.translate([0.0, 0.0, 3.0]) @ psdr.Transform.rotate([0.0, 1.0, 0.0], 180.0)
    card = {"type": "rectangle", "to_world": facing @ psdr.Transform.scale(4.0), "emitter": shines}
    return psdr.load_dict({"type": "scene", "sensor": sensor, "card": card})


def test_an_image_is_the_undistorted_one_resampled():
    """Each pixel of a distorted image is where the formulas move it from in a fine image of the pinhole."""
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    wide, k = 8, np.tan(np.radians(0.5 * FOV))
    lens = {**OPENCV, **AFFINE, "principal_point_offset_x": 0.03}
    only = psdr.PathIntegrator(max_depth=1)
    distorted = plane({"type": "perspective", "fov": FOV, "film": film, **lens})
    found = psdr.render(distorted, integrator=only, spp=SPP, seed=0).numpy()
    # The pinhole's image, twice as wide as the film.
    size = (wide * WIDTH, wide * HEIGHT)
    fine = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    fov = float(np.degrees(2.0 * np.arctan(2.0 * k)))
    pinhole = plane({"type": "perspective", "fov": fov, "film": fine})
    image = psdr.render(pinhole, integrator=only, spp=4, seed=1).numpy().astype(np.float64)
    # Where points of each pixel come from, by the fixed-point iteration that OpenCV uses.
    sub = (np.arange(4) + 0.5) / 4.0
    v, u = np.meshgrid(
        (np.arange(HEIGHT)[:, None] + sub).reshape(-1), (np.arange(WIDTH)[:, None] + sub).reshape(-1), indexing="ij"
    )
    target = np.stack([u, v], axis=-1)
    x = np.zeros_like(target)
    f = 0.5 * WIDTH / k
    for _ in range(60):
        x += (target - formulas(x[..., 0], x[..., 1], lens)) / f * 0.8
    assert np.abs(target - formulas(x[..., 0], x[..., 1], lens)).max() < 1e-6
    column = (0.5 + 0.25 * x[..., 0] / k) * size[0] - 0.5
    row = 0.5 * size[1] + 0.25 * x[..., 1] / k * size[0] - 0.5
    a, b = np.floor(column).astype(int), np.floor(row).astype(int)
    s, t = (column - a)[..., None], (row - b)[..., None]
    expected = (1 - t) * ((1 - s) * image[b, a] + s * image[b, a + 1])
    expected += t * ((1 - s) * image[b + 1, a] + s * image[b + 1, a + 1])
    expected = expected.reshape(HEIGHT, 4, WIDTH, 4, 3).mean(axis=(1, 3))
    apart = np.abs(found - expected)
    assert apart.max() < 0.01 and np.ptp(expected) > 0.5
    # Without the lens they are far apart.
    straight = plane({"type": "perspective", "fov": FOV, "film": film})
    assert np.abs(psdr.render(straight, integrator=only, spp=SPP, seed=0).numpy() - expected).max() > 0.1


def test_a_lens_without_distortion_shows_what_a_pinhole_shows():
    """With zeros the same samples take the same rays, but for rounding."""
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    only = psdr.PathIntegrator(max_depth=1)
    images = []
    for more in ({}, {"distortion": "opencv"}):
        scene = plane({"type": "perspective", "fov": FOV, "film": film, **more})
        images.append(psdr.render(scene, integrator=only, spp=4, seed=3).numpy())
    np.testing.assert_allclose(images[1], images[0], atol=1e-4)


@pytest.mark.slow
def test_light_paths_find_the_film_through_a_lens():
    """Light tracing splats where camera rays come from, and with the camera's importance."""
    film = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 70.0, "film": film, "k1": -0.1, "k2": 0.05, "p1": 0.02, **AFFINE}
    floor = psdr.Transform.translate([0.0, 0.0, 3.0]) @ psdr.Transform.rotate([0.0, 1.0, 0.0], 180.0)
    parts = {
        "sensor": sensor,
        "floor": {"type": "rectangle", "to_world": floor @ psdr.Transform.scale(5.0)},
        "bulb": {"type": "point", "position": [0.5, -0.3, 1.5], "intensity": {"type": "rgb", "value": 5.0}},
    }
    scene = psdr.load_dict({"type": "scene", **parts})
    methods = ({}, {"interior": psdr.interior.LightTracing()})
    images = []
    for more in methods:
        integrator = psdr.PathIntegrator(max_depth=2, boundary=None, **more)
        images.append(
            np.stack([psdr.render(scene, integrator=integrator, spp=256, seed=s).numpy() for s in range(8)]).astype(
                np.float64
            )
        )
    assert images[0].mean() > 0.01
    assert_same_mean(images[0].reshape(8, -1, 3), images[1].reshape(8, -1, 3), "light paths")


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"k1": -0.8}, "'opencv' distortion folds"),
        ({"distortion": "fisheye", "fov": 160.0}, "'fisheye' distortion folds, or has no ray"),
        ({"distortion": "fisheye", "fov": 94.7}, "85 degrees beside the axis"),
        ({"distortion": "fisheye", "k5": 0.1}, "parameter 'k5'.*k1, k2, k3, k4"),
        ({"distortion": "brown"}, "opencv, fisheye"),
        ({"k1": "much"}, "parameter 'k1'.*give one number"),
        ({"pixel_aspect": 0.0}, "pixel_aspect"),
        ({"skew": float("nan")}, "skew"),
        ({"type": "orthographic", "fov": None, "k1": 0.1, "principal_point_offset_x": None}, "k1"),
    ],
)
def test_wrong_lenses_are_refused(parameters, message):
    film = {"type": "hdrfilm", "width": WIDTH, "height": WIDTH}
    sensor = {"type": "perspective", "fov": FOV, "film": film} | parameters
    sensor = {name: value for name, value in sensor.items() if value is not None}
    with pytest.raises(ValueError, match=message):
        psdr.load_dict({"type": "scene", "sensor": sensor, "sky": {"type": "constant"}})


def test_a_projector_takes_no_distortion():
    beam = {"type": "projector", "irradiance": {"type": "rgb", "value": 1.0}, "k1": 0.1}
    with pytest.raises(ValueError, match="k1"):
        psdr.load_dict({"type": "scene", "beam": beam})


def test_an_edit_that_folds_the_film_is_refused():
    scene = load(k1=-0.1)
    params = psdr.traverse(scene)
    params["sensor.k1"] = -0.8
    params.update()
    with pytest.raises(ValueError, match="'sensor': with the values of its parameters the 'opencv' distortion folds"):
        psdr.plan(scene)
    params["sensor.k1"] = -0.1
    params.update()
    assert "Newton" in str(psdr.plan(scene))


def test_film_antithetic_names_what_to_do():
    scene = load(k1=-0.1)
    params = psdr.traverse(scene)
    params.requires_grad("sensor.k1")
    integrator = psdr.PathIntegrator(interior=psdr.interior.FilmAntithetic())
    with pytest.raises(ValueError, match=r"a camera with 'distortion'.*undistort the photograph"):
        psdr.plan(scene, params, integrator=integrator)
