"""Guiding of the boundary term's segments: methods that learn where boundary paths carry light, one object each."""

from warp_psdr.guiding.grid import Grid
from warp_psdr.guiding.kdtree import KdTree
from warp_psdr.guiding.methods import Method
from warp_psdr.guiding.octree import Octree
from warp_psdr.guiding.store import Guiding, describe, reset, structures

__all__ = ["Grid", "Guiding", "KdTree", "Method", "Octree", "describe", "reset", "structures"]
