"""Ray queries for W rays that lie close together: camera rays of a pixel, or shadow rays from neighbours to one light.

SIMD runs over the rays here, one ray a lane: the bundle walks the tree of ``wide.py`` once for all of its rays. Each
ray has the hit that it has alone. Rays that differ in a sign or in their largest component are traced one by one.

Derivation: ``docs/theory/rays.md#bundles-of-coherent-rays``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.simd import BARYCENTRICS, DISTANCE, EDGES, ORDER, TYPES
from warp_psdr.kernels.bvh.wide import Accel, AnyHit, Ray, RayHit, make_intersect, native
from warp_psdr.kernels.lanes.lanes import ROWS, make_record

#: Reads one corner for all lanes, where a single ray reads one lane's corner each.
EDGES_OF_ONE = EDGES.replace("Simd::load(packet", "Simd::splat(corner")

_START = (
    TYPES
    + """
    struct Bundle {
    // Smallest and largest lane. As integers: a reduction of floats is a chain.
    static int order(int bits) { return bits ^ ((bits >> 31) & 0x7fffffff); }
    static vi order(vi bits) { return bits ^ ((bits >> 31) & 0x7fffffff); }
    static float lowest(vf a) {
        return __builtin_bit_cast(float, order(__builtin_reduce_min(order(__builtin_bit_cast(vi, a)))));
    }
    static float highest(vf a) {
        return __builtin_bit_cast(float, order(__builtin_reduce_max(order(__builtin_bit_cast(vi, a)))));
    }
    static bool all(vi a) { return Simd::mask(a) == (u32)((1ll << $W) - 1); }
    static bool none(vi a) { return Simd::mask(a) == 0; }

    static __attribute__((noinline, min_vector_width($BITS))) bool run(
        const float* nodes, const float* packets, int flat, const float* center, float extent, const float* rays,
        float* found)
    {
    #pragma clang fp contract(off)
    vf ray_o[3], ray_d[3], size[3], from_c[3], t_best = *(const row*)(rays + 6 * $W), farthest = 0.0f;
    vf sum = t_best;
    for (int axis = 0; axis < 3; ++axis) {
        ray_o[axis] = *(const row*)(rays + axis * $W);
        ray_d[axis] = *(const row*)(rays + (3 + axis) * $W);
        size[axis] = Simd::abs(ray_d[axis]);
        sum += ray_o[axis] + ray_d[axis];
        from_c[axis] = ray_o[axis] - center[axis];
        farthest = Simd::max(farthest, Simd::abs(from_c[axis]));
    }
    bool backward = false;
    $TURN
    const vi first = (size[0] > size[1]) & (size[0] > size[2]), second = (size[0] <= size[1]) & (size[1] > size[2]);
    const int kz = all(first) ? 0 : all(second) ? 1 : 2;
    const vf largest = size[kz];
    if (!all((0.0f * sum == 0.0f) & (largest > 0.0f)) || (kz == 2 && !none(first | second)))
        return false;
    const int kx = kz == 2 ? 0 : kz + 1, ky = kx == 2 ? 0 : kx + 1;
    const vf shear_z = 1.0f / ray_d[kz], mx = -ray_d[kx] * shear_z, my = -ray_d[ky] * shear_z;
    const vf px = ray_o[kx], py = ray_o[ky], pz = ray_o[kz];
    const long long qx = kx * $W, qy = ky * $W, qz = kz * $W;

    // Slabs: entry is near side * enter_by + begin, exit is far side * leave_by + end.
    const float delta = 9.6e-7f * (highest(farthest) + extent);  // 16 u, see wide.py
    if (!(0.0f * delta == 0.0f))
        return false;  // an end beyond all floats
    vf enter_by[3], leave_by[3], begin[3], end[3];
    long long near[3], far[3];
    bool behind[3];
    for (int axis = 0; axis < 3; ++axis) {
        const vi negative = __builtin_bit_cast(vi, ray_d[axis]) < 0;
        if (!all(negative) && !none(negative))
            return false;
        const bool back = behind[axis] = (negative[0] != 0) != backward;
        const vf tiny = 1.0e-16f * largest, r = 1.0f / (size[axis] < tiny ? tiny : size[axis]);
        const vf along = back ? -from_c[axis] : from_c[axis];
        const float r0 = lowest(r), r1 = highest(r);
        enter_by[axis] = back ? -r0 : r0;
        leave_by[axis] = back ? -r1 : r1;
        begin[axis] = -(highest(along) + delta) * r0;
        end[axis] = -(lowest(along) - delta) * r1;
        near[axis] = (2 * axis + back) * $W;
        far[axis] = (2 * axis + !back) * $W;
    }
    int current = flat ? ~0 : 0;
    float stack_t[$STACK];
    int stack[$STACK];
    long long top = 0;
    float last = highest(t_best);
    vi lanes;
    for (int i = 0; i < $W; ++i)
        lanes[i] = i;
"""
)

# The nearest entry and the farthest exit of any ray, for all children at once.
_WALK = """
    for (;;) {
        while (current >= 0) {
            const float* node = nodes + (long long)current * (7 * $W);
            const int* child = (const int*)(node + 6 * $W);
            vf enter = 0.0f, leave = last;
            for (int axis = 0; axis < 3; ++axis) {
                enter = Simd::max(Simd::fma(Simd::load(node + near[axis]), enter_by[axis], begin[axis]), enter);
                leave = Simd::min(Simd::fma(Simd::load(node + far[axis]), leave_by[axis], end[axis]), leave);
            }
            const u32 hit = Simd::mask(enter <= leave);
            if (hit == 0)
                goto pop;
"""

_PACKET = """
        }
        {
        const float* packet = packets + (long long)~current * (10 * $W);
        vf enter = 0.0f, leave = last;
        for (int axis = 0; axis < 3; ++axis) {
            const vf a = Simd::load(packet + axis * $W), b = Simd::load(packet + (3 + axis) * $W);
            const vf c = Simd::load(packet + (6 + axis) * $W);
            const vf lower = Simd::min(Simd::min(a, b), c) - center[axis];
            const vf upper = Simd::max(Simd::max(a, b), c) - center[axis];
            enter = Simd::max(Simd::fma(behind[axis] ? upper : lower, enter_by[axis], begin[axis]), enter);
            leave = Simd::min(Simd::fma(behind[axis] ? lower : upper, leave_by[axis], end[axis]), leave);
        }
        const vi there = Simd::load(packet) == Simd::load(packet);  // lanes without a triangle hold NaN
        for (u32 m = Simd::mask(there & (enter <= leave)); m; m &= m - 1) {
        const int lane = __builtin_ctz(m);
        const float* corner = packet + lane;
"""

#: The triangles of the tree, up to what is done with those that a ray meets: ``inside``, ``reach``, ``weight``.
_TRIANGLES = (
    _WALK
    + ORDER
    + _PACKET
    + EDGES_OF_ONE
    + """
            if (none(inside))
                continue;
"""
    + DISTANCE
)

_NEXT = """
        }
        }
        last = highest(t_best);
        if (last <= 0.0f)
            goto done;
        if (flat && ~current + 1 < flat) {
            --current;
            continue;
        }
    pop:
        do {
            if (top == 0)
                goto done;
            --top;
        } while (stack_t[top] > last);
        current = stack[top];
    }
    done:
"""

_CLOSEST = (
    _START.replace("$TURN", "")
    + """
    vi winner = -1;
"""
    + _TRIANGLES
    + """
            const vf t = reach * Simd::inverse(weight);
            const vi closer = inside & (t > 0.0f) & (t < t_best);
            t_best = closer ? t : t_best;
            winner = closer ? vi(~current * $W + lane) : winner;
"""
    + _NEXT
    + """
    // The corners of what every ray meets, for each triangle at once: neighbours meet a few.
    const vf shear_x = mx, shear_y = my;
    vf u_best, v_best, a_x = 0.0f, a_y = 0.0f, a_z = 0.0f, b_x = 0.0f, b_y = 0.0f, b_z = 0.0f, c_x = 0.0f, c_y = 0.0f;
    vf c_z = 0.0f;
    vi faces = -1;
    int which[$W] __attribute__((aligned(64)));
    *(vi*)which = winner;
    for (u32 rest = Simd::mask(winner >= 0); rest;) {
        const int n = which[__builtin_ctz(rest)];
        const vi same = winner == n;
        const float* best = packets + (long long)(n / $W) * (10 * $W) + n % $W;
        a_x = same ? best[qx] - px : a_x;
        a_y = same ? best[qy] - py : a_y;
        a_z = same ? best[qz] - pz : a_z;
        b_x = same ? best[3 * $W + qx] - px : b_x;
        b_y = same ? best[3 * $W + qy] - py : b_y;
        b_z = same ? best[3 * $W + qz] - pz : b_z;
        c_x = same ? best[6 * $W + qx] - px : c_x;
        c_y = same ? best[6 * $W + qy] - py : c_y;
        c_z = same ? best[6 * $W + qz] - pz : c_z;
        faces = same ? vi(((const int*)best)[9 * $W]) : faces;
        rest &= ~Simd::mask(same);
    }
"""
    + BARYCENTRICS
    + """
    *(row*)found = t_best;
    *(row*)(found + $W) = winner < 0 ? vf(0.0f) : u_best;
    *(row*)(found + 2 * $W) = winner < 0 ? vf(0.0f) : v_best;
    *(int_row*)(found + 3 * $W) = faces;
    return true;
    }
    };
