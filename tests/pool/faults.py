"""What goes wrong: processes that are killed at some moment, and workers that fail."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.pool.cases import GAP
from tests.pool.children import below, wait_until
from warp_psdr import optim
from warp_psdr.distributed import Pool
from warp_psdr.estimate import calls

#: What a share of an image does.
DRAW = calls.ImageCall.draw
VERSIONS = psdr.__version__, wp.config.version


def kill(pids: Collection[int]) -> None:
    """Kill processes below this one, and wait until they are gone."""
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    wait_until(lambda: not below() & set(pids), "killed processes live")


@contextmanager
def none_stays() -> Iterator[None]:
    """Fail if there are more processes afterwards than before."""
    before = below()
    yield
    wait_until(lambda: below() <= before, "processes are left over")


def rendered(pool: Pool, scene: psdr.Scene, spp: int, meanwhile: Callable[[], object]) -> np.ndarray:
    """Return an image; ``meanwhile`` is called when the first of its jobs is done."""
    first = iter([meanwhile])

    def told(_done: float) -> None:
        next(first, lambda: None)()

    return pool.render(scene, integrator=GAP.integrator, spp=spp, seed=5, progress=told).numpy()


def interfere(monkeypatch: pytest.MonkeyPatch, at: dict[int, Callable[[], None]]) -> None:
    """Do something after some steps of fits."""
    step = optim.Adam.step

    def stepped(self: optim.Adam, **options: float) -> None:
        step(self, **options)
        at.get(self.steps, lambda: None)()

    monkeypatch.setattr(optim.Adam, "step", stepped)


def raises() -> None:
    """Make images fail in this process."""

    def draw(*arguments: object, **options: object) -> None:
        raise ArithmeticError("nothing to draw with")

    calls.ImageCall.draw = draw


def ends(*_arguments: object) -> None:
    """End the process, in place of a job."""
    os._exit(3)


def dies() -> None:
    """Make images end this process."""
    calls.ImageCall.draw = ends


def has_another_version() -> None:
    """Give this process another version of the package."""
    psdr.__version__ = "0.0.1"


def has_another_warp() -> None:
    """Give this process another version of Warp."""
    wp.config.version = "0.0.2"


def mends() -> None:
    """Undo all of that."""
    calls.ImageCall.draw = DRAW
    psdr.__version__, wp.config.version = VERSIONS
