"""Differential radiative transfer: quadratures of light that is scattered once, finite differences, and replay's mean.

Every scene has the same kinds of things in it, so that all share their kernels.
"""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients import measure
from tests.gradients.configs import shift, widen
from tests.media.scenes import BLACK, T, camera, cube, medium, point, rgb, sky, square, whole
from tests.media.test_motion import glowing_room_scene, slab_scene
from tests.path.helpers import assert_mean, assert_same_mean
from warp_psdr.estimate.passes import camera_gradient_kernels

METHOD = psdr.interior.RadiativeTransfer()
BATCHES, SIZE = 8, 2
#: Extinction and albedo of the fog, which fills the cube from -1 to 1.
SIGMA, A = 0.7, 0.8
#: Half the side of a square that shines, and where it is.
HALF, PLACE = 0.6, 0.4
#: Half the sides of a black rectangle, and where it is.
SIDES, POSE = (0.4, 0.3), T.translate([0.1, 0.05, 0.5]) @ T.rotate([0.3, 1.0, 0.0], 25.0)
#: Absorbs the width of the camera, relative.
WIDTH = 2e-3
#: Standard errors that means may be apart, and the largest relative error of a comparison.
Z, NOISE = 4.0, 0.05


def fog_scene(radiance=1.0, lamp=None, leaf=None, paint=BLACK, fog=None, fov=0.05, **more):
    """Fog under a sky, seen along +y through the middle; a lamp that faces the camera, and a leaf above the ray."""
    light = {"type": "area", "radiance": 0.0 if lamp is None else lamp}
    facing = T.rotate([1, 0, 0], 90.0) @ T.scale(HALF)
    pose = T.translate([0, 9, -9]) if lamp is None else T.translate([0, PLACE, 0])
    return whole(
        sensor=camera([0, -6, 0], [0, 0, 0], fov, SIZE),
        fog=cube(fog or medium(SIGMA, A)),
        lamp={"type": "rectangle", "to_world": pose @ facing, "bsdf": paint, "emitter": light},
        leaf={
            "type": "rectangle",
            "to_world": (POSE if leaf is None else leaf) @ T.scale([*SIDES, 1.0]),
            "bsdf": {"type": "twosided", "bsdf": paint},
        },
        sky=sky(*3 * [radiance]),
        **more,
    )


def gradients(scene, name, depth, spp, method=METHOD, boundary="auto"):
    """Return the gradient of the mean of the image, one a batch: (BATCHES, n)."""
    params = psdr.traverse(scene)
    params.requires_grad_only(name)
    record = scene.camera(0)
    adjoint = np.full((record.crop_height, record.crop_width, 3), 1.0, np.float32)
    adjoint /= adjoint.size
    integrator = psdr.PathIntegrator(max_depth=depth, rr_depth=measure.NO_ROULETTE, interior=method, boundary=boundary)
    found = []
    for seed in range(BATCHES):
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=seed)
        found.append(params[name].grad.numpy().astype(np.float64).ravel())
    return np.array(found)


def gauss(low, high, n=24):
    """Return points and weights of a quadrature."""
    x, w = np.polynomial.legendre.leggauss(n)
    return 0.5 * (low + high) + 0.5 * (high - low) * x, 0.5 * (high - low) * w


def hidden(pose):
    """Return the radiance that a black rectangle with a 4 x 4 pose hides from the ray: sky, scattered once."""
    t, w_t = gauss(0.0, 2.0)
    u, w_u = gauss(-1.0, 1.0, 96)  # beyond it the edges of the fog are seen
    a, b = np.meshgrid(u, u, indexing="ij")
    y = pose[:3, 3] + a[..., None] * pose[:3, 0] + b[..., None] * pose[:3, 1]
    normal = np.cross(pose[:3, 0], pose[:3, 1])  # of an element du dv
    x = np.stack([0.0 * t, t - 1.0, 0.0 * t], axis=-1)[:, None, None]
    r = y - x
    d = np.linalg.norm(r, axis=-1)
    w = r / d[..., None]
    out = np.min((np.sign(w) - x) / np.where(w == 0.0, 1e-30, w), axis=-1)  # way to the border of the fog
    seen = np.exp(-SIGMA * out) * np.abs(w @ normal) / d**2
    return A * SIGMA / (4.0 * np.pi) * (w_t * np.exp(-SIGMA * t)) @ (seen @ w_u @ w_u)


def shone(place):
    """Return the radiance that a square which shines sends along the ray, straight on and scattered once."""
    s = place + 1.0
    t, w_t = gauss(0.0, s, 60)
    f, w_f = gauss(0.0, np.pi / 4.0)
    h = s - t[:, None]
    edge = h / np.sqrt(h**2 + (HALF / np.cos(f)) ** 2)
    v, w_v = gauss(0.0, 1.0)
    mu = edge[..., None] + (1.0 - edge[..., None]) * v
    inner = ((1.0 - edge[..., None]) * np.exp(-SIGMA * h[..., None] / mu)) @ w_v @ w_f * 8.0
    return np.exp(-SIGMA * s) + A * SIGMA / (4.0 * np.pi) * (w_t * np.exp(-SIGMA * t)) @ inner


