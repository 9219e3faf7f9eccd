"""Runs or resumes a fit in a pool: ``python -m tests.pool.fitting FIT.toml OUTPUT PROCESSES [ENGINE]``.

ENGINE: "local" (default), "executor", or the address of Dask's scheduler.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from tests.pool.cases import assert_same_fit
from tests.pool.children import program, wait_until
from warp_psdr.distributed import Pool
from warp_psdr.fit import checkpoint, report
from warp_psdr.fit.run import CHECKPOINT, FitConfig, fit


def without_pictures(put: Callable[[object, str, object], None]) -> None:
    """Leave out what a fit writes besides its checkpoint, which takes longer than its steps; ``put``: ``setattr``."""
    put(report, "write_start", lambda problem: None)
    put(report, "write_report", lambda problem, losses: ())


def main(file: str, output: str, processes: str, engine: str = "local") -> None:
    """Fit."""
    without_pictures(setattr)
    config = replace(FitConfig.from_file(file), output=Path(output))
    with ExitStack() as stack:
        if engine == "local":
            pool = Pool("local", processes=int(processes))
        elif engine == "executor":
            pool = Pool(stack.enter_context(ProcessPoolExecutor(int(processes))))
        else:
            from distributed import Client

            pool = Pool(stack.enter_context(Client(engine)))
        result = fit(config, resume=True, pool=stack.enter_context(pool))
    print("completed" if result.completed else "stopped")


@contextmanager
def running(file: Path, output: Path, engine: str, steps: int = 3) -> Iterator[subprocess.Popen]:
    """Run a fit in a program, which has made some steps."""
    with program(output.with_suffix(".txt"), "tests.pool.fitting", file, output, 2, engine) as process:
        wait_until(lambda: (output / CHECKPOINT).exists() or process.poll() is not None, "no checkpoint")
        wait_until(lambda: len(checkpoint.load(output / CHECKPOINT)[0]["losses"]) >= steps, "no steps")
        yield process


def assert_resumes(file: Path, output: Path, pool: Pool | None = None) -> None:
    """Fail unless a fit that was stopped has the bits of one that was not, as far as it got."""
    config = FitConfig.from_file(file)
    steps = len(checkpoint.load(output / CHECKPOINT)[0]["losses"]) + 2
    found = fit(replace(config, output=output), iterations=steps, resume=True, pool=pool)
    expected = fit(replace(config, output=output.with_name("undisturbed")), iterations=steps)
    assert_same_fit(found.output, expected.output)


if __name__ == "__main__":
    main(*sys.argv[1:])
