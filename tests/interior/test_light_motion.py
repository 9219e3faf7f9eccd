"""Light paths whose vertices move: caustics by indices, lights, glass and what they light; and what is refused."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.interior.test_light_tracing import MODES, reverse
from tests.path.helpers import assert_mean
from tests.path.test_light_tracing import (
    BATCHES,
    HEIGHT_ABOVE,
    IOR,
    LIGHT_TRACING,
    POINT,
    ball,
    camera_of,
    lamp,
    refracted_radiance,
    rgb,
    room,
    texels,
    under_water,
)
from warp_psdr.kernels.sensor.film import GAUSSIAN_CUT, GAUSSIAN_FLOOR

T = psdr.Transform
#: Standard deviation of the default filter [pixels].
STDDEV = 0.5
#: Steps of the closed form's differences.
STEP = 1e-3


def through_filter(radiance, size=8, fine=16):
    """Pixels under a Gaussian filter of a film with ``sample_border``, which spans (-1, 1) twice."""
    beyond = int(np.ceil(GAUSSIAN_CUT * STDDEV))
    at = (np.arange((size + 2 * beyond) * fine) + 0.5) / fine - beyond
    z = (at[None, :] - np.arange(size)[:, None] - 0.5) / STDDEV
    weights = np.where(np.abs(z) < GAUSSIAN_CUT, np.exp(-0.5 * z * z) - GAUSSIAN_FLOOR, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    places = at / size * 2.0 - 1.0
    return weights @ radiance(*np.meshgrid(places, places)) @ weights.T


def shallow(size=8):
    described = under_water(size)
    described["camera"]["film"] |= {"rfilter": {"type": "gaussian"}, "sample_border": True}
    return described


def slope_of(name, value):
    """The closed form's derivative."""
    ends = [
        through_filter(lambda x, y, a=a: refracted_radiance(x, y, **{name: a})) for a in (value + STEP, value - STEP)
    ]
    return (ends[0] - ends[1]) / (2.0 * STEP)


def test_derivatives_of_refracted_light_are_those_of_its_closed_form():
    """By the index and by the height of the light, both modes."""
    scene = psdr.load_dict(shallow())
    params = psdr.traverse(scene)
    integrator = psdr.PathIntegrator(max_depth=3, interior=LIGHT_TRACING, boundary=None)
    upwards = np.array([0.0, 0.0, 1.0], np.float32)
    tangents = {"surface.bsdf.eta": 1.0, "light.position": upwards}
    expected = {"surface.bsdf.eta": slope_of("ior", IOR), "light.position": slope_of("above", HEIGHT_ABOVE)}
    rows = np.linspace(1.0, 2.0, 64).reshape(8, 8, 1)
    adjoint = np.broadcast_to(rows, (8, 8, 3)).astype(np.float32)
    backward = reverse(scene, params, adjoint, list(tangents), integrator=integrator, spp=512, seed=0)
    for (name, tangent), gradient in zip(tangents.items(), backward, strict=True):
        along = {other: value * (other == name) for other, value in tangents.items()}
        found = [
            psdr.render_forward(scene, params, along, integrator=integrator, spp=512, seed=i).numpy()
            for i in range(BATCHES)
        ]
        found = np.array(found, np.float64)
        assert_mean(found[..., 0], expected[name], name)
        total = (found[0] * adjoint).sum()
        assert np.sum(gradient * tangent) == pytest.approx(total, rel=MODES), name
        assert found[..., 0].mean() == pytest.approx(expected[name].mean(), rel=0.02), name


GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
AIM = T.look_at([-1.2, 0.0, 2.2], [0.0, 0.0, 0.7], [0.0, 0.0, 1.0])
NARROW = {"type": "spot", "to_world": AIM, "intensity": rgb(3.0, 2.0, 1.0), "cutoff_angle": 9.0, "beam_width": 3.0}
BORDERED = np.pad(texels(2, 4, 5)["bitmap"], ((1, 1), (1, 1), (0, 0)))
SLIDE = {
    "type": "projector",
    "to_world": AIM,
    "fov": 12.0,
    "irradiance": {"type": "bitmap", "bitmap": BORDERED, "raw": True},
    "scale": 3.0,
}
VIEW = T.look_at([1.6, -2.6, 2.2], [0.45, 0.0, 0.0], [0.0, 0.0, 1.0])
SIZE = 24
WALL = {
    "type": "rectangle",
    "to_world": T.translate([-1.6, 0.0, 1.0]) @ T.rotate([0.0, 1.0, 0.0], 90.0) @ T.scale(2.0),
    "bsdf": {"type": "diffuse", "reflectance": 0.9},
}


