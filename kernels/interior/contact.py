"""Contacts: the interior term's fireflies where a moving surface touches another, and what is done about them.

In material form the geometric factor between a path vertex p and the next one q, towards the source, changes by the
rate dG/G ~ v / r when q moves relative to p with v, r = |q - p|. Paths are drawn with a density proportional to G, so a
sample is as large as v / r. Near a line of contact of the two surfaces r gets as small as the distance a of p from the
surface of q, and a is spread evenly: the samples have a tail P(|X| > t) ~ 1/t and no variance. Their mean exists in the
order in which a path is drawn, p first: with b the distance of q from the surface of p, G = a b / r^4, and the
integral over q of dG/da at a fixed a is dF/da, F(a) the form factor of q's surface, which is smooth down to a = 0.
(The jump F(0+) itself is the boundary term's: the segment p -> q whose end q is the contact, ``boundary/local_form``.)

So the relative velocity of a connection is multiplied by

    chi(a) = min(1, (a / rho)^2),    a = distance of p from the tangent plane of q,  rho = ``Scene.contact_radius``.

Where q's surface is flat over lengths rho, chi is constant for a given p, and what is lost is the integral of
(1 - chi) dF/da over a < rho: a bias of O(rho / L), L the size of the surfaces that touch. That holds for a weight
which depends on a alone; a cut at a fixed r would leave an error that does not vanish with rho. No sample exceeds
v / rho. A finite difference of step h has the same order of both: noise of v / h, remainder of h. rho = 0: no weight.
"""

import warp as wp

from warp_psdr.kernels.structs import Scene


@wp.func
def contact_weight(scene: Scene, a: wp.float32) -> wp.float32:
    """chi, the weight of the relative velocity of two connected vertices; a may have either sign."""
    t = wp.abs(a)
    if t >= scene.contact_radius:
        return 1.0
    t /= scene.contact_radius
    return t * t
