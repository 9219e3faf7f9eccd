"""Distances on a grid: the Eikonal equation by fast sweeping, and the distance of nodes from a mesh.

[Zha05] H. Zhao: A fast sweeping method for Eikonal equations. Math. Comp. 74, 2005.

Derivation: ``docs/theory/implicit.md#distances``.
"""

import functools

import warp as wp

from warp_psdr.kernels.modules import wide_vectors


@wp.func
def godunov_distance(a: wp.vec3, h: wp.vec3) -> wp.float32:
    """The u with sum(max(u - a_i, 0)^2 / h_i^2) = 1, a the least neighbours along the axes ([Zha05], 2.4)."""
    # By size: the equation has the neighbours that are less than its solution.
    a0 = a[0]
    a1 = a[1]
    a2 = a[2]
    h0 = h[0]
    h1 = h[1]
    h2 = h[2]
    if a1 < a0:
        s = a0
        a0 = a1
        a1 = s
        s = h0
        h0 = h1
        h1 = s
    if a2 < a1:
        s = a1
        a1 = a2
        a2 = s
        s = h1
        h1 = h2
        h2 = s
    if a1 < a0:
        s = a0
        a0 = a1
        a1 = s
        s = h0
        h0 = h1
        h1 = s
    u = a0 + h0
    if u <= a1:
        return u
    # Counted from a0, so that no digits cancel.
    p = 1.0 / (h0 * h0)
    q = 1.0 / (h1 * h1)
    d = a1 - a0
    u = a0 + (q * d + wp.sqrt(wp.max(p + q - p * q * d * d, 0.0))) / (p + q)
    if u <= a2:
        return u
    r = 1.0 / (h2 * h2)
    e2 = a2 - a0
    total = p + q + r
    linear = q * d + r * e2
    square = q * d * d + r * e2 * e2 - 1.0
    return a0 + (linear + wp.sqrt(wp.max(linear * linear - total * square, 0.0))) / total


#: States of a node: to be found, given, and found from neighbours that have not changed since.
OPEN, GIVEN, SETTLED = wp.constant(0), wp.constant(1), wp.constant(2)


@wp.func
def reopen(state: wp.array3d(dtype=wp.int32), z: wp.int32, y: wp.int32, x: wp.int32):
    """Look at a node again, a neighbour of which is nearer than it was."""
    if z < 0 or y < 0 or x < 0 or z >= state.shape[0] or y >= state.shape[1] or x >= state.shape[2]:
        return
    if state[z, y, x] == SETTLED:
        state[z, y, x] = OPEN


@functools.cache
def make_sweep_kernel():
    """Return the kernel of a sweep, or of one of its planes i + j + k, whose nodes do not read each other.

    One thread a node. With ``plane`` -1 it is the whole sweep, whose threads run one after the other, as on the CPU: a
    node reads those that come before it after their turn, so that both orders have equal bits.
    """

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def sweep(
        # In:
        spacing: wp.vec3,
        plane: wp.int32,
        turned: wp.vec3i,
        # Out:
        state: wp.array3d(dtype=wp.int32),
        distance: wp.array3d(dtype=wp.float32),
        changed: wp.array(dtype=wp.int32),
    ):
        k, j, i = wp.tid()
        if plane >= 0:
            i = plane - j - k
        nx = distance.shape[2]
        ny = distance.shape[1]
        nz = distance.shape[0]
        if i < 0 or i >= nx:
            return
        x = wp.where(turned[0] == 1, nx - 1 - i, i)
        y = wp.where(turned[1] == 1, ny - 1 - j, j)
        z = wp.where(turned[2] == 1, nz - 1 - k, k)
        if state[z, y, x] != OPEN:
            return
        state[z, y, x] = SETTLED
        far = wp.static(3.0e38)
        a = wp.vec3(far, far, far)
        if x > 0:
            a[0] = wp.min(a[0], distance[z, y, x - 1])
        if x < nx - 1:
            a[0] = wp.min(a[0], distance[z, y, x + 1])
        if y > 0:
            a[1] = wp.min(a[1], distance[z, y - 1, x])
        if y < ny - 1:
            a[1] = wp.min(a[1], distance[z, y + 1, x])
        if z > 0:
            a[2] = wp.min(a[2], distance[z - 1, y, x])
        if z < nz - 1:
            a[2] = wp.min(a[2], distance[z + 1, y, x])
        if wp.min(a) >= far:
            return
        found = godunov_distance(a, spacing)
        before = distance[z, y, x]
        if found < before:
            distance[z, y, x] = found
            reopen(state, z, y, x - 1)
            reopen(state, z, y, x + 1)
            reopen(state, z, y - 1, x)
            reopen(state, z, y + 1, x)
            reopen(state, z - 1, y, x)
            reopen(state, z + 1, y, x)
            if found < before * wp.static(1.0 - 1.0e-6):
                changed[0] = 1

    return sweep


@functools.cache
def make_mesh_distance_kernel():
    """Return the kernel of signed distances from a closed mesh, one thread a node."""

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def mesh_distance(
        # In:
        mesh: wp.uint64,
        low: wp.vec3,
        spacing: wp.vec3,
        # Out:
        distance: wp.array3d(dtype=wp.float32),
    ):
        k, j, i = wp.tid()
        p = low + wp.cw_mul(spacing, wp.vec3(wp.float32(i), wp.float32(j), wp.float32(k)))
        found = wp.mesh_query_point_sign_winding_number(mesh, p, 1.0e30)
        q = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
        distance[k, j, i] = wp.where(found.sign < 0.0, -wp.length(p - q), wp.length(p - q))

    return mesh_distance
