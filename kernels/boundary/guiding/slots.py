"""Items along the first coordinate of a cube: grids and curves have thousands, which come and go as the shape moves.

An item keeps its interval, and with it the masses of the cells there. A new item shares the interval of its neighbour.

Derivation: ``docs/theory/guiding.md#items-that-come-and-go``.
"""

import warp as wp


@wp.struct
class Slots:
    """Numbers of items in the order of the first coordinate, of each technique, and where in [0, 1] they begin."""

    own: wp.array(dtype=wp.int32)
    own_cdf: wp.array(dtype=wp.float64)
    light: wp.array(dtype=wp.int32)
    light_cdf: wp.array(dtype=wp.float64)


@wp.func
def choose_slot(slots: Slots, own: wp.bool, u: wp.float64) -> tuple[wp.int32, wp.float32, wp.float32]:
    """Return an item, u within its interval, and how long that is."""
    items = slots.light
    cdf = slots.light_cdf
    if own:
        items = slots.own
        cdf = slots.own_cdf
    k = wp.clamp(wp.lower_bound(cdf, u) - 1, 0, items.shape[0] - 1)
    size = cdf[k + 1] - cdf[k]
    return items[k], wp.clamp(wp.float32((u - cdf[k]) / size), 0.0, 0.9999999), wp.float32(size)
