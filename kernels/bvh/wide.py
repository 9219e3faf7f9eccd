"""Closest-hit and any-hit ray queries: Warp's mesh queries, and a wide BVH traversed with SIMD on the CPU.

**Layout.** W is the SIMD width (4, 8 or 16 lanes). A node is 7 rows of W words: for each axis the lower and the upper
bounds of its W children, relative to the scene's center, then the children: n >= 0 is node n, c < 0 is packet ~c.
Unused children have inverted infinite bounds, which no ray meets. A packet is 10 rows: the x, y, z rows of the first,
second and third corners of up to W triangles, then their face numbers. Unused and zero-area lanes hold NaN corners,
for which every comparison below is false.

**Boxes.** Slab test [KK86] on all children at once. The ray's origin relative to the center is moved by +-delta so that
each slab grows by delta on both sides, delta = 8 eps (|o - c| + extent) in the maximum norm. That covers the rounding
of the slab distances (3 operations, each 1/2 eps relative to |o - c| + extent), and of the sheared corners below (3
operations), so a triangle hit as computed is never culled (the reason why [WBW13] pads its boxes). A direction
component below 1e-16 of the largest is replaced by that value: over the whole scene this moves the ray by less than
delta, and 1 / d and its products stay finite.

**Triangles.** [WBW13]: corners relative to the origin are sheared so that the ray becomes the z axis; the ray hits if
the origin of the plane lies inside the projected triangle: the edge functions U = Cx By - Cy Bx, V, W have one sign or
are 0. A corner's projection depends on that corner alone, so neighbours see the same edge. Both products are rounded
before they are subtracted (contraction to fma is off). Rounding is monotonic, hence the computed sign is never the
wrong one, it can only become 0, which counts as inside for both neighbours: no ray passes between them. Where
U + V + W = 0 after rounding the edge functions are evaluated again in double precision, in which products of floats are
exact; only if the determinant is 0 then, the triangle is missed.

**Order.** Hit children are ranked without branches: the entry distances' lowest bits are replaced by the lane number,
so that all differ, and the rank of a child is the number of hit children before it. They are pushed farthest first.

[KK86] Kay, Kajiya. Ray Tracing Complex Scenes. SIGGRAPH 1986.
[WBW13] Woop, Benthin, Wald. Watertight Ray/Triangle Intersection. JCGT 2(1), 2013.
"""

import functools

import warp as wp

#: Vector widths (lanes) for which a traversal can be generated.
WIDTHS = (4, 8, 16)
#: Rows of a node and of a triangle packet; a row has W words of 4 bytes.
NODE_ROWS = 7
PACKET_ROWS = 10
#: Scenes of up to this many full packets are tested without a tree (measured).
FLAT_PACKETS = 4
#: Levels of the builder's binary tree below which it halves by count; bounds the traversal stack for any input.
SAH_DEPTH = 48


@wp.struct
class Accel:
    """What a kernel needs to trace rays. Addresses belong to the host's ``Accelerator``, which must outlive them."""

    mesh_id: wp.uint64  # wp.Mesh; 0 if there is none
    nodes: wp.uint64  # address of the root node, aligned to 64 bytes; 0 if there is none
    packets: wp.uint64  # address of the first triangle packet
    flat: wp.int32  # number of packets that are tested without a tree; 0: walk the tree
    center: wp.vec3  # boxes are relative to this point
    extent: wp.float32  # largest distance from the center along an axis


@wp.struct
class RayHit:
    """A hit at distance ``t`` (in units of the direction's length): point = (1 - u - v) p0 + u p1 + v p2."""

    t: wp.float32
    u: wp.float32
    v: wp.float32
    face: wp.int32  # -1: miss


def stack_size(width: int) -> int:
    """Return the number of stack entries that no traversal exceeds: W - 1 a level, plus W of slack for full stores."""
    return (SAH_DEPTH + 32) * (width - 1) + width


