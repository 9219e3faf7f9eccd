"""The kinds of shapes without triangles, a line each, in the order in which their records are told apart."""

import warp as wp

from warp_psdr.kernels.generated import make_switch
from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.kernels.primitive.curve_kinds import CONES, TUBES
from warp_psdr.kernels.primitive.cylinder import CYLINDER
from warp_psdr.kernels.primitive.disk import DISK
from warp_psdr.kernels.primitive.kind import Affine, Kind
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.kernels.primitive.network_kind import NETWORK
from warp_psdr.kernels.primitive.sphere import SPHERE

KINDS: tuple[Kind, ...] = (
    CONES,
    TUBES,
    NETWORK,
    CUBIC_GRID,
    LINEAR_GRID,
    SPHERE,
    DISK,
    CYLINDER,
)


def kinds_of(primitives: tuple[int, ...]) -> list[Kind]:
    """Return the kinds of a scene: those whose numbers are in ``SurfaceConfig.primitives``."""
    return [kind for kind in KINDS if kind.number in primitives]


def affine_of(primitives: tuple[int, ...]) -> dict[int, Affine]:
    """Return the affine kinds of a scene: number -> functions."""
    return {kind.number: kind.affine for kind in kinds_of(primitives) if kind.affine is not None}


def join(
    name: str, functions: dict[int, wp.Function], otherwise: wp.Function | None = None, anchored: bool = False
) -> wp.Function | None:
    """Return the function ``name``, which calls the one of a record's kind; all take the record as ``tri``.

    Args:
        name: of the function.
        functions: number of a kind -> its function.
        otherwise: that of other kinds, and of triangles; None: there are none. The last kind is then not asked for, and
            one alone is returned as it is.
        anchored: some of the functions call ``wp.grad`` (``autodiff.py``).
    """
    return make_switch(name, "tri.i1", {-1 - number: f for number, f in functions.items()}, otherwise, anchored)
