"""What tests of pools share: a bound on their time, and one Dask cluster a file."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.pool import fitting
from tests.pool.cases import GAP, answers, fit_of_two_views
from warp_psdr.fit.run import FitConfig, FitResult, fit

#: Seconds after which a test that hangs fails; others take a tenth at most.
BOUND = 300


@pytest.fixture(autouse=True)
def bounded() -> Iterator[None]:
    """End a test that hangs."""

    def late(number: int, frame: object) -> None:
        raise TimeoutError(f"the test was not done after {BOUND} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(BOUND)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def client() -> Iterator:
    """Return Dask's client of a cluster of processes on this machine."""
    dask, distributed = pytest.importorskip("dask"), pytest.importorskip("distributed")
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": True, "dashboard_address": ":0"}
    # Else a cluster closes a worker for good that starts anew when one of its name was lost 15 s before.
    kept = dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"})
    with kept, distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        yield client


@pytest.fixture(scope="module")
def gap():
    """Return a scene, its parameters, and all that one process finds."""
    scene, params = GAP.load()
    return scene, params, answers(GAP, scene, params)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[FitConfig, FitResult]:
    """Return a fit's configuration, and its result in one process, undisturbed."""
    config = FitConfig.from_file(fit_of_two_views(tmp_path_factory.mktemp("fit") / "files"))
    with pytest.MonkeyPatch.context() as patch:
        fitting.without_pictures(patch.setattr)
        return config, fit(replace(config, output=config.output / "whole"))


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a fit that nobody waits for."""
    return fit_of_two_views(tmp_path_factory.mktemp("long") / "files", 100000)


@pytest.fixture(autouse=True)
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let fits write nothing but checkpoints."""
    fitting.without_pictures(monkeypatch.setattr)
