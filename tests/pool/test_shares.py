"""Shares of every kind of pass add up to the call, bit for bit; what is sent, and what is not."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary import test_sdfgrid
from tests.gradients import measure, scenes
from tests.interior.test_light_tracing import corner
from tests.media.test_grids import DATA, slab
from tests.path.test_light_tracing import lamp
from tests.pool.inline import Inline
from tests.sensor import test_batch, timed
from warp_psdr import workers
from warp_psdr.distributed.values import changed, restore
from warp_psdr.distributed.wire import add, pack, unpack
from warp_psdr.estimate.gradient_sums import GradientSums

FLOOR = "floor.bsdf.reflectance.value"


def gap(size=40, rfilter="box"):
    node = scenes.gap_scene()
    node["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": rfilter}}
    return {"type": "scene", **node}


#: What is rendered: scene, what is differentiated, integrator.
CASES = {
    "edges": (gap, ("floor.vertex_positions", "ceiling.to_world"), measure.integrator(4)),
    "wide filter": (lambda: gap(rfilter="gaussian"), ("floor.vertex_color",), measure.integrator(4)),
    "one row of pixels": (lambda: gap(size=1), ("floor.vertex_color",), measure.integrator(4)),
    "glass under an environment map": (
        lambda: {"type": "scene", **scenes.glass_scene()},
        ("ball.bsdf.eta", "env.to_world"),
        measure.integrator(4, boundary=None),
    ),
    "textures and vertex normals": (
        lambda: {"type": "scene", **scenes.checkered_scene()},
        ("floor.vertex_normals", "floor.vertex_texcoords"),
        measure.integrator(3, boundary=None),
    ),
    "light paths": (
        lambda: corner(lamp=lamp()),
        (FLOOR, "lamp.emitter.radiance.value"),
        psdr.PathIntegrator(max_depth=4, interior=psdr.interior.LightTracing()),
    ),
    "medium": (slab, (DATA, "sky.radiance.value"), psdr.PathIntegrator(max_depth=1)),
    "grid": (
        lambda: {"type": "scene", **test_sdfgrid.room("lamp")()},
        ("body.grid",),
        psdr.PathIntegrator(max_depth=2),
    ),
    "time bins": (
        lambda: timed.plane(**timed.GATE),
        ("plane.to_world",),
        psdr.PathIntegrator(max_depth=2, boundary=None),
    ),
    "batch": (lambda: test_batch.parts({"rig": test_batch.batch()}), ("cube.bsdf.reflectance.value",), test_batch.ONE),
}


@pytest.mark.parametrize("case", CASES)
def test_shares_add_up_to_the_call(case: str) -> None:
    make, names, integrator = CASES[case]
    made = make()
    scene = psdr.load_dict(made) if isinstance(made, dict) else made
    params = psdr.traverse(scene)
    params.requires_grad_only(*names)
    pool = psdr.distributed.Pool(Inline())
    options = {"integrator": integrator, "spp": 3, "seed": 7}
    image = psdr.render(scene, **options).numpy()
    assert image.any()
    np.testing.assert_array_equal(pool.render(scene, **options).numpy(), image)

    adjoint = np.random.default_rng(0).normal(size=image.shape).astype(np.float32)
    params.zero_grad()
    psdr.render_backward(scene, params, adjoint, **options)
    expected = {name: params[name].grad.numpy().copy() for name in names}
    assert all(gradient.any() for gradient in expected.values())
    params.zero_grad()
    found = pool.render_backward(scene, params, adjoint, **options)
    assert set(found) == set(names)
    for name, gradient in expected.items():
        np.testing.assert_array_equal(params[name].grad.numpy(), gradient, err_msg=name)
        np.testing.assert_array_equal(found[name].reshape(gradient.shape), gradient, err_msg=name)

    tangents = {name: np.random.default_rng(1).normal(size=params[name].numpy().shape) for name in names}
    derivative = psdr.render_forward(scene, params, tangents, **options).numpy()
    assert derivative.any()
    np.testing.assert_array_equal(pool.render_forward(scene, params, tangents, **options).numpy(), derivative)


@pytest.mark.parametrize("processes", [1, 3, 16, 40])
def test_bits_do_not_depend_on_the_number_of_shares(processes: int) -> None:
    scene = psdr.load_dict(gap())
    options = {"integrator": measure.integrator(4), "spp": 3}
    pool = psdr.distributed.Pool(Inline(processes))
    np.testing.assert_array_equal(pool.render(scene, **options).numpy(), psdr.render(scene, **options).numpy())
    assert pool.report.jobs == min(workers.below(8 * processes - 1), workers.SHARDS)


def test_edits_are_followed_and_sent_alone() -> None:
    """A scene goes once; a step sends what has changed since, also back to what it was."""
    scene = psdr.load_dict(gap())
    params = psdr.traverse(scene)
    options = {"integrator": measure.integrator(4), "spp": 2}
    pool = psdr.distributed.Pool(Inline(2))
    before = pool.render(scene, **options).numpy()
    np.testing.assert_array_equal(before, psdr.render(scene, **options).numpy())
    sent = pool.report.sent
    pose = params["ceiling.to_world"].numpy().copy()
    shifted = pose.copy()
    shifted[0, 3] += 0.2
    params["ceiling.to_world"] = shifted
    moved = pool.render(scene, **options).numpy()
    np.testing.assert_array_equal(moved, psdr.render(scene, **options).numpy())
    assert not np.array_equal(moved, before)
    assert pool.report.sent - sent < 0.5 * sent
    params["ceiling.to_world"] = pose
    np.testing.assert_array_equal(pool.render(scene, **options).numpy(), psdr.render(scene, **options).numpy())


def test_values_that_differ_in_a_bit_are_sent() -> None:
    """NaN, signed zeros and all else arrive as they are."""
    scene, twin = psdr.load_dict(gap()), psdr.load_dict(gap())
    base = twin.state()
    params = psdr.traverse(scene)
    color = params["floor.vertex_color"]
    values = color.numpy().copy()
    values.reshape(-1)[:2] = -0.0, 0.25
    color.assign(values)
    scene.settle()
    restore(base, twin, changed(base, scene))
    assert twin.values.numpy().tobytes() == scene.values.numpy().tobytes()


@pytest.mark.parametrize("shape", [(5,), (4, 3), (6, 7, 4), (0, 3), (1, 1, 3)])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_arrays_arrive_without_their_zeros(shape: tuple[int, ...], share: float) -> None:
    random = np.random.default_rng(3)
    array = random.normal(size=shape) * (random.random(shape[:1] + (1,) * (len(shape) - 1)) < share)
    packed = pack(array)
    np.testing.assert_array_equal(unpack(packed), array)
    assert packed.nbytes <= array.nbytes + array.size
    other = random.normal(size=shape) * (random.random(shape[:1] + (1,) * (len(shape) - 1)) < 0.5)
    np.testing.assert_array_equal(unpack(add(packed, pack(other))), array + other)


def test_sums_of_overlapping_parameters_are_added_once() -> None:
    """Positions that a pose moves and the pose itself: values that both need are in one range."""
    scene = psdr.load_dict(gap())
    names = ["ceiling.to_world", "ceiling.vertex_positions"]
    sums = GradientSums(scene, names)
    lanes = sums._sums.numpy()
    lanes[:] = np.random.default_rng(0).normal(size=lanes.shape)
    expected = lanes.copy()
    while len(expected) > 1:
        expected = expected[::2] + expected[1::2]
    total = sums.total()
    again = GradientSums(scene, names)
    again.take(total)
    p = scene.parameters["ceiling.vertex_positions"]
    stretch = slice(p.offset, p.offset + p.size)
    np.testing.assert_array_equal(again._sums.numpy()[0][stretch], expected[0][stretch])


def test_what_a_pool_refuses() -> None:
    scene = psdr.load_dict(gap())
    params = psdr.traverse(scene)
    params.requires_grad("floor.vertex_positions")
    adjoint = np.ones((40, 40, 3), np.float32)
    pool = psdr.distributed.Pool(Inline())
    guided = psdr.PathIntegrator(max_depth=2, boundary=psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree()))
    with pytest.raises(ValueError, match="keeps a structure from one gradient to the next"):
        pool.render_backward(scene, params, adjoint, integrator=guided)
    with pytest.raises(ValueError, match="expected the image's"):
        pool.render_backward(scene, params, adjoint[:3])
    with pytest.raises(ValueError, match="at least one tangent"):
        pool.render_forward(scene, params, {})
    pool.close()
    with pytest.raises(ValueError, match="the pool is closed"):
        pool.render(scene)
    for engine in ("localhost", 4):
        with pytest.raises(ValueError, match="engine: got"):
            psdr.distributed.Pool(engine)
    with pytest.raises(ValueError, match="an executor has its own"):
        psdr.distributed.Pool(Inline(), processes=2)


def test_pilots_are_run_by_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    """A method that a pilot has chosen is sent: repeated gradients have the bits of those without a pool."""
    from warp_psdr.estimate import choice
    from warp_psdr.plan import choice as known

    monkeypatch.setattr(choice, "SPENT", 1)

    def repeated(by) -> list[np.ndarray]:
        scene = psdr.load_dict({"type": "scene", **scenes.rough_scene()})
        psdr.guiding.set_automatic(scene, False)
        known.set_on(scene, True)
        params = psdr.traverse(scene)
        params.requires_grad("floor.bsdf.alpha.value")
        found = []
        for seed in range(3):
            params.zero_grad()
            by.render_backward(
                scene, params, np.ones((*psdr.render(scene, spp=1).shape, 3)), spp=2, seed=seed, integrator=PILOTED
            )
            found.append(params["floor.bsdf.alpha.value"].grad.numpy().copy())
        choices = known.stored(scene)
        assert choices[0]["decided"]
        return [*found, np.array(choices[0]["method"] is not None)]

    for a, b in zip(repeated(psdr), repeated(psdr.distributed.Pool(Inline(2))), strict=True):
        np.testing.assert_array_equal(a, b)


PILOTED = psdr.PathIntegrator(max_depth=2, boundary=None)
