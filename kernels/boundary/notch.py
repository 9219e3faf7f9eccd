"""Notches: how close to an edge its two sides can be looked at where surfaces meet at an acute angle.

A ray that leaves a surface starts one step off it (``kernels/step.py``). Close to where another surface rises from the
first at an angle theta < 90 degrees, that start lies behind the other: light that shines into the notch is kept out,
and light from behind gets in. In an image that is a strip as narrow as the step. A boundary term, though, looks right
beside the edge, and would see nothing but that strip: a wedge of 30 degrees that slides over a sunlit floor had 70 % of
its derivative. At a distance r from the edge the other surface is r tan(theta) above the first, so rays have to meet it
at r > 1 / tan(theta) steps from the edge.

Who looks into the notch does so at an angle g < theta with the surface. A ray that passes the edge at one step meets
the surface at 1 / sin(g) > 1 / tan(theta): ``INTO`` steps are enough at any angle. On the other side of the surface,
where glass sends the ray and where a hidden light lets it pass, the angle is 180 - theta, and no such bound holds.
"""

import warp as wp

#: Distance in steps at which rays pass the edge of a notch that they look into.
INTO = 1.5
#: Cosine of the least angle that is none: at right angles up to roundings, every distance is enough.
RIGHT = 0.02
#: Times by which it is larger than needed in one behind, and its most, where surfaces nearly touch.
BEHIND, MOST = 2.0, 100.0


@wp.func
def facing(n: wp.vec3, d: wp.vec3) -> wp.vec3:
    """The normal of the side at which a ray along d arrives."""
    return wp.where(wp.dot(n, d) > 0.0, -n, n)


@wp.func
def notch(n_a: wp.vec3, n_b: wp.vec3, through: wp.bool) -> wp.float32:
    """Distance in steps at which rays pass the edge between two surfaces with normals that face them; 0: at any.

    ``through``: what is behind the surfaces counts, too.
    """
    cosine = wp.dot(n_a, n_b)
    r = wp.where(cosine < -RIGHT, INTO, 0.0)
    if through:
        r = wp.max(r, wp.min(BEHIND * wp.abs(cosine) / wp.length(wp.cross(n_a, n_b)), MOST))
    return r
