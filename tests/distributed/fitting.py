"""Runs or resumes a fit in a pool: ``python -m tests.distributed.fitting FIT.toml OUTPUT PROCESSES [ADDRESS]``.

ADDRESS: of Dask's scheduler; without it the processes are the pool's own.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from warp_psdr.distributed import Pool
from warp_psdr.fit import report
from warp_psdr.fit.run import FitConfig, fit


def without_pictures(put: Callable[[object, str, object], None]) -> None:
    """Leave out what a fit writes besides its checkpoint, which takes longer than its steps; ``put``: ``setattr``."""
    put(report, "write_start", lambda problem: None)
    put(report, "write_report", lambda problem, losses: ())


def main(file: str, output: str, processes: str, address: str = "") -> None:
    """Fit."""
    without_pictures(setattr)
    config = replace(FitConfig.from_file(file), output=Path(output))
    with ExitStack() as stack:
        if address:
            from distributed import Client

            pool = Pool(stack.enter_context(Client(address)))
        else:
            pool = Pool("local", processes=int(processes))
        result = fit(config, resume=True, pool=stack.enter_context(pool))
    print("completed" if result.completed else "stopped")


if __name__ == "__main__":
    main(*sys.argv[1:])
