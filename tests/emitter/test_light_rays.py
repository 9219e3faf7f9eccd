"""Rays that leave lights: chi-square tests of places and directions, and the densities that their flux is over."""

import functools

import numpy as np
import pytest
import warp as wp
from scipy import stats

import warp_psdr as psdr
from warp_psdr.estimate.light import bounding_sphere
from warp_psdr.kernels.light_ray import make_light_ray
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig

T = psdr.Transform
SIGNIFICANCE = 1e-5
SAMPLES, CELLS = 400_000, 12
#: Float32 of directions and of the inverse densities.
ROUNDING = 1e-4
CUTOFF, FOV = 35.0, 50.0
LAMP = T.translate([0.3, -0.2, 2.0]) @ T.rotate([1.0, 0.4, 0.0], 160.0) @ T.scale([0.5, 0.3, 1.0])
POSE = T.look_at([1.0, -1.0, 2.0], [0.0, 0.2, 0.1], [0.0, 0.0, 1.0])
BEAM = T.translate([-0.5, 0.4, 1.5]) @ T.rotate([0.0, 1.0, 0.3], 150.0) @ T.scale([0.3, 0.2, 1.0])
IMAGE = np.ones((4, 6, 3), np.float32)
LIGHTS = {
    "area": {"type": "rectangle", "to_world": LAMP, "emitter": {"type": "area", "radiance": 1.0}},
    "point": {"type": "point", "position": [0.5, 0.5, 1.0], "intensity": 2.0},
    "spot": {"type": "spot", "to_world": POSE, "cutoff_angle": CUTOFF, "intensity": 3.0},
    "projector": {
        "type": "projector",
        "to_world": POSE,
        "fov": FOV,
        "irradiance": {"type": "bitmap", "bitmap": IMAGE, "raw": True},
    },
    "beam": {"type": "rectangle", "to_world": BEAM, "emitter": {"type": "directionalarea", "radiance": 1.0}},
    "sun": {"type": "directional", "direction": [0.3, 0.2, -1.0], "irradiance": 1.0},
    "sky": {"type": "constant", "radiance": 0.5},
}