"""
)

# Whether the first and the last ray are closer together at their ends, by more than roundings.
_TURN = """
    vf ends[3];
    float spread = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
        const vf e = ends[axis] = Simd::fma(ray_d[axis], t_best, from_c[axis]), o = from_c[axis];
        spread += __builtin_fabsf(e[0] - e[$W - 1]) - __builtin_fabsf(o[0] - o[$W - 1]);
        spread += 1.0e-6f * __builtin_fabsf(e[0]);
    }
    backward = spread < 0.0f;
    for (int axis = 0; axis < 3 && backward; ++axis) {
        from_c[axis] = ends[axis];
        farthest = Simd::max(farthest, Simd::abs(ends[axis]));
    }
"""

_ANY = (
    _START.replace("$TURN", _TURN)
    + """
    vi blocked = 0;
"""
    + _TRIANGLES
    + """
            blocked |= inside & (reach > 0.0f) & (reach < weight * t_best);
            t_best = blocked ? vf(-1.0f) : t_best;  // looks for nothing any more
"""
    + _NEXT
    + """
    *(int_row*)found = blocked & 1;
    return true;
    }
    };
"""
)

_CALL = """
    return accel.packets != 0
        && Bundle::run((const float*)accel.nodes, (const float*)accel.packets, accel.flat, accel.center.c,
                       accel.extent, (const float*)rows.data + rays * $W, (float*)rows.data + found * $W);
