"""C++ source of the ray queries of the wide BVH; see ``wide.py`` for the method.

``$W`` stands for the number of lanes, ``$STACK`` for the entries of the stack. GNU vector types and a few portable
Clang builtins carry the SIMD, so the same text compiles for SSE, AVX2, AVX-512 and NEON. Warp's CPU compiler has two
traps: ``float(x)`` is a macro (write ``(float)x``), and a reduction of floats is a chain of scalar operations, while
one of integers is a tree.
"""

TYPES = """
    typedef float vf __attribute__((ext_vector_type($W)));
    typedef int vi __attribute__((ext_vector_type($W)));
    typedef float f4 __attribute__((ext_vector_type(4)));
    typedef double vd __attribute__((ext_vector_type($W)));
    typedef int i4 __attribute__((ext_vector_type(4)));
    typedef unsigned int u32;
    // Rows of ``lanes.py`` may lie anywhere, and are words of another type to everybody else.
    typedef float row __attribute__((ext_vector_type($W), aligned(4), may_alias));
    typedef int int_row __attribute__((ext_vector_type($W), aligned(4), may_alias));
    struct Simd {
#define INLINE inline __attribute__((always_inline))
        static INLINE vf load(const float* p) { return *(const vf*)p; }
        static INLINE vf splat(const float* p) { return *p; }
        // What all lanes have in common, or what one of them has.
        static INLINE float at(float a, int) { return a; }
        static INLINE float at(vf a, int i) { return a[i]; }
        static INLINE double wide(float a) { return a; }
        static INLINE vd wide(vf a) { return __builtin_convertvector(a, vd); }
        static INLINE float narrow(double a) { return a; }
        static INLINE vf narrow(vd a) { return __builtin_convertvector(a, vf); }
        static INLINE double sign(double a) { return __builtin_copysign(1.0, a); }
        static INLINE vd sign(vd a) { return __builtin_elementwise_copysign(vd(1.0), a); }
        static INLINE double positive(double a) { return a > 0.0 ? a : 0.0; }
        static INLINE vd positive(vd a) { return a > 0.0 ? a : 0.0; }
        static INLINE float fma(float a, float b, float c) { return __builtin_fmaf(a, b, c); }
        static INLINE vf fma(vf a, vf b, vf c) { return __builtin_elementwise_fma(a, b, c); }
        static INLINE vf abs(vf a) { return __builtin_elementwise_abs(a); }
        static INLINE vf larger(vf a, vf b) {  // magnitude of the one of larger magnitude
#if $W == 16 && defined(__AVX512DQ__)
            return __builtin_ia32_rangeps512_mask(a, b, 11, vf(0.0f), 0xffff, 4);
#else
            return max(abs(a), abs(b));
#endif
        }
        static INLINE vf flip(vf a, vf sign) {  // change the sign of a where that of the other is negative
            const vi bits = __builtin_bit_cast(vi, sign) & (int)0x80000000;
            return __builtin_bit_cast(vf, __builtin_bit_cast(vi, a) ^ bits);
        }
        static INLINE vf inverse(vf a) {  // to two units in the last place; infinite or NaN for 0
#if $W == 16 && defined(__AVX512F__)
            const vf r = __builtin_ia32_rcp14ps512_mask(a, vf(0.0f), 0xffff);
            return fma(r, fma(-a, r, vf(1.0f)), r);  // half the time of a division
#else
            return 1.0f / a;
#endif
        }
        static INLINE float max1(float a, float b) { return a > b ? a : b; }
        static INLINE vf min(vf a, vf b) { return a < b ? a : b; }
        static INLINE vf max(vf a, vf b) { return a > b ? a : b; }
        static INLINE u32 mask(vi a) {  // one bit a lane, of lanes that are all ones or all zeros
#if $W == 4 && defined(__SSE__)
            return __builtin_ia32_movmskps(__builtin_bit_cast(vf, a));
#elif $W == 8 && defined(__AVX__)
            return __builtin_ia32_movmskps256(__builtin_bit_cast(vf, a));
#elif $W == 4
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
        // Append the children in the mask to the stack; what lies above the new top is overwritten.
        static INLINE long long push(int* stack, long long top, const int* child, u32 m) {
#if $W == 16 && defined(__AVX512F__)
            typedef int unaligned __attribute__((ext_vector_type($W), aligned(4)));
            *(unaligned*)(stack + top) = __builtin_ia32_compresssi512_mask(*(const vi*)child, vi(0), m);
            return top + __builtin_popcount(m);
#else
            for (; m; m &= m - 1)
                stack[top++] = child[__builtin_ctz(m)];
            return top;
#endif
        }
        static INLINE void prefetch(const float* p) {
            for (int i = 0; i < 9 * $W; i += 16)
                __builtin_prefetch(p + i);
        }
#undef INLINE
    };
"""