#: The angular velocity of a rectangle that turns.
SPIN = np.array([[0.0, -0.2, 1.0], [0.2, 0.0, 0.3], [-1.0, -0.3, 0.0]])


def turning(pose):
    """Return the motion of a rectangle that turns about one of its corners."""
    moved = np.zeros((4, 4))
    about = pose[:3, 3] - pose[:3, 0] - pose[:3, 1]
    moved[:3] = SPIN @ pose[:3]
    moved[:3, 3] = SPIN @ (pose[:3, 3] - about)
    return moved


#: Along its normal, in its plane, turned, scaled.
MOTIONS = {
    "normal": lambda pose: np.outer(pose[:, 2], [0, 0, 0, 1.0]),
    "in plane": lambda pose: np.outer(pose[:, 0], [0, 0, 0, 1.0]),
    "turned": turning,
    "scaled": lambda pose: pose * np.array([1.0, 1.0, 0.0, 0.0]),
}


def test_an_occluder_in_fog_under_a_sky():
    """Light scattered once, against a quadrature over the rectangle: edges that points of the medium see."""
    pose = (POSE @ T.scale([*SIDES, 1.0])).matrix
    found = gradients(psdr.load_dict(fog_scene()), "leaf.to_world", 2, 12288)
    for name, motion in MOTIONS.items():
        tangent, h = motion(pose), 1e-4
        expected = -(hidden(pose + h * tangent) - hidden(pose - h * tangent)) / (2.0 * h)
        values = found @ tangent.ravel()
        error = values.std(ddof=1) / np.sqrt(BATCHES)
        assert abs(values.mean() - expected) <= Z * error + WIDTH * abs(expected), (
            name,
            values.mean(),
            expected,
            error,
        )
        assert error <= NOISE * abs(expected), (name, error, expected)


def test_a_shining_wall_recedes_behind_fog():
    """Transmittance, moving ends and the wall's edges, against a quadrature."""
    scene = psdr.load_dict(fog_scene(0.0, 1.0, T.translate([0, -9, 9])))
    found = gradients(scene, "lamp.to_world", 2, 4096)[:, 7]
    expected = (shone(PLACE + 1e-4) - shone(PLACE - 1e-4)) / 2e-4
    assert_mean(found[:, None], np.array([expected]), "receding wall", WIDTH)
    assert found.std(ddof=1) / np.sqrt(BATCHES) <= 0.005 * abs(expected)


def test_what_moves_nothing_is_replayed():
    """The kernel is that of replay, and so are all of its bits."""
    scene = psdr.load_dict(fog_scene())
    names = ["fog.interior_medium.sigma_t.value.value", "fog.interior_medium.albedo.value.value", "sky.radiance.value"]
    found = [
        camera_gradient_kernels(
            psdr.plan(scene, names=names, integrator=psdr.PathIntegrator(max_depth=3, interior=method)), "reverse"
        )
        for method in (METHOD, psdr.interior.Replay())
    ]
    assert found[0] == found[1] and len(found[0]) == 1


GREY = {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.3)}
COLOURS = medium((0.8, 0.6, 1.0), (0.9, 0.8, 0.7), g=0.4)
#: A leaf, and how far the camera opens, so that its edges, those of the lamp and all of the fog are on the film.
SEEN = {"leaf": T.translate([0.2, -0.4, 0.1]) @ T.rotate([1.0, 0.3, 0.0], 70.0), "fov": 20.0}
#: What moves, how, and the scene: under a sky, some beside a lamp.
MOVES = {
    "leaf, normal": ("leaf.to_world", shift(0.42, 0.0, 0.91), {}),
    "leaf, in plane": ("leaf.to_world", shift(0.91, 0.1, -0.42), {"lamp": 1.0}),
    "leaf, turned": ("leaf.to_world", turning, {}),
    "leaf, seen": ("leaf.to_world", MOTIONS["scaled"], {"lamp": 1.0, **SEEN}),
    "wall": ("lamp.to_world", shift(0.0, 1.0, 0.0), {"lamp": 1.0}),
    "wall, seen": ("lamp.to_world", shift(0.0, 1.0, 0.2), {"lamp": 1.0, **SEEN}),
    "fog": ("fog.to_world", shift(0.2, 0.3, 1.0), {"lamp": 1.0}),
}


@pytest.mark.slow
@pytest.mark.parametrize("move", MOVES)
def test_derivative_equals_finite_differences(move):
    """Light scattered up to three times, on surfaces and in fog, from the same random numbers on both sides."""
    name, motion, options = MOVES[move]
    scene = psdr.load_dict(fog_scene(paint=GREY, fog=COLOURS, **options))
    params = psdr.traverse(scene)
    values = params[name].numpy()
    tangent = motion(values.reshape(params[name].shape)).reshape(values.shape)
    found = gradients(scene, name, 3, 32768) @ tangent.ravel()
    with measure.shared_random_numbers():
        expected = np.array(
            [measure.difference(scene, params, name, tangent, 0.02, 3, 1 << 17, 100 + i).mean() for i in range(BATCHES)]
        )
    error = np.hypot(found.std(ddof=1), expected.std(ddof=1)) / np.sqrt(BATCHES)
    gap, scale = abs(found.mean() - expected.mean()), abs(expected.mean())
    assert gap <= Z * error, (found.mean(), expected.mean(), error)
    assert error <= NOISE * scale, (found.mean(), expected.mean(), error)


