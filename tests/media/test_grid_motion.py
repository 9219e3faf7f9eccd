"""What moves beside and in grids of voxels: lights, surfaces, the camera, the interface, and the grids themselves.

The box of the grid ends before its interface, and its density does not vanish there, so that points of the medium ride
on it. In the slab nothing hides anything: the interior term is whole.
"""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients import measure
from tests.gradients.configs import Case, aim, shift
from tests.gradients.scenes import SCENES, SIZE
from tests.media.scenes import T, camera, cube, grid, grids, medium, point, puffs, rgb, square, whole
from tests.path.helpers import assert_mean

#: Some boxes end inside of their interface, and are meant to.
pytestmark = pytest.mark.filterwarnings("ignore:.* is not 0 at the border of its box")

BOX = (
    T.translate([0.1, 0.05, 0.8])
    @ T.rotate([0, 0, 1], 20.0)
    @ T.rotate([1, 0, 0], 10.0)
    @ T.scale([3.0, 2.5, 1.0])
    @ T.translate([-0.5, -0.5, -0.5])
)
DENSITY = (0.3 + 2.0 * puffs(8))[:, :7, :6]
ALBEDO = np.random.default_rng(1).uniform(0.2, 0.95, (3, 4, 5, 3))
SIGMA = "slab.interior_medium.sigma_t.to_world"
COLOUR = "slab.interior_medium.albedo.to_world"
TOGETHER = ("floor.to_world", "slab.to_world", "sensor.to_world", "bulb.position", SIGMA, COLOUR)
#: Of the same motion by two media.
Z = 4.0


def smoky(interior, pose):
    return {
        "sensor": camera([2.5, 0, 2.0], [0, 0, 0], 50.0, SIZE),
        "floor": square(0, 600.0, {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.3)}),
        "slab": {**cube(interior), "to_world": pose},
        "bulb": point([0.5, 0.3, 2.5], (6.0, 5.0, 4.0)),
    }


def slab_scene():
    """A turned box of smoke above a floor, in an interface that is larger."""
    smoke = grids(grid(DENSITY, BOX), grid(ALBEDO, BOX), g=0.4)
    return smoky(smoke, T.translate([0, 0, 0.8]) @ T.scale([2.0, 2.0, 0.75]))


SCENES |= {"smoky slab": slab_scene}
CASES = [
    Case("smoky slab", "bulb.position", shift(0.3, 0, 1), 0.08, depth=3, spp=192),
    Case("smoky slab", SIGMA, shift(0, 0, 1), 0.08, depth=2, spp=2048, slow=True),
    Case("smoky slab", SIGMA, aim(0.2, 1, 0), 0.08, "turns", depth=2, spp=2048, slow=True),
    Case("smoky slab", COLOUR, aim(0.2, 1, 0), 0.08, depth=2, spp=2048, slow=True),
    Case("smoky slab", "floor.to_world", shift(0, 0, 1), 0.08, depth=3, spp=512, slow=True),
    Case("smoky slab", "sensor.to_world", aim(0, 1, 0), 0.08, depth=2, spp=2048, slow=True),
]


@pytest.mark.slow_rows("smoky slab-bulb.position-3")
@pytest.mark.parametrize(
    "case", [pytest.param(case, id=str(case), marks=[pytest.mark.slow] * case.slow) for case in CASES]
)
def test_derivative_equals_finite_differences(case):
    """In reverse mode; the other one is its adjoint, below."""
    _scene, params = measure.load(case.scene)
    params.requires_grad_only(*TOGETHER)
    measure.assert_agrees(measure.compare(case, "reverse", 8, params.requested))


def motions(params, motion):
    """The derivative along one motion of each of the requested parameters."""
    grads = [(params[n].grad.numpy().astype(np.float64), params[n].numpy()) for n in params.requested]
    return np.array([(grad * motion(values)).sum() for grad, values in grads])


@pytest.mark.slow
def test_nothing_changes_where_all_moves_together():
    """Sample by sample: floor, bulb, camera and both grids have derivatives that add up to rounding."""
    scene, params = measure.load("smoky slab")
    params.requires_grad_only(*TOGETHER)
    params.zero_grad()
    psdr.render_backward(
        scene, params, np.ones((SIZE, SIZE, 3), np.float32), integrator=measure.integrator(3), spp=16, seed=1
    )
    parts = dict(zip(params.requested, motions(params, shift(1.0, -0.5, 0.7)), strict=True))
    assert parts.pop("slab.to_world") == 0.0, "the interface is beyond the box"
    assert min(map(abs, parts.values())) > 0.0
    assert abs(sum(parts.values())) < 2e-5 * max(map(abs, parts.values())), parts


def about_y(x):
    """A turn about the scene's y axis of a pose or a position: the origins of two poses differ."""
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    x = x.astype(np.float64)
    return np.vstack([turn @ x[:3], np.zeros((1, 4))]) if x.shape == (4, 4) else x @ turn.T


