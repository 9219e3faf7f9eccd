"""Ray acceleration structures: builds and updates what ``kernels/bvh`` traverses."""

import platform
from pathlib import Path

import numpy as np
import warp as wp

from warp_psdr.kernels.bvh.build import PRIMITIVE_WORDS, binary_words, make_build
from warp_psdr.kernels.bvh.wide import FLAT_PACKETS, NODE_ROWS, PACKET_ROWS, Accel

#: A refitted tree is rebuilt when its cost exceeds that of the last build by this factor.
REBUILD_FACTOR = 1.5
#: Bytes to which nodes and packets are aligned: one cache line, one AVX-512 register.
ALIGNMENT = 64

_BACKENDS = ("auto", "warp", "wide")
_ray_backend = "auto"


def set_ray_backend(name: str) -> None:
    """Choose what traces the rays of scenes made from now on.

    Args:
        name: ``"wide"`` (SIMD BVH, CPU only), ``"warp"`` (``wp.Mesh``) or ``"auto"`` (wide on the CPU, warp on CUDA).
    """
    global _ray_backend
    if name not in _BACKENDS:
        raise ValueError(f"ray backend {name!r}: expected one of {_BACKENDS}")
    _ray_backend = name


def host_width() -> int:
    """Return the SIMD width of the host's CPU in float32 lanes: 16 with AVX-512, 8 with AVX, else 4."""
    try:
        flags = set(Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").partition("flags")[2].split("\n")[0].split())
    except OSError:
        return 8 if platform.machine().lower() in ("amd64", "x86_64") else 4
    if {"avx512f", "avx512vl", "avx512dq"} <= flags:
        return 16
    return 8 if "avx2" in flags else 4


class _Buffer:
    """Aligned float32 words on the CPU."""

    def __init__(self, words: int):
        self._array = wp.empty(words + ALIGNMENT // 4, dtype=wp.float32, device="cpu")
        self.address = -(-self._array.ptr // ALIGNMENT) * ALIGNMENT
        self.nbytes = 4 * words

    def numpy(self, dtype, count: int) -> np.ndarray:
        offset = (self.address - self._array.ptr) // 4
        return self._array.numpy()[offset : offset + count].view(dtype)


class Accelerator:
    """The acceleration structure over one triangle mesh.

    Attributes:
        data: What kernels take. Its fields change with ``update``; the object stays the same.
        backend: ``"warp"`` or ``"wide"``.
        width: SIMD lanes of the wide BVH; 1 for ``"warp"``.
        nbytes: Memory of the wide BVH; 0 for ``"warp"``, whose memory Warp does not tell.
    """

    def __init__(self, points, indices, device, backend: str | None = None, *, width: int | None = None):
        """Build the structure.

        Args:
            points: Vertex positions, ``wp.array`` of vec3, finite. Kept; change in place and call ``update``.
            indices: Vertex numbers, flat ``wp.array`` of int32, three a triangle.
            device: Where the arrays live.
            backend: ``"warp"``, ``"wide"`` or None for what ``set_ray_backend`` says.
            width: SIMD lanes of the wide BVH; None for the host's.

        Raises:
            ValueError: Unknown backend, or ``"wide"`` on a CUDA device.
        """
        self._points = points
        self._indices = indices
        self._device = wp.get_device(device)
        name = backend or _ray_backend
        if name not in _BACKENDS:
            raise ValueError(f"ray backend {name!r}: expected one of {_BACKENDS}")
        if name == "auto":
            name = "wide" if self._device.is_cpu else "warp"
        if name == "wide" and not self._device.is_cpu:
            raise ValueError(f"ray backend 'wide' runs on the CPU only, got device {self._device}; use 'warp' or 'auto'")
        self.backend = name
        self.width = (width or host_width()) if name == "wide" else 1
        self.data = Accel()
        self.nbytes = 0
        self._faces = len(indices) // 3
        if self._faces:
            self.rebuild()

    def rebuild(self) -> None:
        """Build from scratch, from the current vertex positions."""
        if self.backend == "warp":
            constructor = "sah" if self._device.is_cpu else None
            self._mesh = wp.Mesh(self._points, self._indices, bvh_constructor=constructor)
            self.data.mesh_id = self._mesh.id
            return
        n, w = self._faces, self.width
        build, emit, _ = make_build(w)
        corners = self._points.numpy()[self._indices.numpy()]
        center = 0.5 * (corners.min(axis=0).astype(np.float64) + corners.max(axis=0))
        self.data.center = wp.vec3(*center.astype(np.float32).tolist())
        primitives = _Buffer(n * PRIMITIVE_WORDS)
        counts = _Buffer(2)
        capacity = 4 * n // w + 64
        while True:
            work = _Buffer(capacity * binary_words(w))
            mesh = [self._points.ptr, self._indices.ptr]
            wp.launch(build, 1, [*mesh, primitives.address, n, work.address, capacity, counts.address], device="cpu")
            binary_count, self._packet_count = (int(k) for k in counts.numpy(np.int32, 2))
            if binary_count <= capacity:
                break
            capacity = binary_count
        children = _Buffer(self._packet_count * w)
        leaves = _Buffer(2 * self._packet_count)
        wp.launch(emit, 1, [work.address, children.address, leaves.address, counts.address], device="cpu")
        self._node_count = int(counts.numpy(np.int32, 1)[0])
        self._nodes = _Buffer(self._node_count * NODE_ROWS * w)
        self._packets = _Buffer(self._packet_count * PACKET_ROWS * w)
        self.nbytes = self._nodes.nbytes + self._packets.nbytes
        self._refit(primitives.address, leaves.address, children.address)
        self._built_cost = self.cost

    def update(self) -> None:
        """Follow a change of the vertex positions in place: refit, or rebuild where that has become too slow."""
        if not self._faces:
            return
        if self.backend == "warp":
            self._mesh.refit()
            return
        self._refit()
        if self.cost > REBUILD_FACTOR * self._built_cost:
            self.rebuild()

    def _refit(self, primitives: int = 0, leaves: int = 0, children: int = 0) -> None:
        """Fill packets and nodes from the vertex positions, with the topology at the given addresses after a build."""
        *_, refit = make_build(self.width)
        summary = _Buffer(7)
        wp.launch(
            refit,
            dim=1,
            inputs=[
                self._points.ptr,
                self._indices.ptr,
                primitives,
                leaves,
                self._packets.address,
                self._packet_count,
                self._nodes.address,
                self._node_count,
                children,
                self.data.center,
                summary.address,
            ],
            device="cpu",
        )
        values = summary.numpy(np.float32, 7)
        self.cost = float(values[0])
        extent = np.abs(values[1:]).max()
        self.data.extent = float(extent) if np.isfinite(extent) else 0.0
        self.data.nodes = self._nodes.address
        self.data.packets = self._packets.address
        self.data.flat = self._packet_count if self._faces <= FLAT_PACKETS * self.width else 0
