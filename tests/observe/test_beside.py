"""Least squares beside other effects: a board in fog behind a pane of glass."""

import numpy as np
import pytest

import warp_psdr as psdr

from .board import NEAR, POSE, TRUE, T, node

DENSITY = "fog.interior_medium.sigma_t.value.value"


def behind_glass(pose, density):
    pane = T.translate([0.0, 0.0, 0.7]) @ T.rotate([0, 1, 0], 12.0) @ T.scale([0.6, 0.6, 0.05])
    room = T.translate([0.0, 0.0, 1.6]) @ T.scale([1.0, 1.0, 0.7])
    fog = {"type": "homogeneous", "sigma_t": density, "albedo": {"type": "rgb", "value": [0.5, 0.6, 0.7]}}
    more = {
        "pane": {"type": "cube", "to_world": pane, "bsdf": {"type": "dielectric", "int_ior": 1.5}},
        "fog": {"type": "cube", "to_world": room, "bsdf": {"type": "null"}, "interior": fog},
    }
    return psdr.load_dict(node(pose, **more) | {"integrator": {"type": "volpath", "max_depth": 8}})


@pytest.mark.slow
def test_a_pose_and_a_density_come_back_through_glass():
    photograph = psdr.render(behind_glass(TRUE, 0.3), spp=1024, seed=77).numpy()
    scene = behind_glass(NEAR, 0.5)
    params = psdr.traverse(scene)
    unknowns = [psdr.unknowns.Rigid(POSE), psdr.unknowns.Entries(DENSITY)]
    found = psdr.solve(scene, params, photograph, unknowns=unknowns, spp=16)
    wrong = params[POSE].numpy() - TRUE.matrix
    assert np.abs(wrong[:3, :3]).max() < 4e-3 and np.abs(wrong[:3, 3]).max() < 5e-4
    low, high = found.interval(0.999)
    assert low[-1] < 0.3 < high[-1] and high[-1] - low[-1] < 0.02
    shift = TRUE.matrix[:3, 3] - NEAR.matrix[:3, 3]
    assert np.all((low[3:6] < shift) & (shift < high[3:6]))
