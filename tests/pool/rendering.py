"""Renders in a pool until Ctrl-C: ``python -m tests.pool.rendering``."""

from __future__ import annotations

import signal

from tests.pool.cases import CASES
from warp_psdr.distributed import Pool


def main() -> None:
    """Render."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell lets what it runs in the background ignore it
    scene, _params = CASES["gap"].load()
    with Pool("local", processes=2) as pool:
        try:
            while True:
                pool.render(scene, integrator=CASES["gap"].integrator, spp=64, progress=begun)
        except KeyboardInterrupt:
            pass
    print("interrupted")


def begun(done: float) -> None:
    """Say that a job is done."""
    print("begun", flush=True)


if __name__ == "__main__":
    main()
