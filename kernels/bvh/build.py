"""Builds the wide BVH on the CPU: a binary tree, and its collapse into nodes of several children.

The binary tree is built top-down with the surface-area heuristic [Wal07], with costs counted in packets. Dynamic
programming [YKL17] then decides which binary nodes become wide ones. Triangles as large as the scene have a packet of
their own.

Derivation: ``docs/theory/rays.md#building-the-wide-bvh``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import SAH_DEPTH
from warp_psdr.kernels.modules import shared

#: Words of a primitive record: lower bounds, biased face number, upper bounds, unused.
PRIMITIVE_WORDS = 8
#: Added to face numbers, so that as floats they are normal numbers: arithmetic on the others is slow on some CPUs.
FACE_BIAS = 0x3F800000
#: Share of the scene's area from which on a triangle's box is large.
LARGE = 0.125


def binary_words(width: int) -> int:
    """Return the words of a node of the binary tree from which the wide one is collapsed."""
    return 4 + width + width // 4


_PRIMITIVES = """
    typedef float v4 __attribute__((ext_vector_type(4)));
    v4* out = (v4*)primitives;
    const float* p = (const float*)points;
    const int* index = (const int*)indices;
    for (int f = 0; f < count; ++f) {
        const float *a = p + 3ll * index[3 * f], *b = p + 3ll * index[3 * f + 1], *c = p + 3ll * index[3 * f + 2];
        const v4 va = {a[0], a[1], a[2], 0.0f}, vb = {b[0], b[1], b[2], 0.0f}, vc = {c[0], c[1], c[2], 0.0f};
        v4 lower = va < vb ? va : vb, upper = va > vb ? va : vb;
        lower = lower < vc ? lower : vc;
        upper = upper > vc ? upper : vc;
        lower[3] = __builtin_bit_cast(float, f + $FACE_BIAS);
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
        enum { BINS = 32 };

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

        // ``at`` > 0: no heuristic, the first part gets this many.
        void split(const Range& r, Range& left, Range& right, int at) const {
            const v4 extent = r.centroids.upper - r.centroids.lower;
            const v4 scale = extent > 0.0f ? (BINS * 0.9999f) / extent : v4(0.0f);
            int best_axis = -1, best_bin = 0;
            if (at == 0) {
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
                i += at > 0 ? at : (j - i) / 2;
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

        // Bring the large triangles of the scene to the front; their number, 0 where they are no packet for themselves.
        int large_first(const Range& r) {
            int n = 0;
            for (int i = r.begin; i < r.end; ++i) {
                const Primitive p = primitive[i];
                if (Box{p.lower, p.upper}.area() > $LARGE * r.box.area()) {
                    if (n == $W)
                        return 0;
                    primitive[i] = primitive[n];
                    primitive[n++] = p;
                }
            }
            return n < r.end ? n : 0;
        }
    };

    // Binary tree. A node's children are neighbours, with larger numbers than the node.
    Builder builder = {(Primitive*)primitives};
    Binary* tree = (Binary*)binary;
    int binary_count = 1, top = 0, leaf_count = 0;
    Task tasks[64];
    Range all;
    all.begin = 0;
    all.end = count;
    builder.bounds(all);
    tasks[top++] = {all, 0, 0};
    while (top > 0) {
        const Task task = tasks[--top];
        const Range r = task.range;
        const bool leaf = r.end - r.begin <= $W;
        if (task.node < capacity) {
            Binary& node = tree[task.node];
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
        const int half = task.depth >= $SAH_DEPTH ? (r.end - r.begin) / 2 : 0;
        builder.split(r, left.range, right.range, task.depth == 0 ? builder.large_first(r) : half);
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
    if (binary_count > capacity)
        return;

    // Costs of the collapse, leaves first; share[i] is the number of slots of the first half, 0: use a slot less.
    for (int n = binary_count - 1; n >= 0; --n) {
        Binary& node = tree[n];
        if (node.left < 0) {
            for (int i = 0; i < $W; ++i)
                node.cost[i] = 0.0f;
            continue;
        }
        const Binary &l = tree[node.left], &r = tree[node.left + 1];
        for (int i = 1; i < $W; ++i) {
            float best = INFINITY;
            int share = 1;
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
    const Binary* tree = (const Binary*)binary;
    // Wide nodes and packets, depth first. A subtree that is down to one slot is a child.
    int node_count = 1, packet_count = 0;
    Pending pending[$STACK];
    int top = 0;
    pending[top++] = {0, 0};
    while (top > 0) {
        const Pending task = pending[--top];
        int* child = (int*)children + (long long)task.wide * $W;
        for (int i = 0; i < $W; ++i)
            child[i] = 0;
        int open[$W][2], open_count = 0, used = 0;
        const Binary& root = tree[task.binary];
        if (root.left < 0) {
            open[open_count][0] = task.binary;
            open[open_count++][1] = 0;
        } else {
            const int share = root.share[0];
            open[open_count][0] = root.left + 1;
            open[open_count++][1] = $W - 1 - share;
            open[open_count][0] = root.left;
            open[open_count++][1] = share - 1;
        }
        while (open_count > 0) {
            --open_count;
            const int at = open[open_count][0];
            int slots = open[open_count][1];
            const Binary& node = tree[at];
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


def make_native(width: int):
    """Return a decorator that makes a Warp function of C++ text in which ``$W`` and the constants are filled in."""
    values = {"$STACK": (SAH_DEPTH + 32) * width, "$SAH_DEPTH": SAH_DEPTH}
    values |= {"$LARGE": LARGE, "$FACE_BIAS": FACE_BIAS, "$W": width}

    def native(source: str):
        for key, value in values.items():
            source = source.replace(key, str(value))
        return wp.func_native(source)

    return native


def shared_module(width: int) -> str:
    """Return the name of the Warp module of all kernels that build and refit: make them before any is launched."""
    return shared(f"warp_psdr.bvh{width}")


@functools.cache
def make_build(width: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Make the kernels that build a BVH of ``width`` lanes.

    Both take addresses, and run once (``dim=1``): ``build`` orders the primitives and makes the binary tree with the
    costs of its collapse, ``emit`` writes the children of the wide nodes and the ranges of primitives of the packets.
    ``counts`` receives the numbers of binary nodes and packets from the first, of wide nodes from the second.
    """
    native = make_native(width)

    @native(_PRIMITIVES)
    def fill_primitives(points: wp.uint64, indices: wp.uint64, primitives: wp.uint64, count: wp.int32): ...

    @native(_BUILD)
    def split_all(primitives: wp.uint64, count: wp.int32, binary: wp.uint64, capacity: wp.int32, counts: wp.uint64): ...

    @native(_EMIT)
    def emit_all(binary: wp.uint64, children: wp.uint64, leaves: wp.uint64, counts: wp.uint64): ...

    @wp.kernel(module=shared_module(width), enable_backward=False)
    def build(
        # In:
        points: wp.uint64,
        indices: wp.uint64,
        count: wp.int32,
        capacity: wp.int32,
        # Out:
        primitives: wp.uint64,
        binary: wp.uint64,
        counts: wp.uint64,
    ):
        fill_primitives(points, indices, primitives, count)
        split_all(primitives, count, binary, capacity, counts)

    @wp.kernel(module=shared_module(width), enable_backward=False)
    def emit(
        # In:
        binary: wp.uint64,
        # Out:
        children: wp.uint64,
        leaves: wp.uint64,
        counts: wp.uint64,
    ):
        emit_all(binary, children, leaves, counts)

    return build, emit
