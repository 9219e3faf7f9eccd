"""Renders on the workers of a Dask cluster, and finds the colours of two walls there.

    python examples/cluster/local_cluster.py             # starts a cluster of processes on this machine
    python examples/cluster/local_cluster.py tcp://...   # takes the cluster of this scheduler

A call of the pool has the bits of the same call without it, for any number of workers; the example checks this for the
first image. Needs Dask: ``pip install 'warp-psdr[cluster]'``. Leaves ``out/cluster/walls.png``: sought, start, found.
"""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

import numpy as np

import warp_psdr as psdr
from warp_psdr import plots

ROOT = Path(__file__).resolve().parents[2]
WALLS = ("red.reflectance.value", "green.reflectance.value")
#: Colour that both walls start from.
START = 0.3


def main(
    folder: Path = ROOT / "out" / "cluster",
    *,
    scheduler: str | None = None,
    workers: int = 2,
    resolution: int = 64,
    steps: int = 12,
    spp: int = 16,
) -> dict[str, float]:
    """Find the colours, write the picture and return the largest error of each wall."""
    from distributed import Client, LocalCluster

    folder.mkdir(parents=True, exist_ok=True)
    scene = psdr.load_file(psdr.scenes.cornell_box, resolution=resolution)
    params = psdr.traverse(scene)
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            # One thread a worker: a job has all threads of its process, so two jobs in a process wait for each other.
            cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0")
            client = stack.enter_context(Client(stack.enter_context(cluster)))
            pool = stack.enter_context(psdr.distributed.Pool(client, threads=1))
        else:
            client = stack.enter_context(Client(scheduler))
            pool = stack.enter_context(psdr.distributed.Pool(client))

        sought = pool.render(scene, spp=16 * spp).numpy()
        print("bits of one process:", np.array_equal(sought, psdr.render(scene, spp=16 * spp).numpy()))
        truth = {name: params[name].numpy().copy() for name in WALLS}
        for name in WALLS:
            params[name] = np.full_like(truth[name], START)
        params.update()
        start = pool.render(scene, spp=16 * spp).numpy()

        params.requires_grad(*WALLS)
        optimizer = psdr.optim.Adam(params, lr=0.05)
        for step in range(steps):
            image = pool.render(scene, spp=spp, seed=2 * step + 1).numpy()
            adjoint = 2.0 * (image - sought) / image.size  # derivative of the mean square by the image
            pool.render_backward(scene, params, adjoint.astype(np.float32), spp=spp, seed=2 * step + 2)
            optimizer.step()
            print(f"step {step:2}  loss {np.mean((image - sought) ** 2):.5f}", flush=True)
        found = pool.render(scene, spp=16 * spp).numpy()
        print(pool.report)
    plots.side_by_side(folder / "walls.png", [sought, start, found], ["sought", "start", "found"], columns=3)
    return {name: float(np.abs(params[name].numpy() - truth[name]).max()) for name in WALLS}


if __name__ == "__main__":  # Dask's workers import this file, too
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scheduler", nargs="?", help="its address, tcp://host:8786; default: a cluster of this machine")
    parser.add_argument("--output", type=Path, default=ROOT / "out" / "cluster", help="folder of the picture")
    parser.add_argument("--steps", type=int, default=12)
    options = parser.parse_args()
    print(main(options.output, scheduler=options.scheduler, steps=options.steps))
