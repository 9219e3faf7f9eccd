"""Interior term by radiative backpropagation [NDSRJ20]: adjoint paths that estimate the light at every vertex anew.

A camera path carries the adjoint of the image, alpha_n = A_n . delta. At each of its vertices the derivative of the
scattering factor is multiplied by L_{n+1}, the radiance from the direction drawn there. A new path from that vertex, in
the same direction with other random numbers, estimates L_{n+1}:

    dI = sum_n alpha_n (dE_n + dD_n + dbeta_n L_{n+1}).

Nothing is kept and nothing divided, so the derivative of a factor that is exactly zero is not lost. A path of N
vertices costs N more paths, of N - 1, N - 2, ... vertices: time grows with the square of the depth. ``linear`` sets
every L_{n+1} to 1, which is biased: dark paths count as bright ones.

Derivation: ``docs/methods/radiative.md``.
"""

import functools

import warp as wp

from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.path_order import Behind, make_path_order_kernel
from warp_psdr.kernels.path import make_path_radiance
from warp_psdr.kernels.rng import Sampler, salted
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig, PathState

#: Tells the random numbers of the paths from the vertices from those of the path through them.
SALT = wp.constant(wp.uint32(0xBB67AE85))


@functools.cache
def make_radiative_kernel(config: PathConfig, wanted: GradientRequest, role: str, linear: bool):
    """Return the kernel of ``interior.Radiative()``; other arguments as ``make_replay_kernel``'s.

    ``linear``: its biased form.
    """
    path_radiance = make_path_radiance(config)

    @wp.func
    def estimated(
        scene: Scene, sampler: Sampler, state: PathState, remaining: wp.vec3, throughput: wp.vec3,
        max_depth: wp.int32, rr_depth: wp.int32,
    ) -> wp.vec3:  # fmt: skip
        """What another path finds."""
        if wp.static(linear):
            return wp.vec3(1.0, 1.0, 1.0)
        else:
            return path_radiance(scene, salted(sampler, SALT, state.depth), state, max_depth, rr_depth)

    return make_path_order_kernel(config, wanted, role, Behind(estimated, False))
