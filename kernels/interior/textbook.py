"""Interior term by textbook path replay [VSJ21]: nothing kept, everything divided. For comparison.

A first pass computes L of the sample. The second one traces the same path again and subtracts what it meets, so that
the remaining radiance after vertex n is R_n = A_{n+1} . L_{n+1}; the derivative of beta_n then is R_n dbeta_n / beta_n.
Where a component of the throughput is 0 the quotient is lost, and with it the derivative of a factor that is exactly
zero: this is the textbook's bias, which ``kernels/interior/replay.py`` does not have.

The vertices are met in the order of the path: ``path_order.py``.
"""

import functools

import warp as wp

from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.path_order import Behind, make_path_order_kernel
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig, PathState


@wp.func
def safe_quotient(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Componentwise a / b; 0 where b is 0."""
    return wp.vec3(
        wp.where(b[0] != 0.0, a[0] / b[0], 0.0),
        wp.where(b[1] != 0.0, a[1] / b[1], 0.0),
        wp.where(b[2] != 0.0, a[2] / b[2], 0.0),
    )


@functools.cache
def make_textbook_kernel(config: PathConfig, wanted: GradientRequest, role: str):
    """Return the kernel of ``interior.Textbook()``; arguments as ``make_replay_kernel``'s."""

    @wp.func
    def divided(
        scene: Scene, sampler: Sampler, state: PathState, remaining: wp.vec3, throughput: wp.vec3,
        max_depth: wp.int32, rr_depth: wp.int32,
    ) -> wp.vec3:  # fmt: skip
        """What the path finds from the next vertex on, over the throughput there."""
        return safe_quotient(remaining, throughput)

    return make_path_order_kernel(config, wanted, role, Behind(divided, True))