_TYPES = """
    typedef float vf __attribute__((ext_vector_type($W)));
    typedef int vi __attribute__((ext_vector_type($W)));
    typedef float f4 __attribute__((ext_vector_type(4)));
    typedef int i4 __attribute__((ext_vector_type(4)));
    typedef unsigned int u32;
    struct Simd {
        static inline __attribute__((always_inline)) vf load(const float* p) { return *(const vf*)p; }
        static inline __attribute__((always_inline)) vf fma(vf a, vf b, vf c) {
            return __builtin_elementwise_fma(a, b, c);
        }
        static inline __attribute__((always_inline)) float max1(float a, float b) { return a > b ? a : b; }
        static inline __attribute__((always_inline)) vf min(vf a, vf b) { return a < b ? a : b; }
        static inline __attribute__((always_inline)) vf max(vf a, vf b) { return a > b ? a : b; }
        static inline __attribute__((always_inline)) u32 mask(vi a) {
#if $W == 4
            typedef bool vb __attribute__((ext_vector_type(8)));
            vi zero = 0;
            auto wide = __builtin_shufflevector(a, zero, 0, 1, 2, 3, 4, 5, 6, 7);
            return __builtin_bit_cast(unsigned char, __builtin_convertvector(wide, vb));
#elif $W == 8
            typedef bool vb __attribute__((ext_vector_type(8)));
            return __builtin_bit_cast(unsigned char, __builtin_convertvector(a, vb));
#else
            typedef bool vb __attribute__((ext_vector_type(16)));
            return __builtin_bit_cast(unsigned short, __builtin_convertvector(a, vb));
#endif
        }
    };
"""

# A query is three pieces of code in one function that is not inlined, so that a kernel with several queries holds it once.
# Scalars arrive in registers: a vector that is passed by reference costs a store-forwarding stall.
_ARGUMENTS = """
        const float* nodes, const float* packets, int flat, const float* center, float extent, float o_x, float o_y,
        float o_z, float d_x, float d_y, float d_z, float t_max"""

# The largest component of d becomes z [WBW13].
_SHEAR = """
    #pragma clang fp contract(off)
    const f4 d = {d_x, d_y, d_z, 0.0f}, size = __builtin_elementwise_abs(d);
    const int kz = size.x > size.y ? (size.x > size.z ? 0 : 2) : (size.y > size.z ? 1 : 2);
    const int kx = kz == 2 ? 0 : kz + 1, ky = kx == 2 ? 0 : kx + 1;
    const float ray_o[3] = {o_x, o_y, o_z}, ray_d[3] = {d_x, d_y, d_z};
    const float shear_z = 1.0f / ray_d[kz];
    const float shear_x = -ray_d[kx] * shear_z, shear_y = -ray_d[ky] * shear_z;
    const vf px = ray_o[kx], py = ray_o[ky], pz = ray_o[kz], mx = shear_x, my = shear_y;
    const long long qx = kx * $W, qy = ky * $W, qz = kz * $W;
"""

# Distance to plane b is b * rcp + near or far; the walk starts at the root.
_SLABS = """
    const f4 o = {o_x, o_y, o_z, 0.0f}, c = {center[0], center[1], center[2], 0.0f};
    const f4 oc = o - c, far = __builtin_elementwise_abs(oc);
    const f4 tiny = 1.0e-16f * Simd::max1(Simd::max1(size.x, size.y), size.z);
    const f4 rcp = 1.0f / (size < tiny ? __builtin_elementwise_copysign(tiny, d) : d);
    const float delta = 9.6e-7f * (Simd::max1(Simd::max1(far.x, far.y), far.z) + extent);  // 16 eps
    const f4 grow = __builtin_elementwise_copysign(f4(delta), rcp);
    const f4 near_d = -(oc + grow) * rcp, far_d = -(oc - grow) * rcp;
    const i4 sign = __builtin_bit_cast(i4, rcp) >> 31;
    const vf rx = rcp.x, ry = rcp.y, rz = rcp.z;
    const vf near_x = near_d.x, near_y = near_d.y, near_z = near_d.z;
    const vf far_x = far_d.x, far_y = far_d.y, far_z = far_d.z;
    const long long nx = sign.x & $W, ny = 2 * $W + (sign.y & $W), nz = 4 * $W + (sign.z & $W);
    const long long fx = $W - nx, fy = 5 * $W - ny, fz = 9 * $W - nz;
    float stack_t[$STACK];
    int stack[$STACK];
    long long top = 0;
    int current = 0;
"""

