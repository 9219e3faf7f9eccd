"""Many processes and machines: calls, fits and comparisons on Dask or any executor, with the bits of one process.

.. code-block:: python

    with psdr.distributed.Pool("local") as pool:  # or Pool(Client("tcp://...")), Pool(ProcessPoolExecutor(4))
        image = pool.render(scene, spp=4096)
"""

from warp_psdr.distributed.jobs import JobError
from warp_psdr.distributed.pool import Pool
from warp_psdr.distributed.traffic import Report

__all__ = ["JobError", "Pool", "Report"]