def caustic(light, bsdf=GLASS, **camera):
    """A ball in a narrow beam over a floor."""
    ball_in_beam = {"type": "sphere", "center": [0.0, 0.0, 0.7], "radius": 0.4, "bsdf": bsdf}
    described = room(camera_of(size=SIZE, **{"to_world": VIEW, "fov": 40.0, **camera}), ball=ball_in_beam, light=light)
    for name in ("wall", "glossy", "matte"):
        del described[name]
    return described


def turned():
    """Velocity of the pose under a turn about y."""
    about = np.zeros((4, 4))
    about[0, 2], about[2, 0] = 1.0, -1.0
    return about @ np.asarray(AIM.matrix, np.float64)


def shifted():
    """Velocity of the pose along x."""
    along = np.zeros((4, 4))
    along[0, 3] = 1.0
    return along


def mirrored():
    """What a ball reflects onto a wall."""
    described = caustic(
        NARROW, {"type": "conductor"}, to_world=T.look_at([1.6, -2.6, 2.2], [-1.6, 0.0, 1.3], [0, 0, 1])
    )
    return {**described, "wall": WALL}


X = np.array([1.0, 0.0, 0.0])
LENS = {"type": "thinlens", "aperture_radius": 0.05, "focus_distance": 3.0}
BENT = {"k1": 2.0, "k2": 3.0, "p1": 0.2, "pixel_aspect": 1.2, "skew": 0.1}
#: Scene, parameter, its velocity (one vector for all vertices), step.
ROWS = {
    "index": (lambda: caustic(NARROW), "ball.bsdf.eta", 1.0, 0.004),
    "index, thin lens": (lambda: caustic(NARROW, **LENS), "ball.bsdf.eta", 1.0, 0.004),
    "index, distortion": (lambda: caustic(NARROW, **BENT), "ball.bsdf.eta", 1.0, 0.004),
    "spot, x": (lambda: caustic(NARROW), "light.to_world", shifted(), 0.01),
    "spot, turn": (lambda: caustic(NARROW), "light.to_world", turned(), 0.004),
    "projector, turn": (lambda: caustic(SLIDE), "light.to_world", turned(), 0.004),
    "ball, x": (lambda: caustic(NARROW), "ball.vertex_positions", X, 0.004),
    "floor, z": (lambda: caustic(NARROW), "floor.vertex_positions", np.array([0.0, 0.0, 1.0]), 0.001),
    "mirror, x": (mirrored, "ball.vertex_positions", X, 0.004),
}


