"""Pairs of triangles of a wide BVH that may run through each other, from one packet and all packets behind it.

Boxes have to meet, and the corners of the second triangle must not lie all on one side of the first one's plane. The
latter is told in single precision with a bound of its error, so no pair is left out that
``kernels/boundary/path_space/crossing.py`` would keep.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.simd import TYPES
from warp_psdr.kernels.bvh.wide import Accel, native

_NEAR = (
    TYPES
    + """
    struct Near {
        // One of W numbers that lie in memory for it.
        struct Row { float of[$W] __attribute__((aligned(64))); };

        static __attribute__((noinline, min_vector_width($BITS))) int run(
            const float* nodes, const float* packets, const float* center, int number, float tolerance, int* out,
            int room)
        {
        const float* own = packets + (long long)number * (10 * $W);
        const int* own_faces = (const int*)(own + 9 * $W);
        vf corner[9], least[3], most[3];
        Row lower[3], upper[3], normal[3];
        f4 low, high;  // the packet's box, relative to the center as those of the nodes are: rounding keeps the order
        for (int a = 0; a < 3; ++a) {
            for (int c = 0; c < 3; ++c)
                corner[3 * c + a] = Simd::load(own + (3 * c + a) * $W);
            const vf lo = Simd::min(Simd::min(corner[a], corner[3 + a]), corner[6 + a]);
            const vf hi = Simd::max(Simd::max(corner[a], corner[3 + a]), corner[6 + a]);
            *(vf*)lower[a].of = lo;
            *(vf*)upper[a].of = hi;
            least[a] = lo - center[a];
            most[a] = hi - center[a];
            low[a] = __builtin_reduce_min(Simd::min(least[a], vf(INFINITY)));
            high[a] = __builtin_reduce_max(Simd::max(most[a], vf(-INFINITY)));
        }
        vd e[3], f[3], n[3];
        for (int a = 0; a < 3; ++a) {
            e[a] = Simd::wide(corner[3 + a]) - Simd::wide(corner[a]);
            f[a] = Simd::wide(corner[6 + a]) - Simd::wide(corner[a]);
        }
        for (int a = 0; a < 3; ++a)
            n[a] = e[(a + 1) % 3] * f[(a + 2) % 3] - e[(a + 2) % 3] * f[(a + 1) % 3];
        const vd size = __builtin_elementwise_sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
        for (int a = 0; a < 3; ++a)
            *(vf*)normal[a].of = Simd::narrow(n[a] / size);

        vi lanes;
        for (int i = 0; i < $W; ++i)
            lanes[i] = i;
        // Roundings of the tolerance, and of a height over the sum of its three terms.
        const float in_plane = tolerance * (1.0f - 1.0e-6f), off_plane = tolerance * (1.0f + 1.0e-6f), error = 1.0e-6f;
        int stack[$STACK], top = 0, found = 0;
        stack[top++] = 0;
        while (top > 0) {
            const float* node = nodes + (long long)stack[--top] * (7 * $W);
            vi met = -1;
            for (int a = 0; a < 3; ++a)
                met &= (Simd::load(node + 2 * a * $W) <= high[a]) & (Simd::load(node + (2 * a + 1) * $W) >= low[a]);
            for (u32 hit = Simd::mask(met); hit; hit &= hit - 1) {
                const int slot = __builtin_ctz(hit), child = ((const int*)(node + 6 * $W))[slot];
                if (child > 0)
                    stack[top++] = child;
                if (child >= 0 || ~child < number)
                    continue;
                vi enters = -1;
                for (int a = 0; a < 3; ++a)
                    enters &= (least[a] <= node[(2 * a + 1) * $W + slot]) & (most[a] >= node[2 * a * $W + slot]);
                u32 rows = Simd::mask(enters);
                if (rows == 0)
                    continue;
                const float* other = packets + (long long)~child * (10 * $W);
                const int* other_faces = (const int*)(other + 9 * $W);
                vf x[9], lo[3], hi[3];
                for (int a = 0; a < 3; ++a) {
                    for (int c = 0; c < 3; ++c)
                        x[3 * c + a] = Simd::load(other + (3 * c + a) * $W);
                    lo[a] = Simd::min(Simd::min(x[a], x[3 + a]), x[6 + a]);
                    hi[a] = Simd::max(Simd::max(x[a], x[3 + a]), x[6 + a]);
                }
                for (; rows; rows &= rows - 1) {
                    const int i = __builtin_ctz(rows);
                    vi meets = ~child > number ? vi(-1) : lanes > i;
                    for (int a = 0; a < 3; ++a)
                        meets &= (lo[a] <= upper[a].of[i]) & (hi[a] >= lower[a].of[i]);
                    if (Simd::mask(meets) == 0)
                        continue;
                    vf below[3], above[3];  // bounds of the heights
                    for (int c = 0; c < 3; ++c) {
                        vf height = 0.0f, terms = 0.0f;
                        for (int a = 0; a < 3; ++a) {
                            const vf term = (x[3 * c + a] - own[a * $W + i]) * normal[a].of[i];
                            height += term;
                            terms += Simd::abs(term);
                        }
                        below[c] = height - error * terms;
                        above[c] = height + error * terms;
                    }
                    // Candidates have a corner below the plane, and one above it or two in it. NaN rules nothing out.
                    const vf lowest = Simd::min(Simd::min(below[0], below[1]), below[2]);
                    const vf pair = Simd::max(above[0], above[1]), highest = Simd::max(pair, above[2]);
                    const vf second = Simd::max(Simd::min(above[0], above[1]), Simd::min(pair, above[2]));
                    meets &= ~((lowest >= -in_plane) | ((highest <= in_plane) & (second < -off_plane)));
                    for (u32 near = Simd::mask(meets); near; near &= near - 1, ++found) {
                        if (found >= room)
                            continue;
                        const int a = own_faces[i], b = other_faces[__builtin_ctz(near)];
                        out[2 * found] = a < b ? a : b;
                        out[2 * found + 1] = a < b ? b : a;
                    }
                }
            }
        }
        return found;
        }
    };
    if (!accel.packets)
        return 0;
    int* out = (int*)((char*)pairs.data + (long long)lane * pairs.strides[0]);
    return Near::run((const float*)accel.nodes, (const float*)accel.packets, accel.center.c, packet, (float)tolerance,
                     out + 2ll * first, pairs.shape[1] - first);
"""
)


@functools.cache
def make_near_pairs(width: int) -> wp.Function:
    """Make ``near_pairs(accel, packet, tolerance, pairs, lane, first) -> int``.

    It writes the face numbers of the pairs, the lower one first, to the lane's row of ``pairs`` from ``first`` on, as
    far as there is room, and returns how many there are. ``tolerance``: height above a plane that lies in it.
    """

    def near_pairs(
        accel: Accel,
        packet: wp.int32,
        tolerance: wp.float64,
        pairs: wp.array2d(dtype=wp.vec2i),
        lane: wp.int32,
        first: wp.int32,
    ) -> wp.int32:
        return wp.int32(0)

    return native("near_pairs", _NEAR, width, near_pairs)
