"""Ray queries for W rays of any directions at a time, in scenes whose packets all lie right below the root.

One ray at a time meets the triangles of a packet, by the operations of ``wide.py``. Everything else runs over all rays
at once, one a lane: choosing the axes, shearing, the boxes of the packets, and the closest hits' barycentrics. Packets
are taken one after the other, each by the rays that enter its box. The processor therefore knows which rays come next,
and tests the next ray's triangles while the last ray's hit is still being reduced. Hits are those of ``wide.py`` to the
bit, with one exception: if triangles of several packets are hit at one distance, the first packet's counts here, and
the first that the walk meets counts in a tree.

Rays and hits lie in rows, one for each number, as in ``lanes.py``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.simd import (
    BARYCENTRICS,
    BOX_IN_ROWS,
    DISTANCE,
    EDGES,
    NEAREST,
    RAYS_IN_ROWS,
    SLABS_IN_ROWS,
    TYPES,
)
from warp_psdr.kernels.bvh.wide import Accel, native
from warp_psdr.kernels.lanes.lanes import ROWS

_START = (
    TYPES
    + """
    struct Each {
    static __attribute__((noinline, min_vector_width($BITS))) void run(
        const float* nodes, const float* packets, int count, const float* center, float extent, const float* rays,
        const int* wanted, float* found)
    {
    #pragma clang fp contract(off)
"""
    + RAYS_IN_ROWS
    + """
    // The largest component becomes z: kz = 0, kz = 1, or else 2.
    const vi first = (size[0] > size[1]) & (size[0] > size[2]), second = (size[0] <= size[1]) & (size[1] > size[2]);
    const vf d_x = first ? ray_d[1] : second ? ray_d[2] : ray_d[0];
    const vf d_y = first ? ray_d[2] : second ? ray_d[0] : ray_d[1];
    const vf d_z = first ? ray_d[0] : second ? ray_d[1] : ray_d[2];
    const vf all_px = first ? ray_o[1] : second ? ray_o[2] : ray_o[0];
    const vf all_py = first ? ray_o[2] : second ? ray_o[0] : ray_o[1];
    const vf all_pz = first ? ray_o[0] : second ? ray_o[1] : ray_o[2];
    const vf all_shear_z = 1.0f / d_z, all_mx = -d_x * all_shear_z, all_my = -d_y * all_shear_z;
    // In arrays, as ``_CORNERS`` says.
    float of_ray[6][$W] __attribute__((aligned(64))), reached[$W] __attribute__((aligned(64)));
    int rows_of_ray[3][$W] __attribute__((aligned(64))), result[$W] __attribute__((aligned(64)));
    const vf numbers[6] = {all_px, all_py, all_pz, all_mx, all_my, all_shear_z};
    for (int i = 0; i < 6; ++i)
        *(vf*)of_ray[i] = numbers[i];
    *(vi*)rows_of_ray[0] = first ? vi($W) : second ? vi(2 * $W) : vi(0);
    *(vi*)rows_of_ray[1] = first ? vi(2 * $W) : second ? vi(0) : vi($W);
    *(vi*)rows_of_ray[2] = first ? vi(0) : second ? vi($W) : vi(2 * $W);
    *(vi*)result = $NOTHING;
    *(vf*)reached = limits;

"""
    + SLABS_IN_ROWS
    + """    for (int number = 0; number < count; ++number) {
        vf leave = *(const vf*)reached;
"""
    + BOX_IN_ROWS
    + """        const float* packet = packets + number * (10 * $W);
        for (u32 rest = traced & Simd::mask(enter <= leave); rest; rest &= rest - 1) {
            // One ray after the other, under the names of the texts.
            const int ray = __builtin_ctz(rest);
            const vf px = of_ray[0][ray], py = of_ray[1][ray], pz = of_ray[2][ray];
            const vf mx = of_ray[3][ray], my = of_ray[4][ray];
            const float shear_z = of_ray[5][ray], t_best = reached[ray];
            const long long qx = rows_of_ray[0][ray], qy = rows_of_ray[1][ray], qz = rows_of_ray[2][ray];
"""
    + EDGES
    + DISTANCE
)

# The corners, relative to the origin, of the triangle in lane ``which[i] % $W`` of packet ``which[i] / $W`` for every
# lane i. ``which`` is an array: to take a vector's lane whose number varies, the compiler stores the vector each time.
_CORNERS = """
    float corners[9][$W] __attribute__((aligned(64)));
    int faces[$W] __attribute__((aligned(64)));
    #pragma clang loop vectorize(disable)
    for (int i = 0; i < $W; ++i) {
        const int n = which[i] < 0 ? 0 : which[i];
        const float* best = packets + (long long)(n / $W) * (10 * $W) + n % $W;
        for (int corner = 0; corner < 3; ++corner) {
            corners[3 * corner][i] = best[3 * corner * $W + qx[i]];
            corners[3 * corner + 1][i] = best[3 * corner * $W + qy[i]];
            corners[3 * corner + 2][i] = best[3 * corner * $W + qz[i]];
        }
        faces[i] = ((const int*)best)[9 * $W];
    }
    const vf a_x = Simd::load(corners[0]) - px, a_y = Simd::load(corners[1]) - py, a_z = Simd::load(corners[2]) - pz;
    const vf b_x = Simd::load(corners[3]) - px, b_y = Simd::load(corners[4]) - py, b_z = Simd::load(corners[5]) - pz;
    const vf c_x = Simd::load(corners[6]) - px, c_y = Simd::load(corners[7]) - py, c_z = Simd::load(corners[8]) - pz;
"""

_CLOSEST = (
    _START.replace("$NOTHING", "-1").replace(
        "    for (int number",
        """    vf distances[$W];
    vi packets_of[$W], lanes;
    for (int i = 0; i < $W; ++i) {
        distances[i] = limits[i];
        packets_of[i] = -1;
        lanes[i] = i;
    }
    for (int number""",
    )
    + """
            const vf t = reach * Simd::inverse(weight), t0 = distances[ray];
            const vi closer = inside & (t > 0.0f) & (t < t0);
            distances[ray] = closer ? t : t0;
            packets_of[ray] = closer ? vi(number) : packets_of[ray];
        }
    }
    for (u32 rest = traced; rest; rest &= rest - 1) {
        const int ray = __builtin_ctz(rest);
        const vf distance = distances[ray];
        const vi in_packet = packets_of[ray];
"""
    + NEAREST
    + """
        reached[ray] = nearest;
        result[ray] = n;
    }
    {
    const vf px = all_px, py = all_py, pz = all_pz, shear_x = all_mx, shear_y = all_my;
    const int *qx = rows_of_ray[0], *qy = rows_of_ray[1], *qz = rows_of_ray[2], *which = result;
    vf u_best, v_best;
"""
    + _CORNERS
    + BARYCENTRICS
    + """
    const vi hit = *(const vi*)result >= 0;
    *(row*)found = *(const vf*)reached;
    *(row*)(found + $W) = hit ? u_best : 0.0f;
    *(row*)(found + 2 * $W) = hit ? v_best : 0.0f;
    *(int_row*)(found + 3 * $W) = hit ? *(const vi*)faces : vi(-1);
    }
    }
    };
"""
)

# A ray that has met something enters no box any more.
_ANY = (
    _START.replace("$NOTHING", "0")
    + """
            const int met = Simd::mask(inside & (reach > 0.0f) & (reach < weight * t_best)) != 0;
            result[ray] |= met;
            reached[ray] = met ? -1.0f : t_best;
        }
    }
    *(int_row*)found = *(const vi*)result;
    }
    };