def around_peak(image):
    """Weights that fall to zero around the brightest pixel: nothing else is in them."""
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    i, j = np.unravel_index(image.sum(axis=-1).argmax(), (SIZE, SIZE))
    near = np.maximum(1.0 - ((x - j) ** 2 + (y - i) ** 2) / 16.0, 0.0) ** 2
    return (near * (1.0 + 0.3 * np.sin(x / 3.0)))[..., None].astype(np.float32) * np.float32([1.0, 0.8, 0.6])


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
def test_slopes_of_caustics_are_one(row):
    """Against differences of images of equal seeds, and the modes against each other."""
    described, name, velocity, step = ROWS[row]
    scene = psdr.load_dict(described())
    params = psdr.traverse(scene)
    integrator = psdr.PathIntegrator(max_depth=4, interior=LIGHT_TRACING, boundary=None)
    adjoint = around_peak(psdr.render(scene, integrator=integrator, spp=64, seed=99).numpy())
    values = params[name].numpy().copy()
    velocity = np.broadcast_to(velocity, values.shape).astype(np.float32)

    def weighed(image):
        return (image.numpy().astype(np.float64) * adjoint).sum()

    differences, slopes = [], []
    for seed in range(4):
        ends = []
        for sign in (1.0, -1.0):
            params[name] = values + sign * step * velocity
            params.update()
            ends.append(weighed(psdr.render(scene, integrator=integrator, spp=1024, seed=seed)))
        params[name] = values
        params.update()
        differences.append((ends[0] - ends[1]) / (2.0 * step))
        slopes.append(
            weighed(psdr.render_forward(scene, params, {name: velocity}, integrator=integrator, spp=512, seed=seed))
        )
    (gradient,) = reverse(scene, params, adjoint, [name], integrator=integrator, spp=512, seed=0)
    assert (gradient * velocity).sum() == pytest.approx(slopes[0], rel=MODES)
    error = np.hypot(np.std(differences, ddof=1), np.std(slopes, ddof=1)) / 2.0 / abs(np.mean(differences))
    assert error < 0.02
    assert np.mean(slopes) / np.mean(differences) == pytest.approx(1.0, abs=0.02 + 2.0 * error)


@pytest.mark.slow
def test_where_light_paths_join_they_are_those_of_light_tracing():
    """By the index of a lens over a floor: what joined paths add to the camera's is what light tracing draws."""
    scene = psdr.load_dict(shallow())
    params = psdr.traverse(scene)
    ways = {
        "joined": psdr.PathIntegrator(max_depth=3, boundary=None, caustics=True),
        "light paths": psdr.PathIntegrator(max_depth=3, boundary=None, interior=LIGHT_TRACING),
    }
    found = {
        way: np.array(
            [
                psdr.render_forward(
                    scene, params, {"surface.bsdf.eta": 1.0}, integrator=integrator, spp=128, seed=i
                ).numpy()
                for i in range(BATCHES)
            ],
            np.float64,
        )[..., 0]
        for way, integrator in ways.items()
    }
    for way, images in found.items():
        assert_mean(images, slope_of("ior", IOR), way)


def test_what_it_does_not_follow_is_refused_by_name():
    scene = psdr.load_dict(room(point=POINT, lamp=lamp(), matte=ball([-0.5, -0.3, 0.6], **GLASS)))

    def refused(match, name, scene=scene, **options):
        options = {"max_depth": 5, "boundary": None, **options}
        integrator = psdr.PathIntegrator(interior=LIGHT_TRACING, **options)
        with pytest.raises(ValueError, match=match):
            psdr.plan(scene, names=[name], integrator=integrator)

    for name in ("floor.vertex_positions", "matte.bsdf.eta", "matte.to_world", "point.position"):
        integrator = psdr.PathIntegrator(max_depth=5, interior=LIGHT_TRACING, boundary=None)
        assert "their vertices move" in str(psdr.plan(scene, names=[name], integrator=integrator))
        refused(r"no boundary term.*boundary=None.*small sphere.*PathSpace", name, boundary="auto")
    refused(r"by the camera; use interior\.Replay", "camera.to_world")
    refused(r"shape of a light, 'lamp'; use interior\.Replay", "lamp.vertex_positions")
    slides = room(slide={**SLIDE, "irradiance": texels(2, 4, 5)}, matte=ball([-0.5, -0.3, 0.6], **GLASS))
    refused(
        r"does not move 'slide': a projector's image ends in a hard edge.*black",
        "slide.to_world",
        psdr.load_dict(slides),
    )
    for depth in (-1, 65):
        refused(rf"max_depth: got {depth}, expected 1 to 64", "floor.vertex_positions", max_depth=depth)
    boxed = psdr.load_dict(room(camera_of("box"), point=POINT))
    refused(r"without steps.*'gaussian' or 'tent'", "floor.vertex_positions", boxed)
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    metered = room(point=POINT)
    metered["floor"]["meter"] = {"type": "irradiancemeter", "film": film}
    del metered["camera"]
    refused(r"before an 'irradiancemeter'", "wall.vertex_positions", psdr.load_dict(metered))