def meter(parts):
    """Return a scene whose camera is one ray, which sees no edge."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    kept = {k: v for k, v in parts["sensor"].items() if k in ("to_world", "medium")}
    return {**parts, "sensor": {"type": "radiancemeter", "film": film, **kept}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parts", "name", "motion", "edges", "spp"),
    [
        (slab_scene(), "floor.to_world", shift(0, 0, 1), False, 256),
        (slab_scene(), "slab.to_world", shift(0, 0, 1), False, 256),
        (slab_scene(), "sensor.to_world", shift(0, 0, 1), False, 256),
        (meter(glowing_room_scene()), "room.to_world", widen, True, 8192),
    ],
    ids=["floor", "slab", "camera", "room"],
)
def test_it_estimates_what_replay_does(parts, name, motion, edges, spp):
    """Where nothing hides anything: fixed directions against rides along rays. Of a room corners are edges."""
    scene = psdr.load_dict(whole(**parts))
    tangent = motion(psdr.traverse(scene)[name].numpy().reshape(psdr.traverse(scene)[name].shape)).ravel()
    method = psdr.interior.RadiativeTransfer(edges=edges)
    found = gradients(scene, name, 3, spp, method) @ tangent
    expected = gradients(scene, name, 3, spp, psdr.interior.Replay(), None) @ tangent
    assert_same_mean(found[:, None], expected[:, None], name)
    assert found.std(ddof=1) <= NOISE * abs(found.mean())


@pytest.mark.slow
def test_forward_and_reverse_mode_are_adjoint():
    """With what moves nothing beside it, in blocks that are shorter than paths."""
    scene = psdr.load_dict(fog_scene(1.0, 1.0, paint=GREY, fog=COLOURS))
    params = psdr.traverse(scene)
    names = ["leaf.to_world", "lamp.to_world", "fog.to_world", "sensor.to_world", "fog.interior_medium.scale"]
    params.requires_grad_only(*names)
    w = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    options = {"integrator": psdr.PathIntegrator(max_depth=4, interior=psdr.interior.RadiativeTransfer(block=2))}
    psdr.render_backward(scene, params, w, spp=64, seed=2, **options)
    for name in names:
        found = params[name].grad.numpy().astype(np.float64)
        v = np.random.default_rng(len(name)).normal(size=found.shape).astype(np.float32)
        tangents = dict.fromkeys(names, 0.0) | {name: v}
        image = psdr.render_forward(scene, params, tangents, spp=64, seed=2, **options).numpy()
        left, right = (image.astype(np.float64) * w).sum(), (found * v).sum()
        bound = 2e-5 * max(np.linalg.norm(image) * np.linalg.norm(w), np.linalg.norm(found) * np.linalg.norm(v))
        assert found.any() and abs(left - right) <= bound, (name, left, right, bound)


@pytest.mark.parametrize(
    ("parts", "name", "words"),
    [
        ({"bulb": point([1, 1, 2])}, "leaf.to_world", "shadows of lights without an area"),
        (
            {"sensor": {"type": "orthographic", "to_world": T.translate([0, 0, -9])}},
            "leaf.to_world",
            "use a perspective camera",
        ),
        ({"other": {**square(0.5, 1.0, GREY)}}, "leaf.to_world", "edges in which shapes meet"),
        ({"ball": {"type": "sphere"}}, "leaf.to_world", "'ball' interpolates them"),
        ({}, "lamp.vertex_texcoords", "textures would"),
    ],
    ids=["bulb", "parallel", "meets", "normals", "texture"],
)
def test_what_is_not_estimated_is_refused(parts, name, words):
    scene = psdr.load_dict(fog_scene() | parts)
    with pytest.raises(ValueError, match=words):
        psdr.plan(scene, names=[name], integrator=psdr.PathIntegrator(interior=METHOD))


def test_refused_beside_other_methods_and_without_media():
    scene = psdr.load_dict(fog_scene())
    with pytest.raises(ValueError, match="leave boundary out"):
        integrator = psdr.PathIntegrator(interior=METHOD, boundary=psdr.boundary.PathSpace())
        psdr.plan(scene, names=["leaf.to_world"], integrator=integrator)
    scene = psdr.load_dict({k: v for k, v in fog_scene().items() if k != "fog"})
    with pytest.raises(ValueError, match="for scenes with participating media"):
        psdr.plan(scene, names=["sky.radiance.value"], integrator=psdr.PathIntegrator(interior=METHOD))
    with pytest.raises(ValueError, match="expected True or False"):
        psdr.interior.RadiativeTransfer(edges=1)
