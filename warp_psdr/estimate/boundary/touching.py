"""Segments between two path vertices that touch shapes without triangles, or edges in media: guided, or not."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

from warp_psdr import compiler
from warp_psdr.estimate.guiding import store
from warp_psdr.estimate.guiding.grid import surface_ends
from warp_psdr.estimate.guiding.structure import Space
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.options.guiding import Grid

if TYPE_CHECKING:
    from warp_psdr.estimate.boundary.terms import Request

#: Pieces, about, that the first coordinate is cut into before anything is known of the integrand, whatever the number
#: of shapes: a single one is measured in as many places as a mesh's edges are.
PIECES = 1024


class Maker(Protocol):
    """A factory of kernels with the scene, the camera and the indirect flag of a request."""

    def __call__(self, role: str, camera_moves: bool, light_pose: bool, guided: bool) -> wp.Kernel:
        """Return the kernel."""


def guided_kernel(
    r: Request, name: str, make: Maker, head: list, items: int, cdf: np.ndarray | None = None
) -> tuple[wp.Kernel, Guide]:
    """Return the kernel of a term of shapes without triangles, or of edges in media, and what guides it.

    Args:
        r: what is asked for.
        name: of the term.
        make: its kernels.
        head: their arguments in front of the guide.
        items: among which the first coordinate chooses.
        cdf: (items + 1,) where they begin along it; None: all have the same share of it.
    """
    guiding = getattr(r.method, "guiding", None)
    kernel = make(r.role, r.moves.camera, r.moves.light_pose, guiding is not None)
    if guiding is None:
        return kernel, Guide()
    evaluating = [make(role, False, False, False) for role in ("target", "ends")[: 1 + isinstance(guiding, Grid)]]
    compiler.begin([*evaluating, kernel], r.scene.device)
    pieces = items * -(-PIECES // items)
    space = Space(
        kernel=evaluating[0],
        head=head,
        cdf=np.linspace(0.0, 1.0, pieces + 1) if cdf is None else cdf,
        facing=None,
        ends=lambda technique, points: surface_ends(r, evaluating[-1], head, technique, points),
    )
    return kernel, store.guide_surfaces(r, guiding, name, space)
