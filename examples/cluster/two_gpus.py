"""Renders views on all GPUs of a machine, one Dask worker for each.

    python examples/cluster/two_gpus.py

Needs CUDA GPUs and dask-cuda: ``pip install 'warp-psdr[cluster]' dask-cuda``. Every worker sees a GPU of its own as
``cuda:0``. A scene that is loaded on ``cuda:0`` here is therefore rendered on all of them. Sums on a GPU are atomic, so
two runs differ by rounding. Leaves ``out/cluster/gpus.png``.
"""

from __future__ import annotations

from pathlib import Path

import warp as wp

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[2]


def main(folder: Path = ROOT / "out" / "cluster", *, resolution: int = 512, spp: int = 1024) -> psdr.distributed.Report:
    """Render the Cornell box on all GPUs, write the picture and return what the pool has done.

    Raises:
        SystemExit: dask-cuda or a GPU is missing.
    """
    try:
        from dask_cuda import LocalCUDACluster
        from distributed import Client
    except ImportError as error:
        raise SystemExit(f"{error}: this example needs dask-cuda; pip install 'warp-psdr[cluster]' dask-cuda") from None
    if wp.get_cuda_device_count() == 0:
        raise SystemExit("this example needs an NVIDIA GPU; examples/cluster/local_cluster.py uses the CPU's cores")
    folder.mkdir(parents=True, exist_ok=True)
    scene = psdr.load_file(psdr.scenes.cornell_box, resolution=resolution, device="cuda:0")
    with LocalCUDACluster() as cluster, Client(cluster) as client, psdr.distributed.Pool(client) as pool:
        psdr.write_image(folder / "gpus.png", pool.render(scene, spp=spp))
        return pool.report


if __name__ == "__main__":  # Dask's workers import this file, too
    print(main())
