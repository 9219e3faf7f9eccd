"""Builds and refits the wide BVH on the CPU.

**Build.** Top-down with the surface-area heuristic [Wal07]: a range of triangles is split at the best of 16 x 3 bin
borders (of the centroids' bounds). A node starts with one range and splits the child of largest area until it has W
children or all of them fit a packet; every range of up to W triangles becomes a leaf of one packet, since a packet costs the
same however many of its lanes are in use. Costs count packets, ceil(n / W). Below ``SAH_DEPTH`` levels, or if no border separates the
centroids, a range is halved by count, so that the depth is bounded for any input.

**Refit.** Packets are filled from the moved corners; a node's children have larger numbers than the node, so one pass
over the nodes from last to first finds the new bounds. The same pass returns the tree's cost
sum over children of area(child) / area(root), by which the host decides on a rebuild.

[Wal07] Wald. On fast Construction of SAH-based Bounding Volume Hierarchies. RT 2007.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import FLAT_PACKETS, SAH_DEPTH

#: Words of a primitive record: lower bounds, face number, upper bounds, unused.
PRIMITIVE_WORDS = 8
#: Cost of testing a packet of triangles, in tests of a node's boxes (measured).
LEAF_COST = 1.2


def binary_words(width: int) -> int:
    """Return the words of a node of the binary tree from which the wide one is collapsed."""
    return 4 + width + width // 4


_PRIMITIVES = """
    typedef float v4 __attribute__((ext_vector_type(4)));
    v4* out = (v4*)primitives;
    const float* p = (const float*)points;
    const int* index = (const int*)indices;
    for (int f = begin; f < end; ++f) {
        const float *a = p + 3ll * index[3 * f], *b = p + 3ll * index[3 * f + 1], *c = p + 3ll * index[3 * f + 2];
        const v4 va = {a[0], a[1], a[2], 0.0f}, vb = {b[0], b[1], b[2], 0.0f}, vc = {c[0], c[1], c[2], 0.0f};
        v4 lower = va < vb ? va : vb, upper = va > vb ? va : vb;
        lower = lower < vc ? lower : vc;
        upper = upper > vc ? upper : vc;
        lower[3] = __builtin_bit_cast(float, f);
        out[2 * f] = lower;
        out[2 * f + 1] = upper;
    }
