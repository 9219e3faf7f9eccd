"""Pools: the bits of one process, whatever runs the jobs and on however many processes."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

import warp_psdr as psdr
from tests.pool import children
from tests.pool.cases import CASES, answers, assert_same, assert_same_fit
from warp_psdr.distributed import Pool
from warp_psdr.fit.run import fit
from warp_psdr.scene.acceleration import vector_width

ENGINES = ("executor", "local", "dask")
COUNTS = (1, 2, 4)
EVERY = [(engine, count) for engine in ENGINES for count in COUNTS]


@contextmanager
def pool_of(engine: str, count: int, request: pytest.FixtureRequest) -> Iterator[Pool]:
    """Make a pool of so many processes."""
    if engine == "local":
        with Pool("local", processes=count) as pool:
            yield pool
    elif engine == "executor":
        with ProcessPoolExecutor(count) as executor, Pool(executor) as pool:
            yield pool
    else:
        client = request.getfixturevalue("client")
        client.cluster.scale(count)
        children.wait_until(lambda: len(client.scheduler_info(n_workers=-1)["workers"]) == count, "workers")
        with Pool(client) as pool:
            yield pool


@pytest.fixture(scope="module", params=EVERY, ids=lambda row: f"{row[0]}-{row[1]}")
def pool(request: pytest.FixtureRequest) -> Iterator[Pool]:
    """Every engine with every number of processes."""
    with pool_of(*request.param, request) as pool:
        yield pool


@functools.cache
def loaded(name: str):
    """Return a scene, its parameters, and what one process finds."""
    scene, params = CASES[name].load()
    return scene, params, answers(CASES[name], scene, params)


def test_calls_have_the_bits_of_one_process(pool: Pool) -> None:
    for name, case in CASES.items():
        scene, params, expected = loaded(name)
        assert_same(answers(case, scene, params, pool), expected)
    assert pool.report.jobs >= pool.report.processes and pool.report.lost == 0


def test_a_fit_has_the_bits_of_one_process(pool: Pool, whole, tmp_path: Path) -> None:
    config, expected = whole
    found = fit(replace(config, output=tmp_path / "out"), pool=pool)
    assert_same_fit(found.output, expected.output)
    assert len(found.losses) == 20 and found.losses[-1] < 0.5 * found.losses[0]


def test_a_fresh_process_resumes_with_another_number_of_workers(request, whole, tmp_path: Path) -> None:
    config, expected = whole
    begun = replace(config, output=tmp_path / "out")
    with pool_of("local", 2, request) as pool:
        fit(begun, iterations=7, pool=pool)
    file, output = config.scene.parent / "fit.toml", tmp_path / "output"
    with children.program(output, "tests.pool.fitting", file, begun.output, 1) as process:
        assert process.wait(children.LONGEST) == 0, output.read_text()
    assert_same_fit(begun.output, expected.output)


@pytest.mark.parametrize("engine", ENGINES)
def test_edits_reach_the_workers_also_those_that_are_undone(engine: str, request) -> None:
    case = CASES["gap"]
    scene, params = case.load()
    colour, pose = params["floor.vertex_color"].numpy().copy(), params["ceiling.to_world"].numpy().copy()
    moved = pose.copy()
    moved[..., 2, 3] += 0.1
    seen = []
    with pool_of(engine, 4, request) as pool:
        for colours, place in ((colour, pose), (0.5 * colour, pose), (0.5 * colour, moved), (colour, pose)):
            params["floor.vertex_color"], params["ceiling.to_world"] = colours, place
            params.update()
            seen.append(answers(case, scene, params, pool))
            assert_same(seen[-1], answers(case, scene, params))
    images = [found["image"].tobytes() for found in seen]
    assert images[0] == images[3] and len(set(images)) == 3


def test_two_scenes_take_turns_in_one_pool(request) -> None:
    with pool_of("local", 2, request) as pool:
        for seed in (1, 2):
            for name in ("gap", "batch", "gap"):
                scene, params, _expected = loaded(name)
                expected = answers(CASES[name], scene, params, seed=seed)
                assert_same(answers(CASES[name], scene, params, pool, seed), expected)


@pytest.mark.parametrize("engine", ["executor", "dask"])
def test_two_pools_share_an_engine_at_the_same_time(engine: str, request) -> None:
    """Each on a thread of its own, with a scene of its own."""
    if engine == "dask":
        shared = request.getfixturevalue("client")
    else:
        shared = request.getfixturevalue("executor")
    with Pool(shared) as one, Pool(shared) as other, ThreadPoolExecutor(2) as threads:
        asked = [(pool, name, loaded(name)) for pool, name in ((one, "gap"), (other, "batch"))]
        for _ in range(3):
            found = [threads.submit(answers, CASES[name], *known[:2], pool) for pool, name, known in asked]
            for answer, (_pool, _name, known) in zip(found, asked, strict=True):
                assert_same(answer.result(), known[2])
    assert shared.submit(abs, -1).result() == 1  # closed pools leave it open


@pytest.fixture
def executor() -> Iterator[ProcessPoolExecutor]:
    with ProcessPoolExecutor(2) as executor:
        yield executor


def test_progress_reaches_one(request) -> None:
    seen: list[float] = []
    scene, _params, _expected = loaded("gap")
    with pool_of("local", 2, request) as pool:
        pool.render(scene, integrator=CASES["gap"].integrator, spp=1, progress=seen.append)
    assert seen == sorted(seen) and seen[-1] == pytest.approx(1.0) and len(seen) >= 8


@pytest.mark.slow
def test_workers_take_the_vector_width_of_the_caller_and_give_it_back(request) -> None:
    own = vector_width()
    case = CASES["light paths"]
    with pool_of("local", 2, request) as pool:
        try:
            for width in (own // 2, own):
                psdr.set_vector_width(width)
                scene, params = case.load()
                assert_same(answers(case, scene, params, pool), answers(case, scene, params))
                assert pool.call(width_of).result() == width
        finally:
            psdr.set_vector_width(None)


def width_of(_setting: object) -> int:
    """Return the width in a worker."""
    return vector_width()


def test_a_closed_pool_is_refused(whole, tmp_path: Path) -> None:
    scene, params, _expected = loaded("gap")
    pool = Pool("local", processes=1)
    pool.render(scene, integrator=CASES["gap"].integrator, spp=1)
    pool.close()
    pool.close()
    for call in (
        lambda: pool.render(scene),
        lambda: pool.render_backward(scene, params, 1.0),
        lambda: pool.render_forward(scene, params, {"floor.vertex_color": 1.0}),
        lambda: pool.map_fits([]),
    ):
        with pytest.raises(ValueError, match="the pool is closed"):
            call()


@pytest.mark.parametrize("engine", [None, 3, "localhost"])
def test_other_engines_are_refused(engine: object) -> None:
    with pytest.raises(ValueError, match="expected"):
        Pool(engine)


def test_an_address_needs_dask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"warp-psdr\[cluster\]"):
        Pool("tcp://127.0.0.1:8786")


def test_an_address_is_connected_to(client) -> None:
    scene, _params, expected = loaded("gap")
    with Pool(client.scheduler.address) as pool:
        image = pool.render(scene, integrator=CASES["gap"].integrator, spp=1)
    assert image.numpy().any() and expected


def test_an_executor_of_threads_is_refused() -> None:
    """Jobs would wait for each other, and for the caller's own calls."""
    with ThreadPoolExecutor(2) as threads, pytest.raises(TypeError, match="ThreadPoolExecutor"):
        Pool(threads)
