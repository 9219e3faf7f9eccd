"""A model whose normal follows from heights in a texture (Mitsuba's ``bumpmap``); see ``frame_map.py``.

The height ``scale`` h over the surface, along the shading normal, turns dp/du and dp/dv: in the shading frame, whose
first axis follows dp/du,

    dp/du = (a, 0, h_u),    dp/dv = (b, c, h_v),

so that the perturbed normal is along (-g_u, -g_v, 1) with g_u = h_u / a and g_v = (h_v - b g_u) / c; h_u and h_v hold
``scale``.
"""

import warp as wp

from warp_psdr.kernels.bsdf.composite import Child, Composite
from warp_psdr.kernels.bsdf.frame_map import BEHIND, FLIP, SHADOW, make_frame_map, refuse_frame_map
from warp_psdr.kernels.bsdf.model import METRIC, Functions, HeightTexture, Measured, PlainNumber
from warp_psdr.kernels.math import where_number


def make_bumped_normal(record: type) -> wp.Function:
    """Return ``(mat) -> vec3``: the unit normal of the displaced surface."""

    @wp.func
    def bumped_normal(mat: record) -> wp.vec3:
        a = mat.metric[0]
        c = mat.metric[2]
        # Texture coordinates that do not span the surface tell no slope.
        spans = a != 0.0 and c != 0.0
        g_u = mat.scale * mat.heights[0] / where_number(spans, a, 1.0)
        g_v = (mat.scale * mat.heights[1] - mat.metric[1] * g_u) / where_number(spans, c, 1.0)
        n = wp.vec3(where_number(spans, -g_u, 0.0), where_number(spans, -g_v, 0.0), 1.0)
        return n / wp.sqrt(wp.dot(n, n))

    return bumped_normal


def make_bump_map(record: type, variant: str, children: tuple[Child, ...]) -> Functions:
    """Return the functions of a model under a bump map."""
    return make_frame_map(record, variant, children, make_bumped_normal)


BUMP_MAP = Composite(
    "bumpmap",
    (HeightTexture("heights"), PlainNumber("scale", 1.0), FLIP, SHADOW, Measured("metric", METRIC)),
    ("nested",),
    ("nested_bsdf",),
    make_bump_map,
    refuse_frame_map,
    turns=("heights", "scale"),
    framed=True,
    behind=BEHIND,
)
