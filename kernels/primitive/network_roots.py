"""The zeros of a network on a line through a cell, in order, without losing one.

In a part of the line with the middle value f, slope g, half length h and the bound b of the cell's second derivatives,
phi lies within |g| h + b h^2 / 2 of f. If that is less than |f|, phi has one sign. If |g| > b h, phi is monotone: the
signs at its ends tell whether there is a root, which Newton's steps find inside of a bracket. Other parts are halved.

Derivation: ``docs/theory/implicit.md#networks``.
"""

import functools

import warp as wp

from warp_psdr.kernels.primitive.network import phi_along
from warp_psdr.kernels.primitive.sdfgrid import ITERATIONS
from warp_psdr.kernels.structs import Scene

#: Halvings of a cell's part of a line, after which the far end of what is left decides.
DEEPEST = 14
#: Newton's step, over a cell's part of a line, which is the last one.
SETTLED = 1.0e-7


@wp.func
def only_root(
    scene: Scene, head: wp.int32, q: wp.vec3, way: wp.vec3, low: wp.float32, high: wp.float32, inside: wp.bool
) -> wp.float32:
    """Where phi(q + s way), monotone in [low, high], becomes negative, or with ``inside`` ceases to be."""
    a = wp.float32(low)
    b = wp.float32(high)
    s = 0.5 * (low + high)
    for _k in range(wp.static(ITERATIONS)):
        f = phi_along(scene.values, head, q + s * way, way)
        if (f[0] < 0.0) == inside:
            a = s
        else:
            b = s
        following = s - f[0] / f[1]
        # False for NaN, too.
        if not (following > a and following < b):
            following = 0.5 * (a + b)
        settled = wp.abs(following - s) <= wp.static(SETTLED) or following == a or following == b
        s = following
        if settled:
            break
    return s


@functools.cache
def make_network_root(every: bool):
    """Return ``root(scene, head, q, way, bend, inside, choice) -> (s, count)`` of phi(q + s way), s in [0, 1].

    The first root, behind which phi is no longer negative (``inside``), or is so; or with ``every`` one of all roots,
    each as likely by ``choice``. ``count`` is how many there are, of the first one 1 at most; ``head`` the place of the
    network, ``bend`` the bound of its second derivatives along ``way``. Parts are visited in order, each once, and
    there are 2^``DEEPEST`` at most: no bound is left that could be exhausted.
    """

    @wp.func
    def network_root(
        scene: Scene,
        head: wp.int32,
        q: wp.vec3,
        way: wp.vec3,
        bend: wp.float32,
        inside: wp.bool,
        choice: wp.float32,
    ) -> tuple[wp.float32, wp.float32]:
        root = wp.float32(-1.0)
        count = wp.float32(0.0)
        u = wp.float32(choice)
        negative = inside
        level = wp.int32(0)
        n = wp.int32(0)
        width = wp.float32(1.0)
        while level >= 0:
            low = wp.float32(n) * width
            half = 0.5 * width
            f = phi_along(scene.values, head, q + (low + half) * way, way)
            steep = wp.abs(f[1])
            met = wp.float32(-1.0)
            one_sign = wp.abs(f[0]) > half * (steep + 0.5 * bend * half)
            monotone = steep > bend * half
            if one_sign:
                # Only after rounding has lost a root.
                if (f[0] < 0.0) != negative:
                    met = low
            elif monotone or level >= wp.static(DEEPEST):
                if (phi_along(scene.values, head, q + (low + width) * way, way)[0] < 0.0) != negative:
                    met = low + width
                    if monotone:
                        met = only_root(scene, head, q, way, low, low + width, negative)
            else:
                level += 1
                n *= 2
                width = half
                continue
            if met >= 0.0:
                count += 1.0
                negative = not negative
                if wp.static(not every):
                    return met, count
                # The latest of n roots is kept with the probability 1 / n.
                if u * count < 1.0:
                    root = met
                    u = u * count
                else:
                    u = (u - 1.0 / count) / (1.0 - 1.0 / count)
            n += 1
            while level > 0 and (n & 1) == 0:
                n = n >> 1
                level -= 1
                width *= 2.0
            if level == 0:
                level = -1
        return root, count

    return network_root
