"""Preconditioners (I + lambda L)^-1 [NJJ21]: of a mesh on position-welded vertices, and of a grid.

[NJJ21] B. Nicolet, A. Jacobson, W. Jakob: Large Steps in Inverse Rendering of Geometry. ACM Trans. Graph. 40(6), 2021.
"""

from __future__ import annotations

import numpy as np

from warp_psdr.topology.edges import WELD, weld

__all__ = ["GridSmoother", "Smoother"]


class Smoother:
    """Solves (I + lambda L) x = b for values at the vertices of a mesh, L its combinatorial Laplacian.

    L = D - A of the graph whose nodes are groups of vertices at one position and whose edges are those of the
    triangles: L is symmetric and L 1 = 0. So the inverse is symmetric, a constant passes it unchanged, and a mesh that
    is split at seams is one graph: all copies of a vertex get the same result and no seam opens. A node without edges,
    such as a vertex of no triangle, passes unchanged.

    Fixed nodes have the value zero: their rows and columns are left out, and the matrix stays positive definite.

    Args:
        points: (N, 3) positions, used to weld only.
        faces: (M, 3) vertex numbers.
        weight: lambda, >= 0, without unit.
        fixed: (N,) mask of the vertices that do not move; a fixed vertex fixes all copies of it.

    Raises:
        ValueError: All vertices are fixed.
    """

    def __init__(self, points: np.ndarray, faces: np.ndarray, weight: float, fixed: np.ndarray | None = None):
        from scipy.sparse import coo_matrix, diags, identity
        from scipy.sparse.linalg import splu

        points = np.asarray(points, np.float64)
        self.group = weld(points, WELD * float(np.abs(points).max()))
        count = int(self.group.max()) + 1
        #: (count,) vertices of every node.
        self.copies = np.bincount(self.group, minlength=count)
        corners = self.group[faces]
        ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
        ends = np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1)
        ends = np.unique(ends, axis=0)  # an edge counts once, however many triangles meet in it
        pairs = np.concatenate([ends, ends[:, ::-1]])
        adjacency = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
        #: (count, count) sparse.
        self.laplacian = (diags(np.asarray(adjacency.sum(axis=1)).reshape(-1)) - adjacency).tocsr()
        self._free = np.ones(count, bool)
        if fixed is not None:
            self._free[self.group[fixed]] = False
        if not self._free.any():
            raise ValueError("all vertices are fixed, which leaves nothing to optimise; free some of them")
        matrix = (identity(count, format="csr") + weight * self.laplacian)[self._free][:, self._free]
        # Symmetric positive definite: a minimum-degree order of A + A^T without pivoting is a Cholesky factorisation
        # in all but name, and keeps the factor sparse.
        self._factor = splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Sum values (N, C) over the copies of every node: (count, C), float64. The transpose of ``scatter``."""
        columns = [np.bincount(self.group, weights=c, minlength=len(self._free)) for c in np.asarray(values).T]
        return np.stack(columns, axis=1)

    def scatter(self, values: np.ndarray) -> np.ndarray:
        """Give every vertex the value of its node: (count, C) to (N, C)."""
        return values[self.group]

    def solve(self, values: np.ndarray) -> np.ndarray:
        """Return (I + lambda L)^-1 of values at the nodes (count, C), zero at fixed nodes; float64."""
        result = np.zeros(values.shape)
        result[self._free] = self._factor.solve(np.ascontiguousarray(values[self._free], np.float64))
        return result


class GridSmoother:
    """Solves (I + lambda L) x = b for values at the nodes of a grid, L the Laplacian of neighbours along its axes.

    As for meshes L = D - A of a graph, here of a grid whose border has no neighbours beyond: the discrete cosine
    transform turns it into factors 2 - 2 cos(pi k / n) along each axis, so it is solved exactly, without a matrix.

    Args:
        shape: of the grid, (Z, Y, X).
        weight: lambda, >= 0, without unit.
    """

    def __init__(self, shape: tuple[int, ...], weight: float):
        self._shape = shape
        #: (count, ) one: every node is itself.
        self.copies = np.ones(int(np.prod(shape)))
        factors = np.zeros(shape)
        for axis, n in enumerate(shape):
            along = 2.0 - 2.0 * np.cos(np.pi * np.arange(n) / n)
            factors += along.reshape([-1 if k == axis else 1 for k in range(len(shape))])
        self._factors = 1.0 / (1.0 + weight * factors)

    def gather(self, values: np.ndarray) -> np.ndarray:
        """Return values of the nodes in one column, (count, 1), float64."""
        return np.asarray(values, np.float64).reshape(-1, 1)

    def scatter(self, values: np.ndarray) -> np.ndarray:
        """Return the values of the nodes, in one column as they are."""
        return values

    def solve(self, values: np.ndarray) -> np.ndarray:
        """Return (I + lambda L)^-1 of values at the nodes (count, 1); float64."""
        from scipy.fft import dctn, idctn

        modes = dctn(values.reshape(self._shape), type=2, norm="ortho")
        return np.asarray(idctn(modes * self._factors, type=2, norm="ortho")).reshape(-1, 1)
