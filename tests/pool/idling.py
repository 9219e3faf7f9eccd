"""Starts a pool of four processes, of which one has a job: ``python -m tests.pool.idling ENGINE``."""

from __future__ import annotations

import sys
import time
from concurrent.futures import ProcessPoolExecutor

from warp_psdr.distributed import Pool


def main(engine: str) -> None:
    """Wait to be killed."""
    pool = Pool("local", processes=4) if engine == "local" else Pool(ProcessPoolExecutor(4))
    pool.call(sleep).result()


def sleep(_threads: int | None) -> None:
    """Take a process."""
    time.sleep(1000)


if __name__ == "__main__":
    main(*sys.argv[1:])
