"""Ray acceleration structures: builds and updates what ``kernels/bvh`` traverses."""

import functools
import platform
from pathlib import Path

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.kernels.bvh.build import PRIMITIVE_WORDS, binary_words, make_build
from warp_psdr.kernels.bvh.refit import make_refit
from warp_psdr.kernels.bvh.wide import FLAT_PACKETS, NODE_ROWS, PACKET_ROWS, WIDTHS, Accel

#: A refitted tree is built again when its cost exceeds that of the last build by this factor. Measured on a deforming
#: sphere of 10^5 triangles: query times follow the cost (1.19 x the cost, 1.13 x the time), and building takes as long
#: as 3 * 10^5 incoherent queries, far less than a primal pass.
REBUILD_FACTOR = 1.2
#: The bounds are kept relative to a point within this share of the scene's size from its center.
CENTER_TOLERANCE = 0.1
#: Bytes to which nodes and packets are aligned: one cache line, one AVX-512 register.
ALIGNMENT = 64

_BACKENDS = ("auto", "warp", "wide")
_ray_backend = "auto"
_vector_width: int | None = None


def set_ray_backend(name: str) -> None:
    """Choose what traces the rays of scenes made from now on.

    Args:
        name: ``"wide"`` (SIMD BVH, CPU only), ``"warp"`` (``wp.Mesh``) or ``"auto"`` (wide on the CPU, warp on CUDA).

    Raises:
        ValueError: Any other name.
    """
    global _ray_backend
    _ray_backend = _checked(name)


def set_vector_width(width: int | None) -> None:
    """Choose how many numbers vectors hold in the kernels of scenes made from now on, on the CPU.

    The last bits of some sums depend on it. Machines that are to agree to the bit take one width, which need not be
    what their processors have: a processor with AVX2 takes two steps for 16 numbers.

    Args:
        width: 4, 8 or 16; None: what suits this machine's processor (16 with AVX-512, 8 with AVX2, else 4).

    Raises:
        ValueError: Any other number.
    """
    global _vector_width
    if width is not None and (isinstance(width, bool) or width not in WIDTHS):
        raise ValueError(f"vector width: got {width!r}, expected one of {WIDTHS}, or None for this machine's own")
    _vector_width = width


def vector_width() -> int:
    """Return how many numbers vectors hold in the kernels of scenes that are made now."""
    return _vector_width or host_width()