_BOXES = """
            const float* node = nodes + (long long)current * (7 * $W);
            const vf x0 = Simd::fma(Simd::load(node + nx), rx, near_x), x1 = Simd::fma(Simd::load(node + fx), rx, far_x);
            const vf y0 = Simd::fma(Simd::load(node + ny), ry, near_y), y1 = Simd::fma(Simd::load(node + fy), ry, far_y);
            const vf z0 = Simd::fma(Simd::load(node + nz), rz, near_z), z1 = Simd::fma(Simd::load(node + fz), rz, far_z);
            const vf enter = Simd::max(Simd::max(x0, y0), Simd::max(z0, vf(0.0f)));
            const vf leave = Simd::min(Simd::min(x1, y1), Simd::min(z1, vf(t_best)));
            const u32 hit = Simd::mask(enter <= leave);
            const int* child = (const int*)(node + 6 * $W);
"""

_EDGES = """
        const vf a_z = Simd::load(packet + qz) - pz;
        const vf b_z = Simd::load(packet + 3 * $W + qz) - pz;
        const vf c_z = Simd::load(packet + 6 * $W + qz) - pz;
        const vf a_x = Simd::fma(a_z, mx, Simd::load(packet + qx) - px);
        const vf b_x = Simd::fma(b_z, mx, Simd::load(packet + 3 * $W + qx) - px);
        const vf c_x = Simd::fma(c_z, mx, Simd::load(packet + 6 * $W + qx) - px);
        const vf a_y = Simd::fma(a_z, my, Simd::load(packet + qy) - py);
        const vf b_y = Simd::fma(b_z, my, Simd::load(packet + 3 * $W + qy) - py);
        const vf c_y = Simd::fma(c_z, my, Simd::load(packet + 6 * $W + qy) - py);
        const vf edge_u = c_x * b_y - c_y * b_x;
        const vf edge_v = a_x * c_y - a_y * c_x;
        const vf edge_w = b_x * a_y - b_y * a_x;
        const vf lowest = Simd::min(Simd::min(edge_u, edge_v), edge_w);
        const vf highest = Simd::max(Simd::max(edge_u, edge_v), edge_w);
        const vi inside = (lowest >= 0.0f) | (highest <= 0.0f);
"""

_DISTANCE = """
            const vf det = edge_u + edge_v + edge_w;
            vf t = (edge_u * a_z + edge_v * b_z + edge_w * c_z) * shear_z / det;
            u32 thin = Simd::mask(inside & (det == 0.0f));
            if (__builtin_expect(thin != 0, 0))
                for (; thin; thin &= thin - 1) {
                    const int i = __builtin_ctz(thin);
                    const double ax = a_x[i], ay = a_y[i], bx = b_x[i], by = b_y[i], cx = c_x[i], cy = c_y[i];
                    const double u = cx * by - cy * bx, v = ax * cy - ay * cx, w = bx * ay - by * ax, s = u + v + w;
                    const bool out = (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0);
                    const double z = u * a_z[i] + v * b_z[i] + w * c_z[i];
                    t[i] = out || s == 0.0 ? -1.0f : (float)(z * shear_z / s);
                }
"""

