"""Ray queries for W rays of any directions at a time, of scenes that are tested without a tree.

Still one ray meets the triangles of a packet at a time, by the operations of ``wide.py``: hits are those of its queries
to the bit. What is not done ray by ray is the rest, which is half of such a query: choosing the axes, shearing, and the
closest hits' barycentrics are computed for all rays at once, one a lane. And nothing between waits for a ray's result
or depends on it in a branch, so that the processor is in the next ray's packets while it still reduces those of the
last to one number.

Rays and hits lie in rows, one for each number, as ``lanes.py`` has it.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.simd import BARYCENTRICS, CORNERS, DISTANCE, EDGES, FLAT, TYPES
from warp_psdr.kernels.bvh.wide import Accel, native

# Rows may lie anywhere, and are words of another type to everybody else.
_START = (
    TYPES
    + """
    struct Each {
    typedef float row __attribute__((ext_vector_type($W), aligned(4), may_alias));
    typedef int int_row __attribute__((ext_vector_type($W), aligned(4), may_alias));

    static __attribute__((noinline, min_vector_width($BITS))) void run(
        const float* packets, int flat, const float* rays, const int* wanted, float* found)
    {
    #pragma clang fp contract(off)
    vf ray_o[3], ray_d[3], size[3];
    for (int axis = 0; axis < 3; ++axis) {
        ray_o[axis] = *(const row*)(rays + axis * $W);
        ray_d[axis] = *(const row*)(rays + (3 + axis) * $W);
        size[axis] = Simd::abs(ray_d[axis]);
    }
    const vf limits = *(const row*)(rays + 6 * $W);
    const vf sum = ray_o[0] + ray_o[1] + ray_o[2] + ray_d[0] + ray_d[1] + ray_d[2];
    const vi somewhere = (size[0] != 0.0f) | (size[1] != 0.0f) | (size[2] != 0.0f);
    const u32 traced = Simd::mask((*(const int_row*)wanted != 0) & (0.0f * sum == 0.0f) & somewhere);
    // The largest component becomes z: kz = 0, kz = 1, or else 2.
    const vi first = (size[0] > size[1]) & (size[0] > size[2]), second = (size[0] <= size[1]) & (size[1] > size[2]);
    const vf d_x = first ? ray_d[1] : second ? ray_d[2] : ray_d[0];
    const vf d_y = first ? ray_d[2] : second ? ray_d[0] : ray_d[1];
    const vf d_z = first ? ray_d[0] : second ? ray_d[1] : ray_d[2];
    const vf all_px = first ? ray_o[1] : second ? ray_o[2] : ray_o[0];
    const vf all_py = first ? ray_o[2] : second ? ray_o[0] : ray_o[1];
    const vf all_pz = first ? ray_o[0] : second ? ray_o[1] : ray_o[2];
    const vf all_shear_z = 1.0f / d_z, all_mx = -d_x * all_shear_z, all_my = -d_y * all_shear_z;
    const vi all_qx = first ? vi($W) : second ? vi(2 * $W) : vi(0);
    const vi all_qy = first ? vi(2 * $W) : second ? vi(0) : vi($W);
    const vi all_qz = first ? vi(0) : second ? vi($W) : vi(2 * $W);
    // In arrays, as ``CORNERS`` says.
    float of_ray[7][$W] __attribute__((aligned(64)));
    int rows_of_ray[3][$W] __attribute__((aligned(64))), result[$W] __attribute__((aligned(64)));
    const vf numbers_of_rays[7] = {all_px, all_py, all_pz, all_mx, all_my, all_shear_z, limits};
    for (int i = 0; i < 7; ++i)
        *(vf*)of_ray[i] = numbers_of_rays[i];
    *(vi*)rows_of_ray[0] = all_qx;
    *(vi*)rows_of_ray[1] = all_qy;
    *(vi*)rows_of_ray[2] = all_qz;
    *(vi*)result = $NOTHING;
"""
)

# One ray after the other, under the names of the texts.
_RAYS = """
    for (u32 rest = traced; rest; rest &= rest - 1) {
        const int ray = __builtin_ctz(rest);
        const vf px = of_ray[0][ray], py = of_ray[1][ray], pz = of_ray[2][ray], mx = of_ray[3][ray], my = of_ray[4][ray];
        const float shear_z = of_ray[5][ray], t_max = of_ray[6][ray];
        const long long qx = rows_of_ray[0][ray], qy = rows_of_ray[1][ray], qz = rows_of_ray[2][ray];
"""

_CLOSEST = (
    _START.replace("$NOTHING", "-1")
    + """
    vi lanes;
    for (int i = 0; i < $W; ++i)
        lanes[i] = i;
"""
    + _RAYS
    + FLAT
    + """
        result[ray] = n;
        of_ray[6][ray] = nearest;
    }
    {
    const vf px = all_px, py = all_py, pz = all_pz, shear_x = all_mx, shear_y = all_my;
    const int *qx = rows_of_ray[0], *qy = rows_of_ray[1], *qz = rows_of_ray[2], *which = result;
    vf u_best, v_best;
"""
    + CORNERS
    + BARYCENTRICS
    + """
    const vi hit = *(const vi*)result >= 0;
    *(row*)found = hit ? *(const vf*)of_ray[6] : limits;
    *(row*)(found + $W) = hit ? u_best : 0.0f;
    *(row*)(found + 2 * $W) = hit ? v_best : 0.0f;
    *(int_row*)(found + 3 * $W) = hit ? *(const vi*)faces : vi(-1);
    }
    }
    };
"""
)

_ANY = (
    _START.replace("$NOTHING", "0")
    + _RAYS
    + """
        vi met = 0;
        for (int i = 0; i < flat; ++i) {
        const float* packet = packets + i * (10 * $W);
"""
    + EDGES
    + DISTANCE
    + """
            met |= inside & (reach > 0.0f) & (reach < weight * t_max);
        }
        result[ray] = Simd::mask(met != 0) != 0;
    }
    *(int_row*)found = *(const vi*)result;
    }
    };
"""
)

_CALL = """
    Each::run((const float*)accel.packets, accel.flat, (const float*)rows.data + rays * $W,
              (const int*)rows.data + wanted * $W, (float*)rows.data + found * $W);
"""


@functools.cache
def make_each(width: int) -> tuple[wp.Function, wp.Function]:
    """Make the queries ``closest_of_each`` and ``any_of_each``, for scenes with ``Accel.flat`` > 0.

    Both take ``(accel: Accel, rows, rays: int, wanted: int, found: int)``: an array of uint32, ``width`` words a row;
    the first of seven rows with origins, directions and largest distances; the row of what is not 0 where a ray is
    wanted; and the first row of what is found: for closest hits the four of ``RayHit``, for any hit one, 1 where there
    is a hit. Rays that are not wanted find nothing.

    Args:
        width: Rays and SIMD lanes, one of ``WIDTHS``.
    """

    def closest_of_each(accel: Accel, rows: wp.array(dtype=wp.uint32), rays: wp.int32, wanted: wp.int32, found: wp.int32):
        return  # the snippet is what runs

    def any_of_each(accel: Accel, rows: wp.array(dtype=wp.uint32), rays: wp.int32, wanted: wp.int32, found: wp.int32):
        return

    return (
        native("closest_of_each", _CLOSEST + _CALL, width, closest_of_each),
        native("any_of_each", _ANY + _CALL, width, any_of_each),
    )