@functools.cache
def host_width() -> int:
    """Return the SIMD lanes (float32) that suit this machine's CPU: 16 with AVX-512, 8 with AVX2, else 4."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:  # not Linux, and no portable way to ask: every x86-64 CPU of the last decade has AVX2
        return 8 if platform.machine().lower() in ("amd64", "x86_64") else 4
    flags = set(text.partition("flags")[2].partition("\n")[0].split())
    if "avx512f" in flags:
        return 16
    return 8 if "avx2" in flags else 4


class Accelerator:
    """The acceleration structure over one triangle mesh.

    Attributes:
        data: What kernels take. ``update`` changes its fields; the object stays the same.
        backend: ``"warp"`` or ``"wide"``.
        width: SIMD lanes of the wide BVH; 1 for ``"warp"``.
        packets: Number of packets of triangles of the wide BVH; 0 for ``"warp"``.
        nbytes: Memory of the wide BVH, bytes; 0 for ``"warp"``, whose memory Warp does not tell.
        cost: Expected node and packet tests of a ray that meets the mesh's box; 0 for ``"warp"``.
    """

    def __init__(
        self,
        points: wp.array,
        indices: wp.array,
        device,
        backend: str | None = None,
        *,
        width: int | None = None,
        built: bool = True,
    ):
        """Build the structure.

        Args:
            points: Vertex positions, vec3, finite. Kept: change them in place, then call ``update``.
            indices: Vertex numbers, flat int32, three a triangle. Kept.
            device: Where the arrays live.
            backend: ``"warp"``, ``"wide"``, ``"auto"`` or None for what ``set_ray_backend`` says.
            width: SIMD lanes of the wide BVH, 4, 8 or 16; None for what ``set_vector_width`` says.
            built: False leaves that to ``rebuild``.

        Raises:
            ValueError: Unknown backend or width, or ``"wide"`` on a CUDA device.
        """
        self._points = points
        self._indices = indices
        self._device = wp.get_device(device)
        name = _checked(_ray_backend if backend is None else backend)
        if name == "auto":
            name = "wide" if self._device.is_cpu else "warp"
        if name == "wide" and not self._device.is_cpu:
            raise ValueError(f"ray backend 'wide' runs on the CPU, got device {self._device}; use 'warp' or 'auto'")
        if width is not None and width not in WIDTHS:
            raise ValueError(f"width {width}: expected one of {WIDTHS}")
        self.backend = name
        self.width = (width or vector_width()) if name == "wide" else 1
        self.data = Accel()
        self.packets = 0
        self.nbytes = 0
        self.cost = 0.0
        self._mesh: wp.Mesh | None = None
        self._faces = len(indices) // 3
        if built:
            self.rebuild()

    def kernels(self) -> tuple[wp.Kernel, ...]:
        """Return the kernels that build and refit: of the wide BVH alone, two of each kind."""
        return (*make_build(self.width), *make_refit(self.width)) if self.backend == "wide" else ()

    def rebuild(self) -> None:
        """Build from scratch, from the current vertex positions."""
        if self._faces == 0:
            return
        if self.backend == "warp":
            constructor = "sah" if self._device.is_cpu else None  # the best tree; on CUDA Warp's own default
            self._mesh = wp.Mesh(self._points, self._indices, bvh_constructor=constructor)
            self.data.mesh_id = self._mesh.id
            return
        n, w = self._faces, self.width
        build, emit, *_refit = self.kernels()
        primitives, counts = _Buffer(n * PRIMITIVE_WORDS), _Buffer(2)
        mesh = [self._points.ptr, self._indices.ptr, n]
        capacity = 4 * n // w + 64
        while True:  # a second round where packets stay half empty
            binary = _Buffer(capacity * binary_words(w))
            launch(build, 1, [*mesh, capacity], [primitives.address, binary.address, counts.address], device="cpu")
            binary_count, self.packets = counts.numpy(np.int32).tolist()
            if binary_count <= capacity:
                break
            capacity = binary_count
        children, leaves = _Buffer(self.packets * w), _Buffer(self.packets * 2)
        launch(emit, 1, [binary.address], [children.address, leaves.address, counts.address], device="cpu")
        self._node_count = int(counts.numpy(np.int32)[0])
        self._nodes = _Buffer(self._node_count * NODE_ROWS * w)
        self._triangles = _Buffer(self.packets * PACKET_ROWS * w)
        self.nbytes = self._nodes.nbytes + self._triangles.nbytes
        self.data.nodes = self._nodes.address
        self.data.packets = self._triangles.address
        self.data.flat = self.packets if self.packets <= FLAT_PACKETS else 0
        self.data.below_root = self.packets if self._node_count == 1 else 0
        self._refit(primitives.address, leaves.address, children.address)
        self._built_cost = self.cost

    def update(self) -> None:
        """Follow a change of the vertex positions in place: refit, or rebuild where that has become too slow."""
        if self._faces == 0:
            return
        if self._mesh is not None:
            self._mesh.refit()
            return
        self._refit()
        if self.cost > REBUILD_FACTOR * self._built_cost:
            self.rebuild()

    def _refit(self, primitives: int = 0, leaves: int = 0, children: int = 0) -> None:
        """Fill packets and nodes from the vertex positions; after a build with the topology at these addresses."""
        *_build, fill, bound = self.kernels()
        mesh = [self._points.ptr, self._indices.ptr]
        packets, nodes, summary = self._triangles.address, self._nodes.address, _Buffer(7)
        launch(fill, 1, [*mesh, primitives, leaves, 0, self.packets], [packets], device="cpu")
        center = np.array(self.data.center, dtype=np.float64)
        for _ in range(2):  # a second round where the mesh has moved away from the center
            inputs = [packets, children, self._node_count, wp.vec3(*center.tolist())]
            launch(bound, 1, inputs, [nodes, summary.address], device="cpu")
            cost, *bounds = summary.numpy(np.float32).tolist()
            lower, upper = np.array(bounds[:3]), np.array(bounds[3:])
            if not np.isfinite(bounds).all():  # nothing but degenerate triangles
                lower = upper = np.zeros(3)
            self.data.center = inputs[-1]
            middle = 0.5 * (lower + upper)
            if np.abs(middle).max() <= CENTER_TOLERANCE * (upper - lower).max():
                break
            center = center + middle
        self.cost = cost
        self.data.extent = float(np.abs([lower, upper]).max())


class _Buffer:
    """Aligned words on the CPU."""

    def __init__(self, words: int):
        self._array = wp.empty(words + ALIGNMENT // 4, dtype=wp.float32, device="cpu")
        self._skip = -self._array.ptr % ALIGNMENT // 4
        self._words = words
        self.address = self._array.ptr + 4 * self._skip
        self.nbytes = 4 * words

    def numpy(self, dtype: type) -> np.ndarray:
        """Return the words as a NumPy array."""
        return self._array.numpy()[self._skip : self._skip + self._words].view(dtype)


def _checked(name: str) -> str:
    if name not in _BACKENDS:
        raise ValueError(f"ray backend {name!r}: expected one of {_BACKENDS}")
    return name