@pytest.mark.slow
def test_a_constant_grid_moves_as_a_homogeneous_medium():
    """Whose interface is the grid's box: the pose of one is that of the other."""
    fog = medium(0.8, (0.9, 0.8, 0.7), g=0.4)
    filled = grids(grid(np.full((2, 3, 2), 0.8), BOX), (0.9, 0.8, 0.7), g=0.4)
    shared = ["floor.to_world", "sensor.to_world", "bulb.position"]
    scenes = [
        (smoky(fog, BOX @ T.translate([0.5, 0.5, 0.5]) @ T.scale(0.5)), [*shared, "slab.to_world"]),
        (smoky(filled, T.translate([0, 0, 0.8]) @ T.scale([2.0, 2.0, 0.75])), [*shared, SIGMA]),
    ]
    adjoint = np.ones((SIZE, SIZE, 3), np.float32)
    found = []
    for parts, names in scenes:
        scene = psdr.load_dict(whole(**parts))
        params = psdr.traverse(scene)
        params.requires_grad_only(*names)
        found.append([])
        for seed in range(8):
            params.zero_grad()
            psdr.render_backward(scene, params, adjoint, integrator=measure.integrator(3), spp=256, seed=seed)
            turned = motions(params, about_y)
            found[-1].append([*motions(params, shift(0.2, -0.3, 1.0)), *turned])
    one, other = (np.array(f) for f in found)
    spread = np.sqrt((one.var(axis=0, ddof=1) + other.var(axis=0, ddof=1)) / 8)
    assert (np.abs(one.mean(axis=0) - other.mean(axis=0)) < Z * spread).all(), (one.mean(axis=0), other.mean(axis=0))
    assert (spread < 0.03 * np.abs(one.mean(axis=0)).max()).all(), spread


@pytest.mark.slow
def test_absorption_follows_the_pose():
    """exp(-int sigma) of a column of layers that is shifted and stretched along the view, and turned about it."""
    layers = np.array([0.2, 1.0, 0.4, 0.1])[:, None, None]
    box = T.translate([-1, -1, -1]) @ T.scale([2.0, 2.0, 2.0])
    scene = psdr.load_dict(
        whole(
            sensor=camera([0, 0, 5], [0, 0, 0], 1.0, 4, up=(0, 1, 0)),
            cube=cube(grids(grid(layers, box), 0.0), scale=3.0),
            sky={"type": "constant", "radiance": 1.0},
        )
    )
    params = psdr.traverse(scene)
    name = "cube.interior_medium.sigma_t.to_world"
    params.requires_grad_only(name)
    depth = 0.5 * layers.sum()
    pose = params[name].numpy()
    found = []
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(
            scene,
            params,
            np.full((4, 4, 3), 1.0 / 48.0, np.float32),
            integrator=measure.integrator(1),
            spp=512,
            seed=seed,
        )
        grad = params[name].grad.numpy().astype(np.float64)
        # Twice as tall a box has twice the depth; a shift along or across changes nothing.
        found.append([(grad * pose)[2, 2], grad[2, 3], grad[0, 3]])
    assert_mean(np.array(found), np.array([-depth * np.exp(-depth), 0.0, 0.0]), "stretched, shifted", 1e-3)


@pytest.mark.slow
def test_forward_and_reverse_mode_are_adjoint():
    """With what moves nothing requested beside it, and paths longer than a block."""
    scene = psdr.load_dict(whole(**slab_scene()))
    params = psdr.traverse(scene)
    names = [*TOGETHER, "slab.interior_medium.albedo.data", "floor.bsdf.reflectance.value"]
    params.requires_grad_only(*names)
    w = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    integrator = psdr.PathIntegrator(max_depth=6, boundary=None, interior=psdr.interior.Replay(block=2))
    psdr.render_backward(scene, params, w, integrator=integrator, spp=16, seed=2)
    whole_path = psdr.PathIntegrator(max_depth=6, boundary=None)
    for name in names:
        found = params[name].grad.numpy().astype(np.float64)
        v = np.random.default_rng(len(name)).normal(size=found.shape).astype(np.float32)
        if name.endswith("to_world"):
            v[3] = 0.0
        tangents = dict.fromkeys(names, 0.0) | {name: v}
        image = psdr.render_forward(scene, params, tangents, integrator=whole_path, spp=16, seed=2).numpy()
        left, right = (image.astype(np.float64) * w).sum(), (found * v).sum()
        bound = 3e-5 * max(np.linalg.norm(image) * np.linalg.norm(w), np.linalg.norm(found) * np.linalg.norm(v))
        assert found.any() or name == "slab.to_world"
        assert abs(left - right) <= bound, (name, left, right, bound)


def test_grids_without_interpolation_are_refused():
    smoke = grids(grid(DENSITY, BOX, filter_type="nearest"), g=0.4)
    scene = psdr.load_dict(whole(**smoky(smoke, BOX)))
    integrator = psdr.PathIntegrator(boundary=None)
    with pytest.raises(ValueError, match=r"slab\.interior_medium\.sigma_t\.data.*make its filter 'trilinear'"):
        psdr.plan(scene, names=["floor.to_world"], integrator=integrator)


def test_a_pose_without_an_inverse_is_refused():
    scene = psdr.load_dict(whole(**slab_scene()))
    params = psdr.traverse(scene)
    pose = params[SIGMA].numpy().copy()
    pose[:, 2] = 0.0
    params[SIGMA] = pose
    with pytest.raises(ValueError, match=r"sigma_t\.to_world: its to_world has no inverse"):
        params.update()
