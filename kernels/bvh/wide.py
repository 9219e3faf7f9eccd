"""Closest-hit and any-hit ray queries: Warp's mesh queries, and a wide BVH traversed with SIMD on the CPU.

A node holds the bounds of W children in rows of words, and a packet the corners of up to W triangles. Slab tests [KK86]
grow by an error bound, and triangle tests are watertight [WBW13]. Tests that lose their digits are repeated in double
precision.

Derivation: ``docs/theory/rays.md#the-wide-bvh``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.simd import (
    ARGUMENTS,
    BARYCENTRICS,
    BOXES,
    DISTANCE,
    EDGES,
    NEAREST,
    ORDER,
    SHEAR,
    SLABS,
    TYPES,
)

#: Vector widths (lanes) for which a traversal can be generated.
WIDTHS = (4, 8, 16)
#: Rows of a node and of a triangle packet; a row has W words of 4 bytes.
NODE_ROWS = 7
PACKET_ROWS = 10
#: Scenes of up to this many packets are tested without a tree (measured).
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
    below_root: wp.int32  # number of packets if all of them lie right below the root, in their order; else 0
    center: wp.vec3  # boxes are relative to this point
    extent: wp.float32  # largest distance from the center along an axis


@wp.struct
class Ray:
    """A ray up to the distance ``t_max`` (in units of the direction's length)."""

    o: wp.vec3
    d: wp.vec3
    t_max: wp.float32


@wp.struct
class RayHit:
    """A hit at distance ``t`` (in units of the direction's length): point = (1 - u - v) p0 + u p1 + v p2."""

    t: wp.float32
    u: wp.float32
    v: wp.float32
    face: wp.int32  # -1: miss


@wp.struct
class AnyHit:
    """Whether there is a hit, in a word."""

    hit: wp.int32


def stack_size(width: int) -> int:
    """Return the number of stack entries that no traversal exceeds: W - 1 a level, plus W of slack for full stores."""
    return (SAH_DEPTH + 32) * (width - 1) + width


# NaN passes every slab test, those of a node's empty lanes too, whose children are nowhere.
TRACEABLE = """
    const bool traceable = 0.0f * (o[0] + o[1] + o[2] + d[0] + d[1] + d[2]) == 0.0f
        && (d[0] != 0.0f || d[1] != 0.0f || d[2] != 0.0f);
"""

_CLOSEST = (
    TYPES
    + """
    struct Query {
    static __attribute__((noinline, min_vector_width($BITS))) int run("""
    + ARGUMENTS
    + """, float& t_out, float& u_best, float& v_best)
    {
"""
    + SHEAR
    + """
    float t_best = t_max;
    const float* best = nullptr;
    vi lanes;
    for (int i = 0; i < $W; ++i)
        lanes[i] = i;
    if (flat) {
        vf distance = t_max;
        vi in_packet = -1;
        for (int i = 0; i < flat; ++i) {
        const float* packet = packets + i * (10 * $W);
"""
    + EDGES
    + DISTANCE
    + """
            const vf t = reach * Simd::inverse(weight);
            const vi closer = inside & (t > 0.0f) & (t < distance);
            distance = closer ? t : distance;
            in_packet = closer ? vi(i) : in_packet;
        }
"""
    + NEAREST
    + """
        if (n >= 0) {
            t_best = nearest;
            best = packets + (n / $W) * (10 * $W) + n % $W;
        }
        goto done;
    }
    {
"""
    + SLABS
    + """
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
"""
    + EDGES
    + """
        if (Simd::mask(inside)) {
"""
    + DISTANCE
    + """
            const vf t = reach * Simd::inverse(weight);
            for (u32 m = Simd::mask(inside & (t > 0.0f) & (t < t_best)); m; m &= m - 1) {
                const int i = __builtin_ctz(m);
                const bool closer = t[i] < t_best;
                best = closer ? packet + i : best;
                t_best = closer ? t[i] : t_best;
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
    const float o_kx = ray_o[kx], o_ky = ray_o[ky], o_kz = ray_o[kz];
    const float a_x = best[qx] - o_kx, a_y = best[qy] - o_ky, a_z = best[qz] - o_kz;
    const float b_x = best[3 * $W + qx] - o_kx, b_y = best[3 * $W + qy] - o_ky, b_z = best[3 * $W + qz] - o_kz;
    const float c_x = best[6 * $W + qx] - o_kx, c_y = best[6 * $W + qy] - o_ky, c_z = best[6 * $W + qz] - o_kz;
"""
    + BARYCENTRICS
    + """
    t_out = t_best;
    return ((const int*)best)[9 * $W];
    }
    };
    float t = t_max, u = 0.0f, v = 0.0f;
    int face = -1;
"""
    + TRACEABLE
    + """
    if (accel.packets && traceable)
        face = Query::run((const float*)accel.nodes, (const float*)accel.packets, accel.flat, accel.center.c,
                          accel.extent, o[0], o[1], o[2], d[0], d[1], d[2], t_max, t, u, v);
    return {t, u, v, face};
"""
)

_ANY = (
    TYPES
    + """
    struct Query {
    static __attribute__((noinline, min_vector_width($BITS))) bool run("""
    + ARGUMENTS
    + """)
    {
"""
    + SHEAR
    + """
    const float t_best = t_max;
    if (flat) {
        vi found = 0;
        for (int i = 0; i < flat; ++i) {
        const float* packet = packets + i * (10 * $W);
"""
    + EDGES
    + DISTANCE
    + """
            found |= inside & (reach > 0.0f) & (reach < weight * t_best);
        }
        return Simd::mask(found != 0) != 0;
    }
"""
    + SLABS
    + """
    for (;;) {
        while (current >= 0) {
"""
    + BOXES
    + """
            if (hit == 0)
                goto pop;
            current = child[__builtin_ctz(hit)];
            top = Simd::push(stack, top, child, hit & (hit - 1));
        }
        {
        const float* packet = packets + (long long)~current * (10 * $W);
"""
    + EDGES
    + """
        if (Simd::mask(inside)) {
"""
    + DISTANCE
    + """
            if (Simd::mask(inside & (reach > 0.0f) & (reach < weight * t_best)))
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
"""
    + TRACEABLE
    + """
    return accel.packets != 0 && traceable
        && Query::run((const float*)accel.nodes, (const float*)accel.packets, accel.flat, accel.center.c,
                      accel.extent, o[0], o[1], o[2], d[0], d[1], d[2], t_max);
"""
)


def native(name: str, source: str, width: int, function) -> wp.Function:
    """Turn a snippet into a Warp function whose name, hence the kernel cache's key, is the same in every process."""
    function.__qualname__ = function.__name__ = f"{name}_wide{width}"
    for key, value in {"$STACK": stack_size(width), "$BITS": 32 * width, "$W": width}.items():
        source = source.replace(key, str(value))
    return wp.func_native(source)(function)


@functools.cache
def make_intersect(backend: str, width: int) -> tuple[wp.Function, wp.Function]:
    """Make the queries ``closest_hit`` and ``any_hit`` of a backend.

    Both take ``(accel: Accel, o: vec3, d: vec3, t_max: float32)`` and look at distances in (0, t_max), from both sides
    of every triangle (``wp.Mesh`` includes 0); ``closest_hit`` returns a ``RayHit``, ``any_hit`` a bool.

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

    return native("closest_hit", _CLOSEST, width, closest_hit), native("any_hit", _ANY, width, any_hit)


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
