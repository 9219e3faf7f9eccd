"""The table of shapes without triangles: what every kind declares."""

import pickle

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary.random_shapes import shape
from warp_psdr.kernels.primitive import table
from warp_psdr.kernels.primitive.kind import SLIDES
from warp_psdr.scene.kinds.kind import Geometry
from warp_psdr.scene.kinds.table import KINDS, PLUGINS, TOLD_TOGETHER

#: Kind, as ``random_shapes`` calls it -> its name in the table.
NAMES = {
    **{name: name for name in ("sphere", "disk", "cylinder", "linearcurve", "bsplinecurve")},
    "linear": "sdfgrid",
    "cubic": "cubic sdfgrid",
    "network": "neuralsdf",
}


def test_the_host_and_the_device_have_the_same_kinds() -> None:
    assert sorted(kind.device.number for kind in KINDS) == sorted(kind.number for kind in table.KINDS)
    assert len({kind.name for kind in KINDS}) == len(KINDS)
    assert max(kind.number for kind in table.KINDS) <= 30, "``is_of`` has a bit for each, of 31"


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_of_one_family_and_its_plugin_is_read(kind: type[Geometry]) -> None:
    assert sum(issubclass(kind, family) for family in TOLD_TOGETHER) == 1
    assert issubclass(kind, PLUGINS[kind.plugin])
    assert bool(kind.jumps) == (kind.device.moves == SLIDES)
    assert kind.instead and kind.invertible


@pytest.mark.parametrize("kind", NAMES)
def test_what_is_read_is_of_its_kind_and_keeps_its_parameters(kind: str) -> None:
    body = shape(np.random.default_rng(7), kind, np.array([0.0, 0.0, 0.8]), 0.5)
    held = psdr.load_dict(
        {"type": "scene", "body": body, "sky": {"type": "constant"}, "sensor": {"type": "perspective"}}
    )
    geometry = pickle.loads(pickle.dumps(held.geometry(0)))
    assert geometry.name == NAMES[kind] and type(geometry) in KINDS
    for name, value in geometry.parameters().items():
        there = held.parameters[f"body.{name}"].view(held.values).numpy()
        np.testing.assert_array_equal(there.ravel(), np.float32(value).ravel())
    others = {name for name in held.parameters if name.startswith("body.") and ".bsdf" not in name}
    assert others == {"body.to_world", *(f"body.{name}" for name in geometry.parameters())}
    # Its corners are the vertices that the pose has moved.
    assert held.vertex_count == len(geometry.corners(held.description.shapes[0].to_world))
