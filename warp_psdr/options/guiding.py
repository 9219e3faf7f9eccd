"""Methods of guiding: options, one object each. ``estimate/guiding`` builds the structures of each of them."""

from __future__ import annotations

import math
from abc import ABC
from dataclasses import dataclass

#: Selection probabilities are multiples of 2^-24, so that 2^20 leaves still differ.
MAX_LEAVES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class Method(ABC):  # noqa: B024
    """A way to guide the sampling of boundary segments.

    The estimator stays unbiased whatever a method finds, because a share of the samples is uniform. The structure is
    kept on the scene and reused by later gradients of it (``estimate/guiding/store.py``), so their random errors depend
    on earlier calls; ``guiding.reset(scene)`` forgets it. Equal histories and seeds give equal bits, with any number of
    workers.

    Attributes:
        max_leaves: most leaves of a technique's structure.
        samples: evaluations of the integrand a leaf while it is built, best a multiple of eight.
        floor: share of uniform samples, in (0, 1].
        refresh: evaluations a leaf when a kept structure meets a scene that has changed. If all of them would be more
            than a tenth of the samples, only a part of the leaves is refreshed.
        drift: how far vertices, lights or the camera may move, relative to the scene's radius, before the structure is
            built anew. It is then built as soon as that is cheap beside the samples, and at ten times as far at the
            latest.
    """

    max_leaves: int = 16384
    samples: int = 8
    floor: float = 0.2
    refresh: int = 2
    drift: float = 0.02

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            TypeError: this is no method.
            ValueError: an option out of range.
        """
        if type(self) is Method:
            raise TypeError("guiding.Method is what methods have in common; make one of them")
        for name in ("max_leaves", "samples", "refresh"):
            _check_count(name, getattr(self, name))
        if self.max_leaves > MAX_LEAVES:
            raise ValueError(f"max_leaves: got {self.max_leaves}, expected at most {MAX_LEAVES} (2^20)")
        if not 0.0 < self.floor <= 1.0:
            raise ValueError(f"floor: got {self.floor!r}, expected a share in (0, 1]: without uniform samples is bias")
        if not self.drift >= 0.0:
            raise ValueError(f"drift: got {self.drift!r}, expected a non-negative number (1: the scene's radius)")

    @property
    def label(self) -> str:
        """What the plan calls it."""
        return f"guiding.{type(self).__name__}"


@dataclass(frozen=True, kw_only=True)
class KdTree(Method):
    """Adaptive k-d trees, one for each technique [YLB*22, sections 4 and 5] (options: see ``guiding.Method``).

    Leaves start as slabs of neighbouring edges (``edge_chains.py``). They are split where that lowers the variance
    most, in the middle of the axis that lowers it most. (The paper splits by the difference between corner and
    random values, which are both spikes at the silhouettes of fine meshes.) Densities are linear within leaves.
    """


@dataclass(frozen=True, kw_only=True)
class Octree(Method):
    """Octrees over the cube, one for each technique [ZRJ23, section 5] (more options: see ``guiding.Method``).

    Slabs of neighbouring edges are cut into eight, first where seeds lie, then where their mass is largest. Seeds are
    points where the integrand is large: those of projected path vertices, or else random points.

    Attributes:
        max_depth: most cuts in eight; a cell is never smaller than 2^-max_depth.
    """

    max_depth: int = 16

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        value = self.max_depth
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 24:
            raise ValueError(f"max_depth: got {value!r}, expected an integer in [1, 24]")


@dataclass(frozen=True, kw_only=True)
class Grid(Method):
    """Regular grids over the cube, one for each technique [ZMY*20, section 6.3] (more options: ``guiding.Method``).

    A cell's mass is the product of the radiance and the importance that meet in boundary segments through its points.
    The radiance comes from a k-nearest density estimate of photons at the segments' far ends and from the emission
    there, the importance from one of importons at their near ends. No path is traced for a cell. The published grids
    are [5000, 5, 5, 32] and [2000, 5, 5, 32] cells over edge, direction and light; here the three axes are the cube's.

    Attributes:
        shape: cells along the edges and along the two coordinates of the direction, 2^20 at most.
        photons: number of light paths.
        importons: number of camera paths.
        neighbours: k of the density estimates.
        samples: points of a cell at which radiance and importance are looked up.
    """

    shape: tuple[int, int, int] = (512, 8, 8)
    photons: int = 5000
    importons: int = 5000
    neighbours: int = 20
    samples: int = 8

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        for name in ("photons", "importons", "neighbours"):
            _check_count(name, getattr(self, name))
        if not isinstance(self.shape, tuple) or len(self.shape) != 3:
            raise ValueError(f"shape: got {self.shape!r}, expected three numbers of cells, for example (512, 8, 8)")
        for value in self.shape:
            _check_count("shape", value)
        if math.prod(self.shape) > MAX_LEAVES:
            raise ValueError(f"shape: got {math.prod(self.shape)} cells, expected at most {MAX_LEAVES} (2^20)")


def _check_count(name: str, value) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name}: got {value!r}, expected a positive integer")
