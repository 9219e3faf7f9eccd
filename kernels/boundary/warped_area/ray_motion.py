"""The motion of rays that a method uses: that of weighted auxiliary rays, or rotations."""

import functools

from warp_psdr.kernels.boundary.warped_area.auxiliary import WarpedOptions
from warp_psdr.kernels.boundary.warped_area.rotation import RotationOptions, make_rotation_motion
from warp_psdr.kernels.boundary.warped_area.warp_motion import WarpMotions, make_warp_motion
from warp_psdr.kernels.vertex import RayConfig


@functools.cache
def make_ray_motion(
    rays: RayConfig, primitives: tuple[int, ...], options: WarpedOptions | RotationOptions, role: str
) -> WarpMotions:
    """Return the functions of a scene of meshes."""
    if isinstance(options, RotationOptions):
        return make_rotation_motion(rays, primitives, options, role)
    return make_warp_motion(rays, primitives, options, role)
