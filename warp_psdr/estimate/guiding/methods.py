"""The structure that each method of guiding builds: one function a method, all of one form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from warp_psdr.estimate.guiding import grid, kdtree, octree
from warp_psdr.estimate.guiding.build import Leaves, Target
from warp_psdr.options.guiding import Grid, KdTree, Method, Octree

#: Method -> ``build(method, target) -> Leaves``.
BUILDERS: dict[type[Method], Callable[[Any, Target], Leaves]] = {
    Grid: grid.build,
    KdTree: kdtree.build,
    Octree: octree.build,
}


def build(method: Method, target: Target) -> Leaves:
    """Return leaves that follow the target (one call for each technique)."""
    return BUILDERS[type(method)](method, target)