# A query is one function that is not inlined, so that a kernel with several calls holds it once. Scalars arrive in
# registers: a vector passed by reference would cost a store-forwarding stall.
ARGUMENTS = """
        const float* nodes, const float* packets, int flat, const float* center, float extent, float o_x, float o_y,
        float o_z, float d_x, float d_y, float d_z, float t_max"""

# The largest component of d becomes z [WBW13].
SHEAR = """
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
SLABS = """
    const f4 o = {o_x, o_y, o_z, 0.0f}, c = {center[0], center[1], center[2], 0.0f};
    const f4 oc = o - c, far = __builtin_elementwise_abs(oc);
    const f4 tiny = 1.0e-16f * Simd::max1(Simd::max1(size.x, size.y), size.z);
    const f4 rcp = 1.0f / (size < tiny ? __builtin_elementwise_copysign(tiny, d) : d);
    const float delta = 9.6e-7f * (Simd::max1(Simd::max1(far.x, far.y), far.z) + extent);  // 16 u, see wide.py
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

BOXES = """
            const float* node = nodes + (long long)current * (7 * $W);
            const vf x0 = Simd::fma(Simd::load(node + nx), rx, near_x);
            const vf x1 = Simd::fma(Simd::load(node + fx), rx, far_x);
            const vf y0 = Simd::fma(Simd::load(node + ny), ry, near_y);
            const vf y1 = Simd::fma(Simd::load(node + fy), ry, far_y);
            const vf z0 = Simd::fma(Simd::load(node + nz), rz, near_z);
            const vf z1 = Simd::fma(Simd::load(node + fz), rz, far_z);
            const vf enter = Simd::max(Simd::max(x0, y0), Simd::max(z0, vf(0.0f)));
            const vf leave = Simd::min(Simd::min(x1, y1), Simd::min(z1, vf(t_best)));
            const u32 hit = Simd::mask(enter <= leave);
            const int* child = (const int*)(node + 6 * $W);
"""

EDGES = """
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
        vf edge_v = a_x * c_y - a_y * c_x;
        vf edge_w = b_x * a_y - b_y * a_x;
        const vf lowest = Simd::min(Simd::min(edge_u, edge_v), edge_w);
        const vf highest = Simd::max(Simd::max(edge_u, edge_v), edge_w);
        const vi inside = (lowest >= 0.0f) | (highest <= 0.0f);
"""

DISTANCE = """
            const vf det = edge_u + edge_v + edge_w;
            vf weight = Simd::abs(det);
            vf reach = Simd::fma(edge_w, c_z, Simd::fma(edge_v, b_z, edge_u * a_z)) * shear_z;
            reach = Simd::flip(reach, det);  // the hit's distance is reach / weight
            const vf wide = Simd::larger(Simd::larger(a_x, b_x), c_x);
            const vf high = Simd::larger(Simd::larger(a_y, b_y), c_y);
            // 1 / 16: the edge functions keep 16 bits
            u32 unsure = Simd::mask(inside & (weight < wide * high * 0.0625f));
            if (__builtin_expect(unsure != 0, 0))
                for (; unsure; unsure &= unsure - 1) {
                    const int i = __builtin_ctz(unsure);
                    const double ax = a_x[i], ay = a_y[i], bx = b_x[i], by = b_y[i], cx = c_x[i], cy = c_y[i];
                    const double u = cx * by - cy * bx, v = ax * cy - ay * cx, w = bx * ay - by * ax, s = u + v + w;
                    const bool out = (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0);
                    const double z = u * a_z[i] + v * b_z[i] + w * c_z[i];
                    reach[i] = out || s == 0.0 ? -1.0f : (float)(z * Simd::at(shear_z, i) / s);
                    weight[i] = 1.0f;
                    edge_v[i] = (float)(v / s);
                    edge_w[i] = (float)(w / s);
                }
"""

# Push the hit children farthest first, and go on with the nearest.
ORDER = """
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
                Simd::prefetch(child[i] < 0 ? packets + (long long)~child[i] * (10 * $W)
                                            : nodes + (long long)child[i] * (7 * $W));
            }
            top += n - 1;
            current = stack[top];
"""

