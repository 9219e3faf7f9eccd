"""Warp modules that fixed kernels share: every run of the compiler costs as much as a small kernel.

A module is compiled whole, so kernels share one where who needs one needs most of them. All files of a module are
imported with ``warp_psdr``; a kernel that joins later changes the module's name in the cache.
"""

#: Builds a scene's records and finishes images and gradients.
SCENE = "warp_psdr.scene"
#: Pulls gradients back from vertices and normals to what they are computed from.
DERIVED_VJP = "warp_psdr.derived_vjp"
#: The same in forward mode.
DERIVED_JVP = "warp_psdr.derived_jvp"
#: Finds where triangles meet.
PAIRS = "warp_psdr.pairs"
