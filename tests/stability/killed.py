"""Runs a fit again and again in processes that are killed at some moment, until it is done; then again from the start.

Run as a program: ``python -m tests.stability.killed FIT.toml KILLS SEED``. Every other process dies right before one of
its Python calls, drawn from all of them, opening, writing, flushing and renaming of files included; the rest are killed
from outside after a time, in the middle of whatever they do. What comes of it must not depend on the moments. The
processes are copies of this one, which has loaded everything and has no threads. A run that was not interrupted is in
the folder "loading" of the output, those that were in "run_0", "run_1", ... The last line says how many.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp

import warp_psdr as psdr
from warp_psdr import plots
from warp_psdr.files import write_atomic
from warp_psdr.fit.run import CHECKPOINT, FitConfig, fit
from warp_psdr.view import viewer

#: Seconds after which a process is killed from outside, at most: some two thirds of a run.
LONGEST = 0.5


def without_drawing() -> None:
    """Write a few bytes where pictures take longer to draw than the rest of these fits."""

    def drawn(path: str, *arguments: object, **options: object) -> None:
        write_atomic(path, lambda file: file.write(b"picture"))

    for name in ("side_by_side", "loss_curve", "derivative_image"):
        setattr(plots, name, drawn)

    def not_drawn(*arguments: object, **options: object) -> None:
        raise RuntimeError("not drawn here")

    viewer.view = not_drawn


def in_copy(work: Callable[[], None], kill_after: float | None = None) -> int:
    """Run ``work`` in a copy of this process and return its exit status, negative: the signal that ended it."""
    copy = os.fork()
    if copy == 0:
        status = 1
        try:
            work()
            status = 0
        finally:
            os._exit(status)
    if kill_after is not None:
        time.sleep(kill_after)
        os.kill(copy, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1])


def profiled(work: Callable[[], None], at_call: int, counted: Path | None = None) -> None:
    """Run ``work`` and die at a call; or write how many there were."""
    calls = 0

    def count(frame: object, event: str, argument: object) -> None:
        nonlocal calls
        if event in ("call", "c_call"):
            calls += 1
            if calls == at_call:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.setprofile(count)
    work()
    sys.setprofile(None)
    if counted is not None:
        counted.write_text(str(calls))


def main(file: str, kills: int, seed: int) -> None:
    """Kill runs ``kills`` times."""
    wp.config.log_level = wp.LOG_WARNING
    psdr.set_workers(1)
    without_drawing()
    config = FitConfig.from_file(file)
    rng = np.random.default_rng(seed)
    base = config.output

    def run(output: Path) -> None:
        fit(replace(config, output=output), resume=True)

    run(base / "loading")  # compiled and loaded once, for all copies
    counted = config.scene.parent / "calls"
    assert in_copy(lambda: profiled(lambda: run(base / "counting"), -1, counted)) == 0
    calls = int(counted.read_text())
    done, runs, resumable, status = 0, 0, 0, 0
    while done < kills or status:
        output = base / f"run_{runs}"
        if (done + runs) % 2 or done >= kills:
            wait = None if done >= kills else float(rng.uniform(0.0, LONGEST))
            status = in_copy(lambda output=output: run(output), wait)
        else:
            at = int(rng.integers(1, calls))
            status = in_copy(lambda output=output, at=at: profiled(lambda: run(output), at))
        assert status in (0, -signal.SIGKILL), status
        done += status != 0
        runs += status == 0
        resumable += status != 0 and (output / CHECKPOINT).exists()
    print(json.dumps({"kills": done, "resumable": resumable, "calls": calls, "runs": runs}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