"""

_BUILD = """
    typedef float v4 __attribute__((ext_vector_type(4)));
    typedef int i4 __attribute__((ext_vector_type(4)));
    struct Box {
        v4 lower, upper;
        void reset() { lower = INFINITY; upper = -INFINITY; }
        void grow(v4 a, v4 b) { lower = a < lower ? a : lower; upper = b > upper ? b : upper; }
        float area() const { v4 e = upper - lower; return e.x * e.y + e.y * e.z + e.z * e.x; }
    };
    struct Primitive { v4 lower, upper; };
    struct Range { int begin, end; float area; Box box, centroids; };
    struct Task { Range range; int node, depth; };
    struct Binary { float area; int begin, end, left; float cost[$W]; unsigned char share[$W]; };
    struct Builder {
        Primitive* primitive;
        enum { BINS = 16 };

        // Centroids are kept doubled: lower + upper.
        static i4 bin(const Primitive& p, v4 origin, v4 scale) {
            i4 b = __builtin_convertvector((p.lower + p.upper - origin) * scale, i4);
            b = b < 0 ? i4(0) : b;
            return b > BINS - 1 ? i4(BINS - 1) : b;
        }

        void bounds(Range& r) const {
            r.box.reset();
            r.centroids.reset();
            for (int i = r.begin; i < r.end; ++i) {
                const v4 c = primitive[i].lower + primitive[i].upper;
                r.box.grow(primitive[i].lower, primitive[i].upper);
                r.centroids.grow(c, c);
            }
            r.area = r.box.area();
        }

        void split(const Range& r, Range& left, Range& right, bool halve, bool fill) const {
            const v4 extent = r.centroids.upper - r.centroids.lower;
            const v4 scale = extent > 0.0f ? (BINS * 0.9999f) / extent : v4(0.0f);
            int best_axis = -1, best_bin = 0;
            if (!halve && !fill) {
                Box box[3][BINS];
                int count[3][BINS];
                for (int a = 0; a < 3; ++a)
                    for (int b = 0; b < BINS; ++b) {
                        box[a][b].reset();
                        count[a][b] = 0;
                    }
                for (int i = r.begin; i < r.end; ++i) {
                    const Primitive p = primitive[i];
                    const i4 b = bin(p, r.centroids.lower, scale);
                    box[0][b.x].grow(p.lower, p.upper); ++count[0][b.x];
                    box[1][b.y].grow(p.lower, p.upper); ++count[1][b.y];
                    box[2][b.z].grow(p.lower, p.upper); ++count[2][b.z];
                }
                float best = INFINITY;
                for (int a = 0; a < 3; ++a) {
                    if (!(extent[a] > 0.0f))
                        continue;
                    float above[BINS];
                    Box sweep;
                    sweep.reset();
                    int n = 0;
                    for (int b = BINS - 1; b > 0; --b) {
                        sweep.grow(box[a][b].lower, box[a][b].upper);
                        n += count[a][b];
                        above[b] = n ? sweep.area() * ((n + $W - 1) / $W) : 0.0f;
                    }
                    sweep.reset();
                    n = 0;
                    for (int b = 0; b < BINS - 1; ++b) {
                        sweep.grow(box[a][b].lower, box[a][b].upper);
                        n += count[a][b];
                        if (n == 0 || n == r.end - r.begin)
                            continue;
                        const float cost = sweep.area() * ((n + $W - 1) / $W) + above[b + 1];
                        if (cost < best) {
                            best = cost;
                            best_axis = a;
                            best_bin = b;
                        }
                    }
                }
            }
            int i = r.begin, j = r.end;
            if (best_axis < 0) {
                i = fill ? i + $W : (i + j) / 2;
            } else {
                for (;;) {
                    while (i < j && bin(primitive[i], r.centroids.lower, scale)[best_axis] <= best_bin) ++i;
                    while (i < j && bin(primitive[j - 1], r.centroids.lower, scale)[best_axis] > best_bin) --j;
                    if (i >= j)
                        break;
                    const Primitive p = primitive[i];
                    primitive[i] = primitive[j - 1];
                    primitive[j - 1] = p;
                }
            }
            left.begin = r.begin;
            left.end = right.begin = i;
            right.end = r.end;
            bounds(left);
            bounds(right);
        }
    };

    // 1. Binary tree. A node's children are neighbours, with larger numbers than the node.
    Builder builder = {(Primitive*)primitives};
    Binary* binary = (Binary*)work;
    int binary_count = 1, top = 0, leaf_count = 0;
    Task tasks[64];
    {
        Range all;
        all.begin = 0;
        all.end = count;
        builder.bounds(all);
        tasks[top++] = {all, 0, 0};
    }
    while (top > 0) {
        Task task = tasks[--top];
        const Range r = task.range;
        const bool store = task.node < binary_capacity;
        const bool leaf = r.end - r.begin <= $W;
        if (store) {
            Binary& node = binary[task.node];
            node.area = r.box.area();
            node.begin = r.begin;
            node.end = r.end;
            node.left = leaf ? -1 : binary_count;
        }
        if (leaf) {
            ++leaf_count;
            continue;
        }
        Task left, right;
        builder.split(r, left.range, right.range, task.depth >= $SAH_DEPTH, count <= $FLAT * $W);
        left.depth = right.depth = task.depth + 1;
        left.node = binary_count++;
        right.node = binary_count++;
        // The larger part waits, so that the stack stays logarithmic.
        const bool swap = left.range.end - left.range.begin > right.range.end - right.range.begin;
        tasks[top++] = swap ? left : right;
        tasks[top++] = swap ? right : left;
    }
    int* result = (int*)counts;
    result[0] = binary_count;
    result[1] = leaf_count;
    if (binary_count > binary_capacity)
        return;

    // 2. Collapse: cost[i] is the least cost of the subtree if it may take i + 1 slots of its parent.
    for (int n = binary_count - 1; n >= 0; --n) {
        Binary& node = binary[n];
        if (node.left < 0) {
            for (int i = 0; i < $W; ++i)
                node.cost[i] = node.area * $LEAF_COST;
            continue;
        }
        const Binary &l = binary[node.left], &r = binary[node.left + 1];
        for (int i = 1; i < $W; ++i) {
            float best = INFINITY;
            int share = 0;
            for (int k = 0; k < i; ++k) {
                const float cost = l.cost[k] + r.cost[i - 1 - k];
                if (cost < best) {
                    best = cost;
                    share = k + 1;
                }
            }
            node.cost[i] = best;
            node.share[i] = share;
        }
        node.cost[0] = node.area + node.cost[$W - 1];
        node.share[0] = node.share[$W - 1];
        for (int i = 1; i < $W; ++i)
            if (node.cost[i - 1] <= node.cost[i]) {
                node.cost[i] = node.cost[i - 1];
                node.share[i] = 0;
            }
    }

