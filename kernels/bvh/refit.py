"""Fills the packets and the bounds of the wide BVH, after a build and after every change of the vertices.

A node's children have larger numbers than the node, so one pass over the nodes from last to first finds all bounds. The
same pass returns the cost of the tree, the sum over all children of area(child) / area(root): the expected number of
node and packet tests of a ray that meets the scene's box, by which the host decides when to build again.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.build import make_native, shared_module

_FILL = """
    const float* p = (const float*)points;
    const int* index = (const int*)indices;
    const int* leaf = (const int*)leaves;
    const float* primitive = (const float*)primitives;
    for (int k = begin; k < end; ++k) {
        float* packet = (float*)packets + (long long)k * (10 * $W);
        int* face = (int*)(packet + 9 * $W);
        for (int i = 0; i < $W; ++i) {
            if (primitive) {
                const int at = leaf[2 * k] + i;
                face[i] = at < leaf[2 * k + 1] ? ((const int*)primitive)[8ll * at + 3] - $FACE_BIAS : -1;
            }
            float corner[9];
            for (int j = 0; j < 9; ++j)
                corner[j] = NAN;
            if (face[i] >= 0) {
                for (int c = 0; c < 3; ++c)
                    for (int a = 0; a < 3; ++a)
                        corner[3 * c + a] = p[3ll * index[3 * face[i] + c] + a];
                double e[6];  // the edges of a triangle without an area are parallel: exact in double precision
                for (int a = 0; a < 6; ++a)
                    e[a] = (double)corner[3 + a] - (double)corner[a % 3];
                if (e[0] * e[4] == e[1] * e[3] && e[1] * e[5] == e[2] * e[4] && e[2] * e[3] == e[0] * e[5])
                    for (int j = 0; j < 9; ++j)
                        corner[j] = NAN;
            }
            for (int j = 0; j < 9; ++j)
                packet[j * $W + i] = corner[j];
        }
    }
"""

_BOUND = """
    typedef float vf __attribute__((ext_vector_type($W)));
    struct Local {
        static float area(const float* lower, const float* upper) {
            const float x = upper[0] - lower[0], y = upper[1] - lower[1], z = upper[2] - lower[2];
            return x >= 0.0f ? x * y + y * z + z * x : 0.0f;
        }
    };
    float lower[3], upper[3];
    double cost = 0.0;
    for (int k = node_count - 1; k >= 0; --k) {
        float* node = (float*)nodes + (long long)k * (7 * $W);
        int* child = (int*)(node + 6 * $W);
        for (int i = 0; i < $W; ++i) {
            if (children)
                child[i] = ((const int*)children)[(long long)k * $W + i];
            for (int a = 0; a < 3; ++a) {
                lower[a] = INFINITY;
                upper[a] = -INFINITY;
            }
            if (child[i] > 0) {
                const float* inner = (const float*)nodes + (long long)child[i] * (7 * $W);
                for (int a = 0; a < 3; ++a) {
                    lower[a] = __builtin_reduce_min(*(const vf*)(inner + 2 * a * $W));
                    upper[a] = __builtin_reduce_max(*(const vf*)(inner + (2 * a + 1) * $W));
                }
            } else if (child[i] < 0) {
                const float* packet = (const float*)packets + (long long)~child[i] * (10 * $W);
                for (int a = 0; a < 3; ++a) {
                    vf lo = INFINITY, hi = -INFINITY;
                    for (int c = 0; c < 3; ++c) {
                        const vf x = *(const vf*)(packet + (3 * c + a) * $W) - center[a];
                        lo = x < lo ? x : lo;
                        hi = x > hi ? x : hi;
                    }
                    lower[a] = __builtin_reduce_min(lo);
                    upper[a] = __builtin_reduce_max(hi);
                }
            }
            cost += Local::area(lower, upper);
            for (int a = 0; a < 3; ++a) {
                node[2 * a * $W + i] = lower[a];
                node[(2 * a + 1) * $W + i] = upper[a];
            }
        }
    }
    for (int a = 0; a < 3; ++a) {
        lower[a] = __builtin_reduce_min(*(const vf*)((const float*)nodes + 2 * a * $W));
        upper[a] = __builtin_reduce_max(*(const vf*)((const float*)nodes + (2 * a + 1) * $W));
    }
    const float root = Local::area(lower, upper);
    ((float*)summary)[0] = root > 0.0f ? (float)(cost / root) : 0.0f;
    for (int a = 0; a < 3; ++a) {
        ((float*)summary)[1 + a] = lower[a];
        ((float*)summary)[4 + a] = upper[a];
    }
"""


@functools.cache
def make_refit(width: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Make the kernels that bring a BVH of ``width`` lanes up to date with the vertices.

    Both take addresses. ``fill`` writes packets ``begin`` to ``end`` and may run in several threads; the first time,
    after a build, ``primitives`` and ``leaves`` tell it the faces (0: keep them). ``bound`` then writes the bounds of
    all nodes, the first time also their ``children``, and a summary: the cost, the lower and the upper bounds.
    """
    native = make_native(width)

    @native(_FILL)
    def fill_range(
        points: wp.uint64,
        indices: wp.uint64,
        primitives: wp.uint64,
        leaves: wp.uint64,
        packets: wp.uint64,
        begin: wp.int32,
        end: wp.int32,
    ): ...

    @native(_BOUND)
    def bound_all(
        nodes: wp.uint64,
        node_count: wp.int32,
        children: wp.uint64,
        packets: wp.uint64,
        center: wp.vec3,
        summary: wp.uint64,
    ): ...

    @wp.kernel(module=shared_module(width), enable_backward=False)
    def fill(
        # In:
        points: wp.uint64,
        indices: wp.uint64,
        primitives: wp.uint64,
        leaves: wp.uint64,
        begin: wp.int32,
        end: wp.int32,
        # Out:
        packets: wp.uint64,
    ):
        fill_range(points, indices, primitives, leaves, packets, begin, end)

    @wp.kernel(module=shared_module(width), enable_backward=False)
    def bound(
        # In:
        packets: wp.uint64,
        children: wp.uint64,
        node_count: wp.int32,
        center: wp.vec3,
        # Out:
        nodes: wp.uint64,
        summary: wp.uint64,
    ):
        bound_all(nodes, node_count, children, packets, center, summary)

    return fill, bound
