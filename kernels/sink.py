"""The sinks for partial derivatives of local factors, in reverse and in forward mode.

Reverse mode adds ``value`` to the gradient at ``offset``, in double precision: ``target`` is then the memory of float64
sums under the type of forward mode's float32 tangents (``warp_psdr/estimate/gradient_sums.py``). (A float32 sum of n
equal terms has a relative error of n 2^-25, and stops growing after 2^24 of them.) Forward mode returns ``value`` times
the tangent there, and the caller sums the results. A value that is not finite is dropped in reverse mode, where the
sink returns 1 for it and 0 otherwise: the sum is the number of values that a sample lost. In forward mode the sum
itself is not finite. Both modes use one flat array, laid out like ``Scene.values``. When the boundary term records its
samples, the sinks keep derivatives by edge points (``boundary/local_form.py``) and drop all others.
"""

import functools

import warp as wp

from warp_psdr.kernels.invalid import finite


@wp.func_native("""
    double* sums = (double*)target.data;
#if defined(__CUDA_ARCH__)
    atomicAdd(sums + offset, (double)value);
#else
    sums[offset] += (double)value;
#endif
""")
def add_to_sum(target: wp.array(dtype=wp.float32), offset: wp.int32, value: wp.float32):
    """Add to the float64 sum number ``offset`` in the memory of ``target``; on the CPU one thread owns it."""
    ...


@functools.cache
def make_sink(role: str):
    """Return ``sink(target, offset, value) -> float`` for ``role`` "reverse", "forward" or "samples"."""
    if role == "reverse":

        @wp.func
        def sink(target: wp.array(dtype=wp.float32), offset: wp.int32, value: wp.float32) -> wp.float32:
            if not wp.isfinite(value):
                return 1.0
            add_to_sum(target, offset, value)
            return 0.0

    elif role == "forward":

        @wp.func
        def sink(target: wp.array(dtype=wp.float32), offset: wp.int32, value: wp.float32) -> wp.float32:
            return target[offset] * value

    elif role == "samples":

        @wp.func
        def sink(target: wp.array(dtype=wp.float32), offset: wp.int32, value: wp.float32) -> wp.float32:
            return 0.0

    else:
        raise ValueError(f"unknown role {role!r}; expected 'reverse', 'forward' or 'samples'")
    return sink


@functools.cache
def make_sink_vec3(role: str):
    """Return ``sink(target, offset, vec3) -> float``: three consecutive values."""
    scalar = make_sink(role)

    @wp.func
    def sink_vec3(target: wp.array(dtype=wp.float32), offset: wp.int32, value: wp.vec3) -> wp.float32:
        if wp.static(role == "reverse"):
            # One test for three values, nearly always.
            if finite(value):
                add_to_sum(target, offset, value[0])
                add_to_sum(target, offset + 1, value[1])
                add_to_sum(target, offset + 2, value[2])
                return wp.float32(0.0)
        return (
            scalar(target, offset, value[0])
            + scalar(target, offset + 1, value[1])
            + scalar(target, offset + 2, value[2])
        )

    return sink_vec3


@functools.cache
def make_sink_texel(role: str):
    """Return ``sink(target, offset, channels, vec3) -> float``: a colour, or the grey value (one channel) behind it."""
    scalar = make_sink(role)
    vec3 = make_sink_vec3(role)

    @wp.func
    def sink_texel(
        target: wp.array(dtype=wp.float32), offset: wp.int32, channels: wp.int32, value: wp.vec3
    ) -> wp.float32:
        if channels == 1:
            return scalar(target, offset, value[0] + value[1] + value[2])
        return vec3(target, offset, value)

    return sink_texel
