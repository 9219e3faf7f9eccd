"""The interior term of what moves in media, against finite differences in scenes where nothing hides anything.

A light in fog has a derivative by its distance in closed form. The end of a floor is a silhouette, beyond which there
is fog: it moves the light by a share of 1 / R, so floors are very wide here.
"""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients import measure
from tests.gradients.configs import Case, aim, shift, widen
from tests.gradients.scenes import SCENES, SIZE
from tests.media.scenes import BLACK, T, camera, cube, grid, medium, point, rgb, square, whole
from tests.path.helpers import assert_mean

#: The airlight of ``test_gradient_forms.py``: sigma, albedo, D, gamma, g and dL/dD.
AIRLIGHT = [(0.5, 0.8, 2.0, 30.0, 0.0, -0.01966370), (0.5, 0.8, 2.0, 30.0, 0.6, -0.01690276)]
#: Absorbs the width of the camera, relative.
WIDTH = 1e-3


def slab_scene():
    """A slab of haze above a floor, a bulb above it, the camera beside the bulb."""
    pose = T.translate([0, 0, 0.8]) @ T.scale([5, 5, 0.5])
    return {
        "sensor": camera([2.5, 0, 2.0], [0, 0, 0], 50.0, SIZE),
        "floor": square(0, 600.0, {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.3)}),
        "slab": {**cube(medium((0.8, 0.6, 1.0), (0.9, 0.8, 0.7), g=0.4)), "to_world": pose},
        "bulb": point([0.5, 0.3, 2.5], (6.0, 5.0, 4.0)),
    }


def blended_slab_scene():
    """``slab_scene`` with fog that scatters backwards below and forwards above, by a grid of weights."""
    scene = slab_scene()
    weights = np.linspace(0.0, 1.0, 6).reshape(6, 1, 1) + np.array([0.0, -0.3, 0.0]).reshape(1, 1, 3)
    box = T.translate([-2, -2, 0.3]) @ T.scale([4, 4, 1])
    lobes = {"back": {"type": "hg", "g": -0.6}, "front": {"type": "hg", "g": 0.7}}
    phase = {"type": "blendphase", "weight": grid(np.clip(weights, 0.0, 1.0), box), **lobes}
    scene["slab"]["interior"]["phase"] = phase
    return scene


def glowing_room_scene():
    """A room full of fog whose walls shine and reflect: closed and convex, so that nothing is hidden."""
    fog = {**medium((0.5, 0.4, 0.6), (0.9, 0.8, 0.7), g=0.3), "id": "fog"}
    wall = {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.3)}
    return {
        "fog": fog,
        "sensor": camera([-0.6, -0.4, 0.2], [0.5, 0.4, -0.3], 70.0, SIZE, medium={"type": "ref", "id": "fog"}),
        "room": {
            "type": "cube",
            "flip_normals": True,
            "to_world": T.scale([1.2, 1.0, 0.8]),
            "bsdf": wall,
            "emitter": {"type": "area", "radiance": rgb(1.0, 0.8, 0.6)},
        },
    }


def sunny_scene():
    """A turned cube of haze in the sun, before nothing."""
    return {
        "sensor": camera([3.5, 0.5, 0.2], [0, 0, 0], 25.0, SIZE),
        "haze": cube(medium(0.5, 0.8, g=0.5), turn=20.0),
        "sun": {"type": "directional", "direction": [0.8, -0.2, -0.5], "irradiance": rgb(1.0, 2.0, 3.0)},
    }


SCENES |= {
    "blended slab": blended_slab_scene,
    "slab": slab_scene,
    "glowing room": glowing_room_scene,
    "sunny": sunny_scene,
}
TOGETHER = {
    "blended slab": ("floor.to_world", "sensor.to_world"),
    "slab": ("floor.to_world", "slab.to_world", "sensor.to_world", "bulb.position"),
    "glowing room": ("room.to_world", "sensor.to_world"),
    "sunny": ("haze.to_world", "sensor.to_world", "sun.to_world"),
}
CASES = [
    Case("slab", "floor.to_world", shift(0, 0, 1), 0.04, depth=3, spp=256),
    Case("slab", "slab.to_world", shift(0, 0, 1), 0.04, depth=3, spp=512, slow=True),
    Case("slab", "bulb.position", shift(0, 0, 1), 0.04, depth=3, spp=256, slow=True),
    Case("slab", "sensor.to_world", aim(0, 1, 0), 0.04, depth=3, spp=1024, slow=True),
    Case("blended slab", "floor.to_world", shift(0, 0, 1), 0.04, depth=3, spp=512, slow=True),
    Case("sunny", "sun.to_world", aim(0.2, 1, 0), 0.1, depth=3, spp=512, slow=True),
]


@pytest.mark.filterwarnings("ignore:samples that were not finite")  # one in some million is lost at an interface
@pytest.mark.parametrize(
    "case", [pytest.param(case, id=str(case), marks=[pytest.mark.slow] * case.slow) for case in CASES]
)
def test_derivative_equals_finite_differences(case):
    """In reverse mode; the other one is its adjoint, below."""
    _scene, params = measure.load(case.scene)
    params.requires_grad_only(*TOGETHER[case.scene])
    measure.assert_agrees(measure.compare(case, "reverse", 8, params.requested))


