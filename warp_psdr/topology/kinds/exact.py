"""Exact shapes of all affine kinds as a family: their outlines and rims."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels.boundary.silhouette.exact_touch import OutlineItems
from warp_psdr.kernels.boundary.silhouette.point import OutlineItem
from warp_psdr.kernels.primitive.table import affine_of
from warp_psdr.options.boundary import PathSpace, Projective
from warp_psdr.topology.absent import there
from warp_psdr.topology.kinds.exact_shapes import exact_shapes, require_uncut
from warp_psdr.topology.kinds.family import EQUAL, Family, Streams
from warp_psdr.topology.kinds.joined_rims import outlines

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


def _items(scene: Scene, shapes: list[int], share: float) -> OutlineItems | None:
    """Return the outlines of some shapes."""
    found = outlines(scene, frozenset(shapes))
    if not found:
        return None
    items = OutlineItems()
    items.items = wp.array(np.array(found, OutlineItem.numpy_dtype()), dtype=OutlineItem, device=scene.device)
    items.share = share
    return items


def _require_uncut(scene: Scene, sensor: int, shapes: list[int]) -> None:
    """Raise if a clip plane cuts one of some shapes; where none has an outline of its own, none is looked at."""
    if outlines(scene, frozenset(shapes)):
        require_uncut(scene, sensor, frozenset(shapes))


EXACT = Family(
    touch="exact",
    term="silhouette",
    title="exact shapes",
    streams=Streams(primary=9, secondary=10),
    primary=EQUAL,
    secondary=EQUAL,
    is_in=lambda primitives: bool(affine_of(primitives)),
    shapes=exact_shapes,
    seen=lambda scene, shapes, _sensor, _creases: _items(scene, shapes, 1.0),
    touched=lambda scene, own_share, _creases: _items(scene, there(scene, exact_shapes(scene)), own_share),
    require_uncut=_require_uncut,
    in_media=True,
    methods=(PathSpace, Projective),
)
