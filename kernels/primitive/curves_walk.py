"""On the CPU: the pieces of curves whose boxes a ray enters, nearest first, ``BATCH`` of them a call.

The pieces lie in a wide BVH (``bvh/wide.py``) whose triangles have two opposite corners of a piece's box each, so that
a packet's boxes are tested at once. A call walks the tree anew from the last piece of the call before. There are few
calls, since a ray mostly ends at one of the first pieces, so no state of a walk is kept between them.
"""

import warp as wp

from warp_psdr.kernels.bvh.simd import BOXES, ORDER, SLABS, TYPES
from warp_psdr.kernels.bvh.wide import native

#: Pieces a call, and SIMD lanes of the tree, whatever the host's.
BATCH, WIDTH = 4, 8

NUMBERS = wp.types.vector(length=BATCH, dtype=wp.int32)
DISTANCES = wp.types.vector(length=BATCH, dtype=wp.float32)


@wp.struct
class Pieces:
    """Pieces in the order in which a ray enters their boxes."""

    count: wp.int32  # BATCH: there may be more
    items: NUMBERS
    enter: DISTANCES  # in units of the direction's length


@wp.struct
class PieceTree:
    """What is needed to walk the tree of a shape; addresses belong to the host."""

    nodes: wp.uint64  # 0: there is none
    packets: wp.uint64
    center: wp.vec3  # boxes of nodes are relative to it
    extent: wp.float32  # largest distance from the center along an axis


# ``limit``: keys of the stack hold a lane in their last bits.
_WALK = (
    "#if !defined(__CUDA_ARCH__)\n"
    + TYPES
    + """
    struct Query {
    static __attribute__((noinline, min_vector_width($BITS))) int run(
        const float* nodes, const float* packets, const float* center, float extent, float o_x, float o_y, float o_z,
        float d_x, float d_y, float d_z, float t_max, float after, int after_item, int* items, float* entered)
    {
    #pragma clang fp contract(off)
    const f4 d = {d_x, d_y, d_z, 0.0f}, size = __builtin_elementwise_abs(d);
    float t_best = t_max;
    int count = 0;
    vi lanes;
    for (int i = 0; i < $W; ++i)
        lanes[i] = i;
"""
    + SLABS
    + """
    const long long px = sign.x & (3 * $W), py = $W + (sign.y & (3 * $W)), pz = 2 * $W + (sign.z & (3 * $W));
    const long long qx = 3 * $W - px, qy = 5 * $W - py, qz = 7 * $W - pz;
    for (;;) {
        while (current >= 0) {
"""
    + BOXES
    + """
            if (hit == 0)
                goto pop;
"""
    + ORDER
    + """
        }
        {
            const float* packet = packets + (long long)~current * (10 * $W);
            const vf x0 = Simd::fma(Simd::load(packet + px) - c.x, rx, near_x);
            const vf x1 = Simd::fma(Simd::load(packet + qx) - c.x, rx, far_x);
            const vf y0 = Simd::fma(Simd::load(packet + py) - c.y, ry, near_y);
            const vf y1 = Simd::fma(Simd::load(packet + qy) - c.y, ry, far_y);
            const vf z0 = Simd::fma(Simd::load(packet + pz) - c.z, rz, near_z);
            const vf z1 = Simd::fma(Simd::load(packet + qz) - c.z, rz, far_z);
            const vf enter = Simd::max(Simd::max(x0, y0), Simd::max(z0, vf(0.0f)));
            const vf leave = Simd::min(Simd::min(x1, y1), Simd::min(z1, vf(t_best)));
            const int* number = (const int*)(packet + 9 * $W);
            for (u32 m = Simd::mask((enter <= leave) & (*(const vi*)number >= 0)); m; m &= m - 1) {
                const int i = __builtin_ctz(m), item = number[i];
                const float t = enter[i];
                if (t < after || (t == after && item <= after_item))
                    continue;
                int at = count < $BATCH ? count : $BATCH - 1;
                if (count == $BATCH && (t > entered[at] || (t == entered[at] && item > items[at])))
                    continue;
                for (; at > 0 && (t < entered[at - 1] || (t == entered[at - 1] && item < items[at - 1])); --at) {
                    entered[at] = entered[at - 1];
                    items[at] = items[at - 1];
                }
                entered[at] = t;
                items[at] = item;
                count += count < $BATCH;
                if (count == $BATCH)
                    t_best = entered[$BATCH - 1];
            }
        }
    pop:
        do {
            if (top == 0)
                return count;
            --top;
            // The key of a box in which the ray starts is the lane alone, next to 0: no farther than a piece at 0.
        } while (stack_t[top] > 1.000002f * t_best + 1.0e-37f);
        current = stack[top];
    }
    }
    };
"""
    + """
    found.count = 0;
    const bool traceable = 0.0f * (o[0] + o[1] + o[2] + d[0] + d[1] + d[2]) == 0.0f
        && (d[0] != 0.0f || d[1] != 0.0f || d[2] != 0.0f);
    if (tree.nodes && traceable)
        found.count = Query::run((const float*)tree.nodes, (const float*)tree.packets, tree.center.c, tree.extent,
                                 o[0], o[1], o[2], d[0], d[1], d[2], t_max, after, after_item, found.items.c,
                                 found.enter.c);
#endif
    return found;
"""
)


def pieces_ahead(
    tree: PieceTree, o: wp.vec3, d: wp.vec3, t_max: wp.float32, after: wp.float32, after_item: wp.int32
) -> Pieces:
    """The pieces whose boxes a ray enters next, up to t_max: behind a distance, or at it with a larger number."""
    return Pieces()  # Warp takes the type from here; the snippet is what runs


PIECES_AHEAD = native(
    "pieces_ahead", f"{Pieces.native_name} found;\n" + _WALK.replace("$BATCH", str(BATCH)), WIDTH, pieces_ahead
)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return false;
#else
    return true;
#endif
""")
def walks_packets() -> wp.bool:
    return wp.bool(True)
