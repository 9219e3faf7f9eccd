"""Pools whose processes die: the bits stay, or an error says what happened, and nothing hangs or stays behind."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, CancelledError, ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

import warp_psdr as psdr
from tests.pool.cases import GAP, answers, assert_same, assert_same_fit
from tests.pool.children import LONGEST, below, of_session, program, wait_until
from tests.pool.faults import (
    dies,
    has_another_version,
    has_another_warp,
    interfere,
    kill,
    none_stays,
    raises,
    rendered,
)
from tests.pool.fitting import assert_resumes, running
from warp_psdr.distributed import JobError, Pool
from warp_psdr.files import write_atomic
from warp_psdr.fit.run import fit

# -- executors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("own", [True, False], ids=["local", "executor"])
def test_jobs_of_killed_processes_are_done_by_others(gap, own: bool) -> None:
    scene, params, expected = gap
    reference = psdr.render(scene, integrator=GAP.integrator, spp=64, seed=5).numpy()
    with (
        none_stays(),
        ProcessPoolExecutor(2) as executor,
        Pool("local", processes=2) if own else Pool(executor) as pool,
    ):
        assert_same(answers(GAP, scene, params, pool), expected)
        assert rendered(pool, scene, 64, lambda: kill({min(below())})).tobytes() == reference.tobytes()
        assert rendered(pool, scene, 64, lambda: kill(below())).tobytes() == reference.tobytes()
        lost = pool.report.lost
        assert lost >= 1
        assert_same(answers(GAP, scene, params, pool), expected)
        assert pool.report.lost == lost


@pytest.mark.parametrize("every", [False, True], ids=["one", "all"])
def test_processes_that_are_killed_while_idle_are_replaced(gap, every: bool) -> None:
    scene, params, expected = gap
    with none_stays(), Pool("local", processes=3) as pool:
        for _ in range(3):
            assert_same(answers(GAP, scene, params, pool), expected)
            kill(below() if every else {max(below())})


def test_a_pool_closes_whose_process_was_killed(gap) -> None:
    scene, _params, _expected = gap
    with none_stays():
        pool = Pool("local", processes=2)
        pool.render(scene, integrator=GAP.integrator, spp=1)
        os.kill(min(below()), signal.SIGKILL)
        pool.close()


@pytest.mark.parametrize(
    ("initializer", "said"),
    [
        (
            raises,
            r"(?s)share \d+ of \d+, sensor 0, seed 7, image: process \d+ on .*nothing to draw with.*Traceback.*in draw",
        ),
        (dies, "times in a row a process ended before its job was done"),
        (has_another_version, r"process \d+ on .* has warp_psdr 0\.0\.1 .*the same versions"),
        (has_another_warp, r"process \d+ on .* and Warp 0\.0\.2.*the same versions"),
    ],
)
def test_what_goes_wrong_in_a_process_is_said_here(gap, initializer: Callable[[], None], said: str) -> None:
    scene, _params, _expected = gap
    with none_stays(), ProcessPoolExecutor(2, initializer=initializer) as executor, Pool(executor) as pool:
        with pytest.raises(JobError, match=said):
            pool.render(scene, integrator=GAP.integrator, spp=4, seed=7)


def ends_once(_threads: int | None, folder: Path) -> str:
    """End the process, the second time do nothing."""
    if not (folder / "ended").exists():
        wait_until((folder / "waits").exists, "the other call has not begun")
        (folder / "ended").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "done"


def waits_once(_threads: int | None, folder: Path) -> bool:
    """Wait for ever, and do not listen to SIGTERM; the second time return whether the first one still waits."""
    if (folder / "waits").exists():
        return (Path("/proc") / (folder / "waits").read_text() / "cmdline").exists()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    write_atomic(folder / "waits", lambda file: file.write(str(os.getpid()).encode()))
    time.sleep(LONGEST)
    return True


def test_what_a_broken_executor_ran_has_ended_when_it_is_run_again(tmp_path: Path) -> None:
    """Two fits that write to one folder would refuse each other."""
    with none_stays(), Pool("local", processes=2) as pool:
        calls = [pool.call(waits_once, tmp_path), pool.call(ends_once, tmp_path)]
        assert [call.result() for call in calls] == [False, "done"]


@pytest.mark.parametrize("engine", ["local", "executor"])
def test_processes_without_jobs_end_with_their_client(tmp_path: Path, engine: str) -> None:
    with program(tmp_path / "said.txt", "tests.pool.idling", engine) as process:
        wait_until(lambda: len(of_session(process.pid)) == 5 or process.poll() is not None, "four processes")
        process.kill()
        process.wait()
        wait_until(lambda: not of_session(process.pid), "processes outlive their client")


def test_a_pool_that_closes_ends_what_runs(tmp_path: Path) -> None:
    with none_stays():
        with Pool("local", processes=1) as pool:
            running, queued = (pool.call(ends_once, tmp_path) for _ in range(2))
        for call in (running, queued):
            with pytest.raises((BrokenExecutor, CancelledError)):
                call.result()


# -- fits --------------------------------------------------------------------------------------------------------------


def test_a_fit_goes_on_whose_processes_are_killed(whole, tmp_path: Path, monkeypatch) -> None:
    config, expected = whole
    with none_stays(), Pool("local", processes=2) as pool:
        interfere(monkeypatch, {4: lambda: kill({min(below())}), 9: lambda: kill(below())})
        found = fit(replace(config, output=tmp_path / "out"), pool=pool)
    assert_same_fit(found.output, expected.output)


@pytest.mark.parametrize("engine", [pytest.param("local", marks=pytest.mark.slow), "executor"])
def test_processes_end_with_a_client_that_is_killed(long: Path, tmp_path: Path, engine: str) -> None:
    with running(long, tmp_path / "out", engine) as process:
        assert len(of_session(process.pid)) == 3
        process.kill()
        process.wait()
        wait_until(lambda: not of_session(process.pid), "processes outlive their client")
    assert_resumes(long, tmp_path / "out")


@pytest.mark.parametrize(
    ("engine", "group"),
    [
        ("executor", True),
        pytest.param("executor", False, marks=pytest.mark.slow),
        pytest.param("local", True, marks=pytest.mark.slow),
        pytest.param("local", False, marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_ends_a_fit_at_a_whole_step(long: Path, tmp_path: Path, engine: str, group: bool) -> None:
    with running(long, tmp_path / "out", engine) as process:
        (os.killpg if group else os.kill)(process.pid, signal.SIGINT)
        assert process.wait(LONGEST) == 0
        assert (tmp_path / "out.txt").read_text().splitlines()[-1] == "stopped"
        assert not of_session(process.pid)
    assert_resumes(long, tmp_path / "out")


@pytest.mark.parametrize("group", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_ctrl_c_ends_a_call(tmp_path: Path, group: bool) -> None:
    output = tmp_path / "said.txt"
    with program(output, "tests.pool.rendering") as process:
        wait_until(lambda: "begun" in output.read_text() or process.poll() is not None, "no job is done")
        (os.killpg if group else os.kill)(process.pid, signal.SIGINT)
        assert process.wait(LONGEST) == 0, output.read_text()
        assert output.read_text().splitlines()[-1] == "interrupted"
        assert not of_session(process.pid)


@pytest.mark.slow
def test_processes_are_killed_thirty_times(gap) -> None:
    """In the middle of jobs, also with much data under way, between calls, and all at once."""
    scene, params, expected = gap
    reference = psdr.render(scene, integrator=GAP.integrator, spp=16, seed=5).numpy()
    with none_stays(), Pool("local", processes=4) as pool:
        for turn in range(30):
            victims = [lambda: kill({min(below())}), lambda: kill(below()), lambda: kill(set(sorted(below())[:2]))]
            assert rendered(pool, scene, 16, victims[turn % 3]).tobytes() == reference.tobytes()
            if turn % 4 == 0:
                kill({max(below())})
            if turn % 5 == 0:
                assert_same(answers(GAP, scene, params, pool), expected)