@pytest.mark.slow
def test_a_room_of_glowing_walls_grows():
    """Volume vertices slide along walls that shine: samples with a tail, even by their weight next to walls."""
    case = Case("glowing room", "room.to_world", widen, 0.04, depth=3, spp=1536)
    _scene, params = measure.load(case.scene)
    params.requires_grad_only(*TOGETHER[case.scene])
    found = measure.compare(case, "reverse", 8, params.requested)
    scale = abs(float(found.difference.mean()))
    assert found.error <= 0.04 * scale and abs(found.slope - 1.0) <= measure.SLOPE_TOLERANCE, found


@pytest.mark.slow
def test_the_camera_moves_past_weights_that_vary():
    """Volume vertices on its rays ride through the grid: without the slope of the weight the slope is .51."""
    case = Case("blended slab", "sensor.to_world", shift(0.3, 0, 1), 0.04, depth=3, spp=1024)
    _scene, params = measure.load(case.scene)
    params.requires_grad_only(*TOGETHER[case.scene])
    found = measure.compare(case, "reverse", 8, params.requested)
    scale = abs(float(found.difference.mean()))
    assert found.error <= 0.04 * scale and abs(found.slope - 1.0) <= measure.SLOPE_TOLERANCE, found


def test_nothing_changes_where_all_moves_together():
    """Sample by sample: floor, slab, bulb and camera have derivatives that add up to rounding."""
    motion = shift(1.0, -0.5, 0.7)
    scene, params = measure.load("slab")
    params.requires_grad_only(*TOGETHER["slab"])
    params.zero_grad()
    psdr.render_backward(
        scene, params, np.ones((SIZE, SIZE, 3), np.float32), integrator=measure.integrator(3), spp=16, seed=1
    )
    parts = [
        float((params[name].grad.numpy().astype(np.float64) * tangent).sum())
        for name in params.requested
        for tangent in [motion(params[name].numpy().reshape(params[name].shape))]
    ]
    assert min(map(abs, parts)) > 0.0
    assert abs(sum(parts)) < 2e-4 * max(map(abs, parts)), parts


@pytest.mark.slow
@pytest.mark.parametrize("case", AIRLIGHT, ids=str)
def test_a_light_that_moves_away_in_fog(case):
    """A point light of intensity 1 in endless fog beside the ray of the camera: the closed form's dL/dD."""
    sigma, albedo, distance, angle, g, expected = case
    gamma = np.radians(angle)
    out = np.array([np.sin(gamma), 0.0, np.cos(gamma)])
    scene = psdr.load_dict(
        whole(
            sensor=camera([0, 0, 0], [0, 0, 1], 0.05, up=(0, 1, 0), near_clip=1e-5, medium=medium(sigma, albedo, g)),
            behind=square(-4.0, 0.5, BLACK),
            light=point(distance * out),
        )
    )
    params = psdr.traverse(scene)
    params.requires_grad_only("light.position")
    adjoint = np.full((4, 4, 3), 1.0 / 48.0, np.float32)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=None)
    found = []
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=4096, seed=seed)
        found.append([out @ params["light.position"].grad.numpy().astype(np.float64)])
    assert_mean(np.array(found), np.array([expected]), str(case), WIDTH)


@pytest.mark.slow
def test_forward_and_reverse_mode_are_adjoint():
    """With what moves nothing requested beside it, and paths longer than a block."""
    scene = psdr.load_dict(whole(**slab_scene()))
    params = psdr.traverse(scene)
    names = [*TOGETHER["slab"], "slab.interior_medium.albedo.value.value", "floor.bsdf.reflectance.value"]
    params.requires_grad_only(*names)
    w = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    integrator = psdr.PathIntegrator(max_depth=6, boundary=None, interior=psdr.interior.Replay(block=2))
    psdr.render_backward(scene, params, w, integrator=integrator, spp=16, seed=2)
    whole_path = psdr.PathIntegrator(max_depth=6, boundary=None)
    for name in names:
        found = params[name].grad.numpy().astype(np.float64)
        v = np.random.default_rng(len(name)).normal(size=found.shape).astype(np.float32)
        tangents = dict.fromkeys(names, 0.0) | {name: v}
        image = psdr.render_forward(scene, params, tangents, integrator=whole_path, spp=16, seed=2).numpy()
        left, right = (image.astype(np.float64) * w).sum(), (found * v).sum()
        bound = 2e-5 * max(np.linalg.norm(image) * np.linalg.norm(w), np.linalg.norm(found) * np.linalg.norm(v))
        assert found.any() and abs(left - right) <= bound, (name, left, right, bound)


def test_an_interface_has_no_boundary_term():
    scene = psdr.load_dict(whole(**sunny_scene()))
    assert "not run" in str(psdr.plan(scene, names=["haze.to_world"]))
    scene = psdr.load_dict(whole(**slab_scene()))
    assert "interfaces are no edges" in str(psdr.plan(scene, names=["floor.to_world"]))


@pytest.mark.parametrize(
    ("parts", "method", "words"),
    [
        (
            {"leaf": square(2.0, 1.0, {"type": "mask", "leaf": {"type": "diffuse"}})},
            None,
            "light of 'bulb' passes shape 'leaf' without .* not known beside participating media",
        ),
        ({}, psdr.interior.Antithetic(), "does not know participating media"),
        ({}, psdr.interior.DifferentialRatioTracking(), r"use interior\.Replay"),
    ],
    ids=["mask", "pairs", "ratio tracking"],
)
def test_what_is_not_followed_is_refused(parts, method, words):
    scene = psdr.load_dict(whole(**slab_scene(), **parts))
    integrator = psdr.PathIntegrator(boundary=None, interior=method or psdr.interior.Replay())
    with pytest.raises(ValueError, match=words):
        psdr.plan(scene, names=["floor.to_world"], integrator=integrator)
