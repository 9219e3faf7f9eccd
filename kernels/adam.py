"""One step of the optimiser Adam [KB15] with projection to the valid range, and the check of the gradient before it.

[KB15] D. P. Kingma, J. Ba: Adam: A Method for Stochastic Optimization. ICLR 2015, algorithm 1.
"""

import functools

import warp as wp

from warp_psdr.kernels.modules import wide_vectors


@functools.cache
def make_adam(mask_updates: bool):
    """Make the kernel of one step; with ``mask_updates`` entries of zero gradient keep their value and moments."""

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def adam(
        # In:
        gradient: wp.array(dtype=wp.float32),
        learning_rate: wp.float32,
        beta_1: wp.float32,
        beta_2: wp.float32,
        correction_1: wp.float32,  # 1 - beta_1^t
        correction_2: wp.float32,  # 1 - beta_2^t
        epsilon: wp.float32,
        low: wp.float32,
        high: wp.float32,
        # Out:
        m_out: wp.array(dtype=wp.float32),
        v_out: wp.array(dtype=wp.float32),
        value_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        g = gradient[i]
        if wp.static(mask_updates):
            if g == 0.0:
                return
        m = beta_1 * m_out[i] + (1.0 - beta_1) * g
        v = beta_2 * v_out[i] + (1.0 - beta_2) * g * g
        m_out[i] = m
        v_out[i] = v
        step = learning_rate * (m / correction_1) / (wp.sqrt(v / correction_2) + epsilon)
        value_out[i] = wp.clamp(value_out[i] - step, low, high)

    return adam


@functools.cache
def make_count_unusable():
    """Make the kernel that counts the entries of a gradient whose square, which Adam takes, is not finite."""

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def count_unusable(
        # In:
        gradient: wp.array(dtype=wp.float32),
        index: wp.int32,
        # Out:
        count_out: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        if not wp.isfinite(gradient[i] * gradient[i]):
            wp.atomic_add(count_out, index, 1)

    return count_unusable