_CLOSEST = (
    _TYPES
    + """
    struct Query {
    static __attribute__((noinline)) int run("""
    + _ARGUMENTS
    + """, float& t_out, float& u_out, float& v_out)
    {
"""
    + _SHEAR
    + """
    float t_best = t_max;
    const float* best = nullptr;
    vi lanes;
    for (int i = 0; i < $W; ++i)
        lanes[i] = i;
    if (flat) {
        vf nearest = t_max;
        vi which = -1;
        for (int i = 0; i < flat; ++i) {
        const float* packet = packets + i * (10 * $W);
"""
    + _EDGES
    + _DISTANCE
    + """
            const vi closer = inside & (t > 0.0f) & (t < nearest);
            nearest = closer ? t : nearest;
            which = closer ? vi(i) : which;
        }
        const u32 found = Simd::mask(which >= 0);
        if (found) {
            // Positive floats are ordered as their bits are; the integer reduction is a tree, that of floats a chain.
            t_best = __builtin_bit_cast(float, __builtin_reduce_min(__builtin_bit_cast(vi, nearest)));
            const int lane = __builtin_ctz(found & Simd::mask(nearest == t_best));
            best = packets + which[lane] * (10 * $W) + lane;
        }
        goto done;
    }
    {
"""
    + _SLABS
    + """
    for (;;) {
        while (current >= 0) {
"""
    + _BOXES
    + """
            if (hit == 0)
                goto pop;
            if ((hit & (hit - 1)) == 0) {
                current = child[__builtin_ctz(hit)];
                continue;
            }
            const vf key = __builtin_bit_cast(vf, (__builtin_bit_cast(vi, enter) & ~($W - 1)) | lanes);
            float keys[$W] __attribute__((aligned(64)));
            *(vf*)keys = key;
            const int n = __builtin_popcount(hit);
            for (u32 m = hit; m; m &= m - 1) {
                const int i = __builtin_ctz(m);
                const int rank = __builtin_popcount(hit & Simd::mask(key < vf(keys[i])));
                stack_t[top + n - 1 - rank] = keys[i];
                stack[top + n - 1 - rank] = child[i];
            }
            top += n - 1;
            current = stack[top];
        }
        {
        const float* packet = packets + (long long)~current * (10 * $W);
"""
    + _EDGES
    + """
        if (Simd::mask(inside)) {
"""
    + _DISTANCE
    + """
            for (u32 m = Simd::mask(inside & (t > 0.0f) & (t < t_best)); m; m &= m - 1) {
                const int i = __builtin_ctz(m);
                best = t[i] < t_best ? packet + i : best;
                t_best = t[i] < t_best ? t[i] : t_best;
            }
        }
        }
    pop:
        do {
            if (top == 0)
                goto done;
            --top;
        } while (stack_t[top] > t_best);
        current = stack[top];
    }
    }
    done:
    if (!best)
        return -1;
    // Barycentrics of the hit: edge functions from exact products, those of the wrong sign count as 0.
    const float a_z = best[qz] - ray_o[kz], b_z = best[3 * $W + qz] - ray_o[kz], c_z = best[6 * $W + qz] - ray_o[kz];
    const double ax = __builtin_fmaf(a_z, shear_x, best[qx] - ray_o[kx]);
    const double ay = __builtin_fmaf(a_z, shear_y, best[qy] - ray_o[ky]);
    const double bx = __builtin_fmaf(b_z, shear_x, best[3 * $W + qx] - ray_o[kx]);
    const double by = __builtin_fmaf(b_z, shear_y, best[3 * $W + qy] - ray_o[ky]);
    const double cx = __builtin_fmaf(c_z, shear_x, best[6 * $W + qx] - ray_o[kx]);
    const double cy = __builtin_fmaf(c_z, shear_y, best[6 * $W + qy] - ray_o[ky]);
    const double u = cx * by - cy * bx, v = ax * cy - ay * cx, w = bx * ay - by * ax;
    const double side = u + v + w < 0.0 ? -1.0 : 1.0;
    const double u1 = u * side > 0.0 ? u * side : 0.0, v1 = v * side > 0.0 ? v * side : 0.0;
    const double w1 = w * side > 0.0 ? w * side : 0.0, scale = 1.0 / (u1 + v1 + w1);
    t_out = t_best;
    u_out = (float)(v1 * scale);
    v_out = (float)(w1 * scale);
    return ((const int*)best)[9 * $W];
    }
    };
    float t = t_max, u = 0.0f, v = 0.0f;
    int face = -1;
    if (accel.packets)
        face = Query::run((const float*)accel.nodes, (const float*)accel.packets, accel.flat, accel.center.c,
                          accel.extent, o[0], o[1], o[2], d[0], d[1], d[2], t_max, t, u, v);
    return {t, u, v, face};
"""
)

