"""Material values that the geometry gives: the side, and dp/du and dp/dv in the shading frame."""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import make_bsdf
from warp_psdr.kernels.bsdf.model import GEOMETRY, METRIC
from warp_psdr.kernels.bsdf.record import Slot
from warp_psdr.kernels.generated import make_generated


@functools.cache
def make_measures(models: tuple[str, ...], material: tuple[Slot, ...]) -> wp.Function | None:
    """Return ``measured(m: record, side, metric: vec3) -> record``, which fills them in; None: there are none.

    ``metric``: dp/du along the frame's first axis, then dp/dv along the first and the second.
    """
    names = {slot.name: "metric" if slot.source == METRIC else "side" for slot in material if slot.source in GEOMETRY}
    if not names:
        return None
    lines = ["def measured(m: record, side: wp.float32, metric: wp.vec3) -> record:"]
    lines += [f"    m.{name} = {value}" for name, value in names.items()]
    return make_generated("\n".join([*lines, "    return m\n"]), record=make_bsdf(models).record)


def measures_metric(material: tuple[Slot, ...]) -> bool:
    """Whether some value needs dp/du and dp/dv."""
    return any(slot.source == METRIC for slot in material)
