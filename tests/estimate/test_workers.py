"""Worker threads: equal bits for any number of them; random numbers: what is decorrelated from what."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients import measure, scenes
from warp_psdr import workers

NAMES = ("floor.vertex_color", "ceiling.to_world", "floor.vertex_positions", "ceiling.emitter.radiance.data")
INTEGRATOR = measure.integrator(4)
SIZE = 40
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def all_workers_afterwards():
    yield
    psdr.set_workers(None)


@pytest.fixture(scope="module")
def gap():
    node = scenes.gap_scene()
    node["sensor"]["film"] |= {"width": SIZE, "height": SIZE}
    scene = psdr.load_dict({"type": "scene", **node})
    params = psdr.traverse(scene)
    params.requires_grad("*")  # as tests/gradients/test_table.py does: one kernel for both
    return scene, params


def primal(scene, params, seed=1, spp=4):
    return [psdr.render(scene, integrator=INTEGRATOR, spp=spp, seed=seed).numpy()]


def reverse(scene, params, seed=1, spp=4):
    w = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    params.zero_grad()
    psdr.render_backward(scene, params, w, integrator=INTEGRATOR, spp=spp, seed=seed)
    return [params[n].grad.numpy().copy() for n in NAMES]


def forward(scene, params, seed=1, spp=4):
    tangents = {n: np.random.default_rng(1).normal(size=params[n].numpy().shape) for n in NAMES}
    return [psdr.render_forward(scene, params, tangents, integrator=INTEGRATOR, spp=spp, seed=seed).numpy()]


@pytest.mark.parametrize("mode", [primal, reverse, pytest.param(forward, marks=pytest.mark.slow)])
def test_equal_bits_for_any_number_of_workers(gap, mode):
    results = {}
    for n in (1, 2, 3, 5):
        psdr.set_workers(n)
        assert workers.workers() == n
        results[n] = mode(*gap)
    assert all(np.abs(r).max() > 0.0 for r in results[1])
    for n, arrays in results.items():
        for first, other in zip(results[1], arrays, strict=True):
            np.testing.assert_array_equal(first, other, err_msg=f"{n} workers")


@pytest.mark.parametrize("mode", [primal, reverse, pytest.param(forward, marks=pytest.mark.slow)])
def test_equal_seeds_repeat_and_other_seeds_differ(gap, mode):
    once, again, other = mode(*gap), mode(*gap), mode(*gap, seed=2)
    for a, b, c in zip(once, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert not np.array_equal(a, c)


@pytest.mark.parametrize("size", [(1, 1), (40, 40), (37, 11), (1, 300)])
def test_pixel_order_is_a_permutation(size):
    order = workers.pixel_order(*size)
    np.testing.assert_array_equal(np.sort(order), np.arange(size[0] * size[1]))


@pytest.mark.parametrize(("pixels", "lanes"), [(1, 16), (63, 16), (1600, 16), (256 * 256, 5), (1_000_003, 2)])
def test_every_pixel_is_launched_once(pixels, lanes):
    parts = workers.chunks(pixels, lanes)
    assert len(parts) == lanes
    covered = np.zeros(pixels, int)
    for lane in parts:
        for first, count in lane:
            assert 0 < count <= workers.MAX_CHUNK
            covered[first : first + count] += 1
    np.testing.assert_array_equal(covered, 1)


def test_an_error_in_a_lane_is_raised():
    psdr.set_workers(2)

    def lane(i):
        if i == 3:
            raise RuntimeError("lane 3")

    with pytest.raises(RuntimeError, match="lane 3"):
        workers.run_shards(lane, range(8))


@pytest.mark.parametrize("n", [0, -1, 1.5, "2", True])
def test_a_bad_number_of_workers_is_refused(n):
    with pytest.raises(ValueError, match="workers: got"):
        psdr.set_workers(n)


def noise(image, mean):
    """Deviation of an estimate from the mean image, normalised."""
    d = (image - mean).reshape(-1).astype(np.float64)
    return d / np.linalg.norm(d)


@pytest.mark.slow
def test_image_and_gradient_use_independent_random_numbers(gap):
    """The gradient along a light's own radiance is the image, if all light scales: same noise, if same numbers."""
    scene, params = gap
    name = "ceiling.emitter.radiance.data"
    tangents = dict.fromkeys(NAMES, 0.0) | {name: params[name].numpy()}

    def image(seed):
        return psdr.render(scene, integrator=INTEGRATOR, spp=1, seed=seed).numpy()

    def derivative(seed):
        return psdr.render_forward(scene, params, tangents, integrator=INTEGRATOR, spp=1, seed=seed).numpy()

    mean = psdr.render(scene, integrator=INTEGRATOR, spp=4096, seed=77).numpy()
    with measure.shared_random_numbers():
        same = (noise(image(3), mean) * noise(derivative(3), mean)).sum()
    assert same > 0.999  # the two are comparable at all
    # 1600 pixels with three channels of one path each: correlations of independent noise stay below 5 / sqrt(1600).
    assert abs((noise(image(3), mean) * noise(derivative(3), mean)).sum()) < 0.125
    assert abs((noise(image(3), mean) * noise(image(4), mean)).sum()) < 0.125


def test_gradients_of_two_passes_add_up(gap):
    scene, params = gap
    first = reverse(scene, params)
    w = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    psdr.render_backward(scene, params, w, integrator=INTEGRATOR, spp=4, seed=1)
    for name, g in zip(NAMES, first, strict=True):
        np.testing.assert_allclose(params[name].grad.numpy(), 2.0 * g, rtol=1e-6)


def test_progress_reaches_one(gap):
    scene, _params = gap
    seen = []
    psdr.render(scene, integrator=INTEGRATOR, spp=1, progress=seen.append)
    assert seen and max(seen) == pytest.approx(1.0)
    assert all(0.0 < s <= 1.0 for s in seen)


#: A program that renders, forks, and renders in the child: a scene that it has, and one that it loads.
FORKS = """
import os
import warp_psdr as psdr
node = {"type": "scene", "lamp": {"type": "rectangle", "emitter": {"type": "area", "radiance": 3.0}},
        "camera": {"type": "perspective", "to_world": psdr.Transform.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0)),
                   "film": {"type": "hdrfilm", "width": 16, "height": 16}},
        "integrator": {"type": "path", "max_depth": 1}}
psdr.set_workers(2)
scene = psdr.load_dict(node)
before = psdr.render(scene, spp=1).numpy()
child = os.fork()
if child == 0:
    same = (psdr.render(scene, spp=1).numpy() == before).all()
    new = (psdr.render(psdr.load_dict(node), spp=1).numpy() == before).all()
    os._exit(0 if same and new else 1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), float(before.max()))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_renders() -> None:
    """Its threads are its own: those of the pool that it inherits do not exist."""
    done = subprocess.run([sys.executable, "-c", FORKS], cwd=ROOT, capture_output=True, text=True, timeout=120)
    status, brightest = done.stdout.split()
    assert (status, float(brightest)) == ("0", pytest.approx(3.0)), done.stderr[-2000:]