# Barycentrics of a closest hit from its corners relative to the origin, of one ray or of one in every lane: from exact
# products; edge functions of the wrong sign count as 0. Without a branch, for the signs are anybody's guess.
BARYCENTRICS = """
    const auto ax = Simd::wide(Simd::fma(a_z, shear_x, a_x)), ay = Simd::wide(Simd::fma(a_z, shear_y, a_y));
    const auto bx = Simd::wide(Simd::fma(b_z, shear_x, b_x)), by = Simd::wide(Simd::fma(b_z, shear_y, b_y));
    const auto cx = Simd::wide(Simd::fma(c_z, shear_x, c_x)), cy = Simd::wide(Simd::fma(c_z, shear_y, c_y));
    const auto u = cx * by - cy * bx, v = ax * cy - ay * cx, w = bx * ay - by * ax, side = Simd::sign(u + v + w);
    const auto u1 = Simd::positive(u * side), v1 = Simd::positive(v * side), w1 = Simd::positive(w * side);
    const auto scale = 1.0 / (u1 + v1 + w1);
    u_best = Simd::narrow(v1 * scale);
    v_best = Simd::narrow(w1 * scale);
"""

# The closest of W hits, from their distances ``distance`` and packets ``in_packet`` (-1: none): ``nearest``, and its
# packet and lane as one number ``n`` (-1: no hit), of several at one distance the first.
NEAREST = """
        // Positive floats are ordered as their bits are; the integer reduction is a tree, that of floats a chain.
        const float nearest = __builtin_bit_cast(float, __builtin_reduce_min(__builtin_bit_cast(vi, distance)));
        const vi tied = (in_packet >= 0) & (distance == nearest);
        int numbers[$W] __attribute__((aligned(64)));
        *(vi*)numbers = tied ? in_packet * $W + lanes : vi(-1);
        const u32 ties = Simd::mask(tied);
        int n = numbers[__builtin_ctz(ties | (1u << ($W - 1)))];
        if (__builtin_expect((ties & (ties - 1)) != 0, 0))
            n = __builtin_reduce_min(tied ? *(vi*)numbers : vi(0x7fffffff));
"""

# W rays that lie in rows (``lanes.py``), one a lane, and which of them are traced.
RAYS_IN_ROWS = """
    vf ray_o[3], ray_d[3], size[3], from_c[3], farthest = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
        ray_o[axis] = *(const row*)(rays + axis * $W);
        ray_d[axis] = *(const row*)(rays + (3 + axis) * $W);
        size[axis] = Simd::abs(ray_d[axis]);
        from_c[axis] = ray_o[axis] - center[axis];
        farthest = Simd::max(farthest, Simd::abs(from_c[axis]));
    }
    const vf limits = *(const row*)(rays + 6 * $W);
    const vf sum = ray_o[0] + ray_o[1] + ray_o[2] + ray_d[0] + ray_d[1] + ray_d[2];
    const vf largest = Simd::max(Simd::max(size[0], size[1]), size[2]);
    const u32 traced = Simd::mask((*(const int_row*)wanted != 0) & (0.0f * sum == 0.0f) & (largest > 0.0f));
"""

# Their distances to planes; the same operations as those of ``SLABS``.
SLABS_IN_ROWS = """
    // Distance to plane b is b * rcp + near or far.
    const vf delta = 9.6e-7f * (farthest + extent), tiny = 1.0e-16f * largest;  // 16 u, see wide.py
    vf rcp[3], near[3], far[3];
    vi back[3];
    for (int axis = 0; axis < 3; ++axis) {
        back[axis] = __builtin_bit_cast(vi, ray_d[axis]) < 0;
        rcp[axis] = 1.0f / (size[axis] < tiny ? Simd::flip(tiny, ray_d[axis]) : ray_d[axis]);
        const vf grow = Simd::flip(delta, ray_d[axis]);
        near[axis] = -(from_c[axis] + grow) * rcp[axis];
        far[axis] = -(from_c[axis] - grow) * rcp[axis];
    }
"""

# Where they ``enter`` and ``leave`` the box with a ``number`` in the root; ``leave`` begins as the farthest distance.
BOX_IN_ROWS = """
        const float* box = nodes + number;
        vf enter = 0.0f;
        for (int axis = 0; axis < 3; ++axis) {
            const vf lower = box[2 * axis * $W], upper = box[(2 * axis + 1) * $W];
            enter = Simd::max(Simd::fma(back[axis] ? upper : lower, rcp[axis], near[axis]), enter);
            leave = Simd::min(Simd::fma(back[axis] ? lower : upper, rcp[axis], far[axis]), leave);
        }
"""