"""
)

_CALL = """
    Each::run((const float*)accel.nodes, (const float*)accel.packets, accel.below_root, accel.center.c, accel.extent,
              (const float*)rows.data + rays * $W, (const int*)rows.data + wanted * $W, (float*)rows.data + found * $W);
"""


@functools.cache
def make_each(width: int) -> tuple[wp.Function, wp.Function]:
    """Make the queries ``closest_of_each`` and ``any_of_each``, for scenes with ``Accel.below_root`` > 0.

    Both take ``(accel: Accel, rows, rays: int, wanted: int, found: int)``: an array of uint32, ``width`` words a row;
    the first of seven rows with origins, directions and largest distances; the row of what is not 0 where a ray is
    wanted; and the first row of what is found: for closest hits the four of ``RayHit``, for any hit one, 1 where there
    is a hit. Rays that are not wanted find nothing.

    Args:
        width: Rays and SIMD lanes, one of ``WIDTHS``.
    """

    def closest_of_each(accel: Accel, rows: ROWS, rays: wp.int32, wanted: wp.int32, found: wp.int32):
        return  # the snippet is what runs

    def any_of_each(accel: Accel, rows: ROWS, rays: wp.int32, wanted: wp.int32, found: wp.int32):
        return

    return (
        native("closest_of_each", _CLOSEST + _CALL, width, closest_of_each),
        native("any_of_each", _ANY + _CALL, width, any_of_each),
    )
