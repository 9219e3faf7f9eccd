"""Arbitrary output variables: the list ``name:type,name:type`` of Mitsuba's ``aov`` integrator."""

from __future__ import annotations

import re

from warp_psdr.scene.errors import did_you_mean, error, listing

#: Types that are computed: Mitsuba's, and ``mask``, the share of a pixel's samples that meet a surface.
TYPES = (
    *("albedo", "depth", "position", "uv", "geo_normal", "sh_normal", "dp_du", "dp_dv", "prim_index", "shape_index"),
    "mask",
)
#: Mitsuba's others, and why they are not.
_OTHERS = {
    "duv_dx": "there are no ray differentials",
    "duv_dy": "there are no ray differentials",
    "boundary_test": "boundary terms sample discontinuities instead",
}


def parse_aovs(text: str, where: str) -> dict[str, str]:
    """Return name -> type of a list such as ``dd.y:depth,nn:sh_normal``.

    Raises:
        ValueError: If a part is no pair, a name occurs twice, or a type is not computed.
    """
    result: dict[str, str] = {}
    for part in re.split(r"[,\s]+", text.strip(", \t\n")):
        name, colon, kind = part.rpartition(":")
        if not (colon and name and kind):
            raise error(where, f"got '{part}'", "give pairs of a name and a type, such as 'dd.y:depth,nn:sh_normal'")
        check_type(kind, where)
        if name in result:
            raise error(where, f"the name '{name}' occurs twice", "give every channel a name of its own")
        result[name] = kind
    return result


def check_type(kind: str, where: str) -> None:
    """Raise unless a type is computed.

    Raises:
        ValueError: It is not.
    """
    if kind not in TYPES:
        why = f", since {_OTHERS[kind]}" if kind in _OTHERS else did_you_mean(kind, TYPES)
        raise error(where, f"the type '{kind}' is not supported{why}", f"supported: {listing(TYPES)}")
