"""Networks of signed distances as a family: cells for the voxels of cubic grids."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels.boundary.silhouette.grid_points import GridItems
from warp_psdr.kernels.primitive.network_kind import NETWORK as DEVICE
from warp_psdr.topology.grid_contacts import require_uncut_grids
from warp_psdr.topology.kinds.family import Family, Streams
from warp_psdr.topology.kinds.grid_silhouettes import camera_eyes, light_eyes
from warp_psdr.topology.kinds.grids import FOREGROUND, PRIMARY, SECONDARY, masses, shown, with_share
from warp_psdr.topology.kinds.network_silhouettes import network_items, network_shapes

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


def _seen(scene: Scene, shapes: list[int], sensor: int, creases: bool | None) -> GridItems | None:
    return shown(network_items(scene, shapes, [camera_eyes(scene, sensor)]))


def _touched(scene: Scene, own_share: float, creases: bool | None) -> GridItems | None:
    eyes = light_eyes(scene)
    return with_share(network_items(scene, network_shapes(scene), eyes), eyes, own_share)


NETWORK = Family(
    touch="network",
    term="network",
    title="networks",
    streams=Streams(33, 34, 35),
    primary=PRIMARY,
    secondary=SECONDARY,
    foreground=FOREGROUND,
    is_in=lambda primitives: DEVICE.number in primitives,
    shapes=network_shapes,
    seen=_seen,
    touched=_touched,
    fronts=lambda scene, _creases: network_items(scene, network_shapes(scene), []),
    require_uncut=require_uncut_grids,
    masses=masses,
    flows=True,
)
