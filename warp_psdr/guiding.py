"""Guiding of the boundary term's segments: methods that learn where boundary paths carry light, one object each."""

from warp_psdr.estimate.guiding.store import Guiding, structures
from warp_psdr.options.guiding import Grid, KdTree, Method, Octree
from warp_psdr.plan.guiding import describe, reset, set_automatic

__all__ = ["Grid", "Guiding", "KdTree", "Method", "Octree", "describe", "reset", "set_automatic", "structures"]