@functools.cache
def make_draw(config: PathConfig) -> wp.Kernel:
    light_ray = make_light_ray(config.lights)

    @wp.kernel(module="unique", enable_backward=False)
    def draw(
        scene: Scene,
        sphere: wp.vec4,
        u4: wp.array(dtype=wp.vec4),
        u2: wp.array(dtype=wp.vec2),
        emitter_out: wp.array(dtype=wp.int32),
        o_out: wp.array(dtype=wp.vec3),
        d_out: wp.array(dtype=wp.vec3),
        scale_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        ray = light_ray(scene, sphere, u4[i], u2[i])
        emitter_out[i] = ray.emitter
        o_out[i] = ray.o
        d_out[i] = ray.d
        scale_out[i] = ray.scale

    return draw


@functools.cache
def drawn():
    """Return the sphere around the scene; of each light its probability, origins, directions and inverse densities."""
    floor = {"type": "rectangle", "to_world": T.scale(2.0)}
    scene = psdr.load_dict({"type": "scene", "camera": {"type": "perspective"}, "floor": floor, **LIGHTS})
    random = np.random.default_rng(7)
    count = SAMPLES * len(LIGHTS)
    u4 = wp.array(random.random((count, 4), dtype=np.float32), dtype=wp.vec4, device=scene.device)
    u2 = wp.array(random.random((count, 2), dtype=np.float32), dtype=wp.vec2, device=scene.device)
    out = [wp.zeros(count, dtype=t, device=scene.device) for t in (wp.int32, wp.vec3, wp.vec3, wp.float32)]
    sphere = bounding_sphere(scene)
    data = scene.data()
    wp.launch(
        make_draw(psdr.plan(scene).config), dim=count, inputs=[data, sphere, u4, u2], outputs=out, device=scene.device
    )
    emitter, o, d, scale = (x.numpy() for x in out)
    probabilities = data.emitters.numpy()["probability"].astype(np.float64)
    found = {}
    for number, described in enumerate(scene.description.emitters):
        name = described.path.removesuffix(".emitter")
        of_light = emitter == number
        found[name] = (
            probabilities[number],
            o[of_light].astype(np.float64),
            d[of_light].astype(np.float64),
            scale[of_light].astype(np.float64) * probabilities[number],
        )
    return np.array(sphere), count, found


def assert_uniform(first, second, what):
    """Chi-square over cells of the unit square."""
    counts = np.histogram2d(first, second, bins=CELLS, range=[[0.0, 1.0], [0.0, 1.0]])[0]
    outside = len(first) - counts.sum()
    assert outside <= 1e-4 * len(first), (what, outside)  # rounding at the border
    assert stats.chisquare(counts.ravel()).pvalue > SIGNIFICANCE, what


def around(axis, d):
    """Return the cosines about an axis, and turns in [0, 1]."""
    axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    s = np.cross(axis, [0.3, 0.5, 0.8])
    s /= np.linalg.norm(s)
    return d @ axis, np.arctan2(d @ np.cross(axis, s), d @ s) / (2.0 * np.pi) % 1.0


def test_a_light_is_chosen_with_its_probability():
    _sphere, count, found = drawn()
    assert set(found) == set(LIGHTS)
    counts = np.array([len(o) for _p, o, _d, _scale in found.values()])
    expected = np.array([p for p, *_rest in found.values()]) * count
    assert counts.sum() == count and counts.min() > 1000
    assert stats.chisquare(counts, expected * count / expected.sum()).pvalue > SIGNIFICANCE


@pytest.mark.parametrize("name", ["area", "beam"])
def test_places_on_shapes_are_uniform(name):
    _sphere, _count, found = drawn()
    _p, o, d, inverse = found[name]
    pose = (LAMP if name == "area" else BEAM).matrix
    at = (np.c_[o, np.ones(len(o))] @ np.linalg.inv(pose).T)[:, :2]
    assert_uniform(*(0.5 + 0.5 * at).T, name)
    area = 4.0 * np.linalg.norm(np.cross(pose[:3, 0], pose[:3, 1]))
    if name == "area":
        cosine, turn = around(np.cross(pose[:3, 0], pose[:3, 1]), d)
        assert_uniform(cosine**2, turn, "directions by their cosine")
        np.testing.assert_allclose(inverse, np.pi * area, rtol=ROUNDING)
    else:
        np.testing.assert_allclose(d, np.broadcast_to(d[0], d.shape), atol=ROUNDING)
        np.testing.assert_allclose(inverse, area, rtol=ROUNDING)


def test_directions_of_points_spots_and_projectors_are_uniform_in_their_measure():
    _sphere, _count, found = drawn()
    _p, _o, d, inverse = found["point"]
    cosine, turn = around([0.2, 0.3, 1.0], d)
    assert_uniform(0.5 * (1.0 - cosine), turn, "point")
    np.testing.assert_allclose(inverse, 4.0 * np.pi, rtol=ROUNDING)
    _p, _o, d, inverse = found["spot"]
    height = 1.0 - np.cos(np.radians(CUTOFF))
    cosine, turn = around(POSE.matrix[:3, 2], d)
    assert_uniform((1.0 - cosine) / height, turn, "spot")
    np.testing.assert_allclose(inverse, 2.0 * np.pi * height, rtol=ROUNDING)
    _p, _o, d, inverse = found["projector"]
    local = d @ POSE.matrix[:3, :3]
    t = np.tan(np.radians(0.5 * FOV))
    s = t * IMAGE.shape[0] / IMAGE.shape[1]
    assert_uniform(0.5 + 0.5 * local[:, 0] / (local[:, 2] * t), 0.5 + 0.5 * local[:, 1] / (local[:, 2] * s), "frame")
    np.testing.assert_allclose(inverse, 4.0 * t * s * local[:, 2] ** 3, rtol=ROUNDING)
    # Of a pyramid; the mean of the inverse density is its solid angle.
    solid = 4.0 * np.arcsin(t * s / np.sqrt((1.0 + t * t) * (1.0 + s * s)))
    assert abs(inverse.mean() - solid) < 5.0 * inverse.std() / np.sqrt(len(inverse))


@pytest.mark.parametrize("name", ["sun", "sky"])
def test_light_from_infinity_covers_the_scene(name):
    sphere, _count, found = drawn()
    _p, o, d, inverse = found[name]
    disk = np.pi * sphere[3] ** 2
    away = o - sphere[:3]
    np.testing.assert_allclose((away * d).sum(axis=1), -sphere[3], rtol=ROUNDING)
    across = away - (away * d).sum(axis=1, keepdims=True) * d
    radius = (across**2).sum(axis=1) / sphere[3] ** 2
    if name == "sun":
        _cosine, turn = around(d.mean(axis=0), across)
        assert_uniform(radius, turn, "disk")
        np.testing.assert_allclose(inverse, disk, rtol=ROUNDING)
    else:
        cosine, turn = around([0.2, 0.3, 1.0], d)
        assert_uniform(0.5 * (1.0 - cosine), turn, "sky")
        assert_uniform(radius, turn, "disk for each direction")
        np.testing.assert_allclose(inverse, disk * 4.0 * np.pi, rtol=ROUNDING)
