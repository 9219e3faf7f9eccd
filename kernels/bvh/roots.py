"""Which of W rays of any directions enter a box right below the root of a tree of several levels.

One ray a lane, as in ``each.py``, a box after the other: the rays that enter none have met nothing, and need no walk.
The test is the walk's own, to the bit (``wide.py``).
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.simd import BOX_IN_ROWS, RAYS_IN_ROWS, SLABS_IN_ROWS, TYPES
from warp_psdr.kernels.bvh.wide import Accel, native
from warp_psdr.kernels.lanes.lanes import ROWS

_ENTER = (
    TYPES
    + """
    struct Roots {
    static __attribute__((noinline, min_vector_width($BITS))) int run(
        const float* nodes, const float* center, float extent, const float* rays, const int* wanted)
    {
    #pragma clang fp contract(off)
"""
    + RAYS_IN_ROWS
    + SLABS_IN_ROWS
    + """
    vi entered = 0;
    for (int number = 0; number < $W; ++number) {
        vf leave = limits;
"""
    + BOX_IN_ROWS
    + """
        entered |= enter <= leave;
    }
    return traced & Simd::mask(entered);
    }
    };
    if (accel.flat || !accel.nodes)
        return -1;
    return Roots::run((const float*)accel.nodes, accel.center.c, accel.extent, (const float*)rows.data + rays * $W,
                      (const int*)rows.data + wanted * $W);
"""
)


@functools.cache
def make_roots(width: int) -> wp.Function:
    """Return ``enters_root(accel, rows, rays: int, wanted: int) -> int``: a bit a ray, 0 where it can meet nothing.

    All bits are set where there is no tree. Arguments are those of ``make_each``.
    """

    def enters_root(accel: Accel, rows: ROWS, rays: wp.int32, wanted: wp.int32) -> wp.int32:
        return wp.int32(0)  # the snippet is what runs

    return native("enters_root", _ENTER, width, enters_root)
