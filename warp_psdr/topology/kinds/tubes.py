"""Curves with a radius as a family: sides, ends and joints of their segments."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.boundary.silhouette.tube_points import TubeItems
from warp_psdr.kernels.primitive.curve_kinds import CURVES
from warp_psdr.topology.kinds.family import Family, Shares, Streams
from warp_psdr.topology.kinds.item_names import curve_names
from warp_psdr.topology.kinds.tube_items import curve_shapes, tube_items
from warp_psdr.topology.tube_contacts import require_uncut_tubes

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


def _touched(scene: Scene, own_share: float, creases: bool | None) -> TubeItems | None:
    found = tube_items(scene, curve_shapes(scene), creases=False)
    if found is not None:
        found.share = own_share
    return found


def _masses(_scene: Scene, found: TubeItems) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the names of the items of both techniques, by their lengths."""
    return dict.fromkeys(("wedge", "light"), (curve_names(found.items.numpy()), np.diff(found.cdf.numpy())))


TUBES = Family(
    touch="tubes",
    term="tubes",
    title="curves",
    streams=Streams(18, 19, 20),
    primary=Shares(1.0 / 6.0, 1.0 / 2.0),
    secondary=Shares(1.0 / 6.0, 1.0),
    foreground=Shares(1.0 / 16.0, 1.0 / 3.0),
    is_in=lambda primitives: bool(set(CURVES) & set(primitives)),
    shapes=curve_shapes,
    seen=lambda scene, shapes, _sensor, _creases: tube_items(scene, shapes, creases=True),
    touched=_touched,
    fronts=lambda scene, _creases: tube_items(scene, curve_shapes(scene), creases=True),
    require_uncut=require_uncut_tubes,
    masses=_masses,
)
