"""Pools on Dask whose workers, scheduler or client die: the bits stay, or an error says what happened."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import warp_psdr as psdr
from tests.pool.cases import GAP, answers, assert_same, assert_same_fit
from tests.pool.children import LONGEST, program, wait_until
from tests.pool.faults import ends, has_another_version, interfere, kill, mends, raises, rendered
from tests.pool.fitting import assert_resumes, running
from warp_psdr.distributed import JobError, Pool, engines, jobs
from warp_psdr.fit import checkpoint
from warp_psdr.fit.run import CHECKPOINT, fit

distributed = pytest.importorskip("distributed")


def workers(client) -> list[int]:
    """Return the processes of two workers that are ready."""
    client.cluster.scale(2)
    pids: list[int] = []

    def ready() -> bool:
        with contextlib.suppress(OSError):  # one that ends just now
            pids[:] = client.run(os.getpid).values()
        return len(pids) == 2

    wait_until(ready, "no two workers")
    return sorted(pids)


@pytest.fixture(scope="module")
def reference(gap):
    return psdr.render(gap[0], integrator=GAP.integrator, spp=64, seed=5).numpy()


def test_jobs_of_a_killed_worker_are_done_by_others(client, gap, reference) -> None:
    scene, params, expected = gap
    pids = workers(client)
    with Pool(client) as pool:
        assert_same(answers(GAP, scene, params, pool), expected)
        assert rendered(pool, scene, 64, lambda: kill(pids[:1])).tobytes() == reference.tobytes()
        assert_same(answers(GAP, scene, params, pool), expected)


def test_data_is_sent_anew_when_all_workers_are_killed_at_once(client, gap, reference, monkeypatch) -> None:
    monkeypatch.setattr(engines, "LARGE", 0)  # what Dask copies from worker to worker, and cannot make again
    scene, params, expected = gap
    pids = workers(client)
    with Pool(client) as pool:
        assert_same(answers(GAP, scene, params, pool), expected)
        assert rendered(pool, scene, 64, lambda: kill(pids)).tobytes() == reference.tobytes()
        assert pool.report.lost >= 1


@pytest.mark.slow
def test_a_worker_may_join_late(client, gap, reference) -> None:
    workers(client)
    with Pool(client) as pool:
        image = rendered(pool, gap[0], 64, lambda: client.cluster.scale(3))
        assert image.tobytes() == reference.tobytes()
        client.wait_for_workers(3, timeout=LONGEST)
        assert rendered(pool, gap[0], 64, lambda: None).tobytes() == reference.tobytes()
        assert pool.report.processes == 3


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (raises, r"(?s)share \d+ of \d+, sensor 0, seed 5, image: process \d+ on .*nothing to draw with.*Traceback"),
        (has_another_version, r"process \d+ on .* has warp_psdr 0\.0\.1 .*the same versions"),
    ],
)
def test_what_goes_wrong_in_a_worker_is_said_here(client, gap, fault: Callable[[], None], said: str) -> None:
    workers(client)
    client.run(fault)
    try:
        with Pool(client) as pool, pytest.raises(JobError, match=said):
            rendered(pool, gap[0], 4, lambda: None)
    finally:
        client.run(mends)


@pytest.mark.slow
def test_a_job_that_ends_its_worker_is_given_up(client, gap, monkeypatch) -> None:
    workers(client)
    monkeypatch.setattr(jobs, "share", ends)
    with Pool(client) as pool, pytest.raises(JobError, match="ended one worker after the other"):
        rendered(pool, gap[0], 4, lambda: None)


@pytest.mark.slow
def test_a_fit_goes_on_whose_workers_are_killed(client, whole, tmp_path: Path, monkeypatch) -> None:
    config, expected = whole
    interfere(monkeypatch, {4: lambda: kill(workers(client)[:1]), 9: lambda: kill(workers(client))})
    with Pool(client) as pool:
        found = fit(replace(config, output=tmp_path / "out"), pool=pool)
    assert_same_fit(found.output, expected.output)


# -- clusters of their own ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def scheduler(folder: Path, port: int = 0) -> Iterator:
    """Run a scheduler, and give its process and its address."""
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    arguments = ("--host", "127.0.0.1", "--port", port, "--scheduler-file", file, "--no-dashboard")
    with program(folder / "scheduler.txt", "distributed.cli.dask_scheduler", *arguments) as process:
        wait_until(file.exists, "no scheduler")
        with distributed.Client(scheduler_file=str(file)) as client:
            address = client.scheduler.address
        yield process, address


@contextlib.contextmanager
def two_workers(folder: Path, address: str) -> Iterator:
    """Run two workers."""
    arguments = (address, "--nworkers", 2, "--nthreads", 1, "--no-dashboard", "--local-directory", folder)
    with program(folder / "workers.txt", "distributed.cli.dask_worker", *arguments) as process:
        yield process


@pytest.mark.slow
def test_a_fit_whose_scheduler_is_killed_ends_with_a_checkpoint(whole, tmp_path: Path, monkeypatch) -> None:
    config, expected = whole
    begun = replace(config, output=tmp_path / "out")
    with scheduler(tmp_path) as (process, address), two_workers(tmp_path, address):
        with distributed.Client(address, timeout=5) as client, Pool(client) as pool:
            interfere(monkeypatch, {5: process.kill})
            with pytest.raises(JobError, match="Dask does not run the jobs"):
                fit(begun, pool=pool)
            with pytest.raises(JobError, match="its client is closed"):
                fit(begun, resume=True, pool=pool)
    assert len(checkpoint.load(begun.output / CHECKPOINT)[0]["losses"]) == 5
    assert_same_fit(fit(begun, resume=True).output, expected.output)


@pytest.mark.slow
def test_a_fit_goes_on_when_its_scheduler_comes_back(whole, tmp_path: Path, monkeypatch) -> None:
    config, expected = whole
    with scheduler(tmp_path) as (first, address), two_workers(tmp_path, address):
        port = int(address.rpartition(":")[2])

        def restarted() -> None:
            first.kill()
            first.wait()
            stack.enter_context(scheduler(tmp_path, port))
            stack.enter_context(two_workers(tmp_path, address))

        with (
            contextlib.ExitStack() as stack,
            distributed.Client(address, timeout=LONGEST) as client,
            Pool(client) as pool,
        ):
            interfere(monkeypatch, {5: restarted})
            found = fit(replace(config, output=tmp_path / "out"), pool=pool)
            assert pool.report.lost >= 1
    assert_same_fit(found.output, expected.output)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_fit_whose_client_is_ended_resumes(long: Path, tmp_path: Path, number: int) -> None:
    with scheduler(tmp_path) as (_process, address), two_workers(tmp_path, address):
        with running(long, tmp_path / "out", address) as process:
            process.send_signal(number)
            assert process.wait(LONGEST) == (0 if number == signal.SIGINT else -number)
        with distributed.Client(address) as client:
            wait_until(lambda: not client.run_on_scheduler(tasks), "the scheduler keeps jobs that nobody waits for")
            with Pool(client) as pool:
                assert_resumes(long, tmp_path / "out", pool)


def tasks(dask_scheduler) -> int:
    """Return how many tasks a scheduler has."""
    return len(dask_scheduler.tasks)
