"""Files of sparse grids: NanoVDB (``.nvdb``), read as dense grids by ``wp.Volume``.

A sparse grid has values at integer places, and a matrix from these to the world. It becomes the smallest dense grid
that holds all of its voxels that are not zero; a voxel reaches half a step to each side of its place, as in ``.vol``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.kernels.medium.nanovdb import dense_floats, dense_vectors
from warp_psdr.scene.files.volume_files import MOST_VALUES
from warp_psdr.startup import start_warp

#: Type of values -> the kernel that reads them, and what it writes.
_READERS = {"float": (dense_floats, wp.float32), "Vec3f": (dense_vectors, wp.vec3)}


def read_nvdb(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of the first grid of a ``.nvdb`` file, (Z, Y, X, C) float32, and the matrix to its box.

    The matrix takes the unit cube to the box of the voxels in the world.

    Raises:
        ValueError: it is none, is compressed by what is not installed, has values that are neither floats nor
            3-vectors, holds nothing but zeros, or spans more than ``MOST_VALUES`` values.
    """
    start_warp()
    try:
        volume = wp.Volume.load_from_nvdb(file.read_bytes(), device="cpu")
    except Exception as problem:  # also struct.error and zlib.error, of what is cut off
        raise ValueError(f"'{file.name}' is not read as NanoVDB: {problem}") from None
    info = volume.get_grid_info()
    if info.type_str not in _READERS:
        raise ValueError(
            f"'{file.name}' holds a grid of type '{info.type_str}'; write one of: {', '.join(sorted(_READERS))}"
        )
    voxels = np.asarray(volume.get_voxels())
    if len(voxels) == 0:
        raise ValueError(f"'{file.name}' holds no voxels; write a grid with values")
    low, high = voxels.min(axis=0), voxels.max(axis=0) + 1
    kernel, dtype = _READERS[info.type_str]
    channels = 3 if dtype is wp.vec3 else 1
    sizes = [int(n) for n in (high - low)]
    if sizes[0] * sizes[1] * sizes[2] * channels > MOST_VALUES:
        raise ValueError(
            f"'{file.name}' spans {' x '.join(map(str, sizes))} voxels of {channels} channels; at most {MOST_VALUES} "
            "values are read: cut the grid, or give fewer voxels"
        )
    dense = wp.empty(sizes[::-1], dtype=dtype, device="cpu")
    launch(kernel, dense.shape, [volume.id, wp.vec3i(*(int(i) for i in low))], [dense], device="cpu")
    values = dense.numpy().reshape(*dense.shape, channels)
    held = (values != 0.0).any(axis=3)
    if not held.any():
        raise ValueError(f"'{file.name}' holds nothing but zeros; write a grid with values")
    planes = [np.flatnonzero(held.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    first, last = (np.array([along[end] for along in planes]) for end in (0, -1))
    last += 1
    values = values[first[0] : last[0], first[1] : last[1], first[2] : last[2]]
    begin, size = low + first[::-1], (last - first)[::-1]
    to_world, box = np.eye(4), np.eye(4)
    to_world[:3, :3] = np.array(info.transform_matrix).reshape(3, 3)
    to_world[:3, 3] = info.translation
    box[:3, :3] = np.diag(size)
    box[:3, 3] = begin - 0.5
    return values, to_world @ box