"""


@functools.cache
def make_together(width: int) -> tuple[wp.Function, wp.Function]:
    """Make ``closest_together`` and ``any_together``, the queries of ``make_bundle``, which may refuse.

    They return whether the rays were close enough together to be traced.

    Args:
        width: Rays and SIMD lanes, one of ``WIDTHS``.
    """

    def closest_together(accel: Accel, rows: ROWS, rays: wp.int32, found: wp.int32) -> wp.bool:
        return wp.bool(False)  # Warp takes the type from here; the snippet is what runs

    def any_together(accel: Accel, rows: ROWS, rays: wp.int32, found: wp.int32) -> wp.bool:
        return wp.bool(False)

    return (
        native("closest_together", _CLOSEST + _CALL, width, closest_together),
        native("any_together", _ANY + _CALL, width, any_together),
    )


@functools.cache
def make_bundle(width: int) -> tuple[wp.Function, wp.Function]:
    """Make the queries ``closest_hits`` and ``any_hits`` of the wide BVH.

    Both take ``(accel: Accel, rows, rays: int, found: int)``, as the queries of ``each.py`` do: an array of uint32,
    ``width`` words a row; the first of seven rows with origins, directions and largest distances; and the first row of
    what is found: for closest hits the four of ``RayHit``, for any hit one, 1 where there is a hit. They find what the
    queries of ``make_intersect`` find.

    Args:
        width: Rays and SIMD lanes, one of ``WIDTHS``.
    """
    closest_together, any_together = make_together(width)
    closest_hit, any_hit = make_intersect("wide", width)
    get_ray, _ = make_record(Ray, width)
    _, put_hit = make_record(RayHit, width)
    _, put_any = make_record(AnyHit, width)

    @wp.func
    def closest_hits(accel: Accel, rows: ROWS, rays: wp.int32, found: wp.int32):
        if not closest_together(accel, rows, rays, found):
            for i in range(wp.static(width)):
                ray = get_ray(rows, rays, i, Ray())
                put_hit(rows, found, i, closest_hit(accel, ray.o, ray.d, ray.t_max))

    @wp.func
    def any_hits(accel: Accel, rows: ROWS, rays: wp.int32, found: wp.int32):
        if not any_together(accel, rows, rays, found):
            for i in range(wp.static(width)):
                ray = get_ray(rows, rays, i, Ray())
                hit = AnyHit()
                hit.hit = wp.where(any_hit(accel, ray.o, ray.d, ray.t_max), 1, 0)
                put_any(rows, found, i, hit)

    return closest_hits, any_hits