"""

_EMIT = """
    struct Binary { float area; int begin, end, left; float cost[$W]; unsigned char share[$W]; };
    struct Pending { int binary, wide; };
    const Binary* binary = (const Binary*)work;
    // 3. Wide nodes and leaves, depth first. A subtree with one slot is a child of its own.
    int node_count = 1, packet_count = 0;
    Pending pending[$STACK];
    int top = 0;
    pending[top++] = {0, 0};
    while (top > 0) {
        const Pending work_item = pending[--top];
        int* child = (int*)children + (long long)work_item.wide * $W;
        for (int i = 0; i < $W; ++i)
            child[i] = 0;
        int open[$W][2], open_count = 0, used = 0;
        const Binary& top_node = binary[work_item.binary];
        if (top_node.left < 0) {
            open[open_count][0] = work_item.binary;
            open[open_count++][1] = 0;
        } else {
            const int share = top_node.share[0];
            open[open_count][0] = top_node.left + 1;
            open[open_count++][1] = $W - 1 - share;
            open[open_count][0] = top_node.left;
            open[open_count++][1] = share - 1;
        }
        while (open_count > 0) {
            --open_count;
            const int at = open[open_count][0];
            int slots = open[open_count][1];
            const Binary& node = binary[at];
            while (slots > 0 && (node.left < 0 || node.share[slots] == 0))
                --slots;
            if (slots > 0) {
                const int share = node.share[slots];
                open[open_count][0] = node.left + 1;
                open[open_count++][1] = slots - share;
                open[open_count][0] = node.left;
                open[open_count++][1] = share - 1;
            } else if (node.left < 0) {
                ((int*)leaves)[2 * packet_count] = node.begin;
                ((int*)leaves)[2 * packet_count + 1] = node.end;
                child[used++] = ~packet_count++;
            } else {
                pending[top++] = {at, node_count};
                child[used++] = node_count++;
            }
        }
    }
    ((int*)counts)[0] = node_count;
"""

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
                face[i] = at < leaf[2 * k + 1] ? ((const int*)primitive)[8ll * at + 3] : -1;
            }
            float corner[9];
            for (int j = 0; j < 9; ++j)
                corner[j] = NAN;
            if (face[i] >= 0) {
                for (int c = 0; c < 3; ++c)
                    for (int a = 0; a < 3; ++a)
                        corner[3 * c + a] = p[3ll * index[3 * face[i] + c] + a];
                double e[6];
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

_REFIT = """
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
    ((float*)cost_out)[0] = root > 0.0f ? (float)(cost / root) : 0.0f;
    for (int a = 0; a < 3; ++a) {
        ((float*)cost_out)[1 + a] = lower[a];
        ((float*)cost_out)[4 + a] = upper[a];
    }
"""


@functools.cache
def make_build(width: int):
    """Make the kernels that build and refit a BVH of ``width`` lanes; see ``warp_psdr.acceleration``.

    Returns:
        Kernels ``build`` (binary tree and collapse costs), ``emit`` (children of wide nodes, triangle ranges of
        packets), ``fill`` (packets) and ``refit`` (bounds). All take addresses, and run on one thread (``dim=1``).
    """

    def native(source):
        values = {"$STACK": (SAH_DEPTH + 32) * width, "$SAH_DEPTH": SAH_DEPTH, "$LEAF_COST": LEAF_COST, "$FLAT": FLAT_PACKETS, "$W": width}
        for key, value in values.items():
            source = source.replace(key, str(value))
        return wp.func_native(source)

    @native(_PRIMITIVES)
    def fill_primitives(
        points: wp.uint64, indices: wp.uint64, primitives: wp.uint64, begin: wp.int32, end: wp.int32
    ): ...

    @native(_BUILD)
    def build(
        primitives: wp.uint64, count: wp.int32, work: wp.uint64, binary_capacity: wp.int32, counts: wp.uint64
    ): ...

    @native(_EMIT)
    def emit(work: wp.uint64, children: wp.uint64, leaves: wp.uint64, counts: wp.uint64): ...

    @native(_FILL)
    def fill(
        points: wp.uint64,
        indices: wp.uint64,
        primitives: wp.uint64,
        leaves: wp.uint64,
        packets: wp.uint64,
        begin: wp.int32,
        end: wp.int32,
    ): ...

    @native(_REFIT)
    def refit(
        nodes: wp.uint64,
        node_count: wp.int32,
        children: wp.uint64,
        packets: wp.uint64,
        center: wp.vec3,
        cost_out: wp.uint64,
    ): ...

    @wp.kernel(module="unique", enable_backward=False)
    def build_kernel(
        points: wp.uint64,
        indices: wp.uint64,
        primitives: wp.uint64,
        count: wp.int32,
        work: wp.uint64,
        binary_capacity: wp.int32,
        counts: wp.uint64,
    ):
        fill_primitives(points, indices, primitives, 0, count)
        build(primitives, count, work, binary_capacity, counts)

    @wp.kernel(module="unique", enable_backward=False)
    def emit_kernel(work: wp.uint64, children: wp.uint64, leaves: wp.uint64, counts: wp.uint64):
        emit(work, children, leaves, counts)

    @wp.kernel(module="unique", enable_backward=False)
    def refit_kernel(
        points: wp.uint64,
        indices: wp.uint64,
        primitives: wp.uint64,
        leaves: wp.uint64,
        packets: wp.uint64,
        packet_count: wp.int32,
        nodes: wp.uint64,
        node_count: wp.int32,
        children: wp.uint64,
        center: wp.vec3,
        cost_out: wp.uint64,
    ):
        fill(points, indices, primitives, leaves, packets, 0, packet_count)
        refit(nodes, node_count, children, packets, center, cost_out)

    return build_kernel, emit_kernel, refit_kernel