_ANY = (
    _TYPES
    + """
    struct Query {
    static __attribute__((noinline)) bool run("""
    + _ARGUMENTS
    + """)
    {
"""
    + _SHEAR
    + """
    const float t_best = t_max;
    if (flat) {
        vi found = 0;
        for (int i = 0; i < flat; ++i) {
        const float* packet = packets + i * (10 * $W);
"""
    + _EDGES
    + _DISTANCE
    + """
            found |= inside & (t > 0.0f) & (t < t_best);
        }
        return Simd::mask(found != 0) != 0;
    }
"""
    + _SLABS
    + """
    for (;;) {
        while (current >= 0) {
"""
    + _BOXES
    + """
            if (hit == 0)
                goto pop;
            for (u32 m = hit & (hit - 1); m; m &= m - 1)
                stack[top++] = child[__builtin_ctz(m)];
            current = child[__builtin_ctz(hit)];
        }
        {
        const float* packet = packets + (long long)~current * (10 * $W);
"""
    + _EDGES
    + """
        if (Simd::mask(inside)) {
"""
    + _DISTANCE
    + """
            if (Simd::mask(inside & (t > 0.0f) & (t < t_best)))
                return true;
        }
        }
    pop:
        if (top == 0)
            return false;
        current = stack[--top];
    }
    }
    };
    return accel.packets != 0
        && Query::run((const float*)accel.nodes, (const float*)accel.packets, accel.flat, accel.center.c,
                      accel.extent, o[0], o[1], o[2], d[0], d[1], d[2], t_max);
"""
)


def _native(name: str, source: str, width: int, function) -> wp.Function:
    """Turn a snippet into a Warp function whose name, hence the kernel cache's key, is the same in every process."""
    function.__qualname__ = function.__name__ = f"{name}_wide{width}"
    snippet = source.replace("$STACK", str(stack_size(width))).replace("$W", str(width))
    return wp.func_native(snippet)(function)


@functools.cache
def make_intersect(backend: str, width: int) -> tuple[wp.Function, wp.Function]:
    """Make the queries ``closest_hit`` and ``any_hit`` of a backend.

    Both take ``(accel: Accel, o: vec3, d: vec3, t_max: float32)`` and look at distances in (0, t_max), from both sides
    of every triangle; ``closest_hit`` returns a ``RayHit``, ``any_hit`` a bool.

    Args:
        backend: ``"warp"`` (``wp.Mesh``, any device) or ``"wide"`` (CPU only).
        width: SIMD lanes of the wide BVH, one of ``WIDTHS``; ignored by ``"warp"``.
    """
    if backend == "warp":
        return closest_hit_mesh, any_hit_mesh
    if backend != "wide" or width not in WIDTHS:
        raise ValueError(f"backend {backend!r} with width {width}: expected 'warp', or 'wide' with one of {WIDTHS}")

    def closest_hit(accel: Accel, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
        return RayHit()  # Warp takes the type from here; the snippet is what runs

    def any_hit(accel: Accel, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.bool:
        return wp.bool(False)

    return _native("closest_hit", _CLOSEST, width, closest_hit), _native("any_hit", _ANY, width, any_hit)


@wp.func
def closest_hit_mesh(accel: Accel, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
    hit = RayHit()
    hit.t = t_max
    hit.face = wp.int32(-1)
    if accel.mesh_id != wp.uint64(0):
        query = wp.mesh_query_ray(accel.mesh_id, o, d, t_max)
        if query.result:
            # Warp's u and v are the weights of the first and second corner.
            hit.t = query.t
            hit.u = query.v
            hit.v = 1.0 - query.u - query.v
            hit.face = query.face
    return hit


@wp.func
def any_hit_mesh(accel: Accel, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.bool:
    if accel.mesh_id == wp.uint64(0):
        return False
    return wp.mesh_query_ray_anyhit(accel.mesh_id, o, d, t_max)
