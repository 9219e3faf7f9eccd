"""The families of shapes without triangles that have silhouettes; a new one is a file and a place in the list.

A new exact kind needs no place: it belongs to ``EXACT``.
"""

from __future__ import annotations

from warp_psdr.topology.kinds.exact import EXACT
from warp_psdr.topology.kinds.family import Family
from warp_psdr.topology.kinds.grids import CUBIC, GRID
from warp_psdr.topology.kinds.networks import NETWORK
from warp_psdr.topology.kinds.tubes import TUBES

FAMILIES: tuple[Family, ...] = (EXACT, GRID, TUBES, CUBIC, NETWORK)
