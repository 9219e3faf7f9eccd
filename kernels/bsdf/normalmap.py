"""A model whose normal a texture turns (Mitsuba's ``normalmap``); see ``frame_map.py``.

The texture, read as it is (``raw``), holds (n + 1) / 2 for the normal n in the frame of dp/du and the shading normal.
On the back of a two-sided surface the frame's second axis is the other way round, and so is that component of n.
"""

import warp as wp

from warp_psdr.kernels.bsdf.composite import Child, Composite
from warp_psdr.kernels.bsdf.frame_map import BEHIND, FLIP, SHADOW, make_frame_map, refuse_frame_map
from warp_psdr.kernels.bsdf.model import SIDE, Functions, Measured, NormalTexture
from warp_psdr.kernels.math import where3, where_number

#: Squared length below which a texel holds no direction, and the surface keeps its own.
NO_DIRECTION = 1.0e-12


def make_mapped_normal(record: type) -> wp.Function:
    """Return ``(mat) -> vec3``: the unit normal that the texture holds."""

    @wp.func
    def mapped_normal(mat: record) -> wp.vec3:
        n = 2.0 * mat.normalmap - wp.vec3(1.0, 1.0, 1.0)
        n = wp.vec3(n[0], mat.side * n[1], n[2])
        squared = wp.dot(n, n)
        turned = squared > NO_DIRECTION
        return where3(turned, n / wp.sqrt(where_number(turned, squared, 1.0)), wp.vec3(0.0, 0.0, 1.0))

    return mapped_normal


def make_normal_map(record: type, variant: str, children: tuple[Child, ...]) -> Functions:
    """Return the functions of a model under a normal map."""
    return make_frame_map(record, variant, children, make_mapped_normal)


NORMAL_MAP = Composite(
    "normalmap",
    (NormalTexture("normalmap"), FLIP, SHADOW, Measured("side", SIDE)),
    ("nested",),
    ("nested_bsdf",),
    make_normal_map,
    refuse_frame_map,
    turns=("normalmap",),
    framed=True,
    behind=BEHIND,
)
