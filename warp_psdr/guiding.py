"""Guiding of the boundary term's segments: methods that learn where boundary paths carry light, one object each."""

from warp_psdr.estimate.guiding.grid import Grid
from warp_psdr.estimate.guiding.kdtree import KdTree
from warp_psdr.estimate.guiding.methods import Method
from warp_psdr.estimate.guiding.octree import Octree
from warp_psdr.estimate.guiding.store import Guiding, describe, reset, structures

__all__ = ["Grid", "Guiding", "KdTree", "Method", "Octree", "describe", "reset", "structures"]
