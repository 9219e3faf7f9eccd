"""Grids of signed distances as families: linear ones, with creases, and cubic ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.boundary.silhouette.grid_points import GridItems
from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.scene.kinds.zero_set import ZeroSet
from warp_psdr.topology.grid_contacts import require_uncut_grids
from warp_psdr.topology.kinds.family import Family, Shares, Streams
from warp_psdr.topology.kinds.grid_silhouettes import Eyes, camera_eyes, grid_items, grid_shapes, light_eyes, only
from warp_psdr.topology.kinds.item_names import grid_names

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

PRIMARY, SECONDARY, FOREGROUND = Shares(1.0 / 10.0, 1.0 / 4.0), Shares(5.0 / 16.0, 1.0), Shares(1.0 / 16.0, 1.0 / 4.0)
#: Where the surface of either moves: of curves along which interpolated normals turn away.
POSES = Shares(FOREGROUND.pose, FOREGROUND.pose)
#: Share of the segments whose direction is drawn for the item they touch instead of towards a light, at most.
OWN_SHARE = 0.25


def shown(found: GridItems | None) -> GridItems | None:
    """Return those items that an eye may see a silhouette of; None: there are none."""
    if found is None or found.aimed == 0:
        return None
    found.items = found.items[: found.aimed]
    return found


def with_share(found: GridItems | None, eyes: list[Eyes] | None, own_share: float) -> GridItems | None:
    """Return items with the share of the segments that are not aimed at lights, whose places are ``eyes``."""
    if found is not None:
        found.share = 1.0 if found.aimed == 0 or eyes == [] else min(own_share, OWN_SHARE)
    return found


def masses(scene: Scene, found: GridItems) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the names of the items of either technique, each as likely."""
    items = found.items.numpy()
    nodes = {
        int(record): _nodes(scene, scene.builder.primitives[record - scene.face_count]) for record in set(items[:, 0])
    }
    names = grid_names(items, nodes)
    return {t: (names[:n], np.ones(n)) for t, n in (("wedge", len(names)), ("light", found.aimed))}


def _nodes(scene: Scene, shape: int) -> tuple[int, int]:
    """Return the numbers of nodes of a grid, or of a network's cells, along x and y."""
    geometry = scene.geometry(shape)
    assert isinstance(geometry, ZeroSet)
    return geometry.nodes[0], geometry.nodes[1]


def family(*, cubic: bool, touch: str, title: str, streams: Streams, kind: int) -> Family:
    """Return the family of linear or of cubic grids; ``kind``: its number."""

    def items(scene: Scene, shapes: list[int], eyes: list[Eyes] | None, creases: bool | None) -> GridItems | None:
        found = grid_items(scene, shapes, eyes)
        return found if creases is None else only(found, creases)

    def shapes_of(scene: Scene) -> list[int]:
        return grid_shapes(scene, cubic)

    def seen(scene: Scene, shapes: list[int], sensor: int, creases: bool | None) -> GridItems | None:
        return shown(items(scene, shapes, [camera_eyes(scene, sensor)], creases))

    def touched(scene: Scene, own_share: float, creases: bool | None) -> GridItems | None:
        eyes = light_eyes(scene)
        return with_share(items(scene, shapes_of(scene), eyes, creases), eyes, own_share)

    return Family(
        touch=touch,
        term=touch,
        title=title,
        streams=streams,
        primary=PRIMARY,
        secondary=SECONDARY,
        foreground=FOREGROUND,
        is_in=lambda primitives: kind in primitives,
        shapes=shapes_of,
        seen=seen,
        touched=touched,
        fronts=lambda scene, creases: items(scene, shapes_of(scene), [], creases),
        require_uncut=require_uncut_grids,
        masses=masses,
        both=not cubic,
        flows=cubic,
    )


GRID = family(cubic=False, touch="grid", title="grids", streams=Streams(13, 14, 15), kind=LINEAR_GRID.number)
CUBIC = family(cubic=True, touch="cubic", title="cubic grids", streams=Streams(30, 31, 32), kind=CUBIC_GRID.number)
