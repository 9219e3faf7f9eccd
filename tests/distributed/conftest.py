"""What tests of pools share: a bound on their time, and one Dask cluster a file."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

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
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        yield client
