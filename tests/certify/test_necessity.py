"""What gradients lose without an effect: all of a silhouette's, nothing of a colour's, and what longer paths bring."""

import json

import numpy as np
import pytest

import warp_psdr as psdr

COLOR, SHAPE = "red.reflectance.value", "small-box.vertex_positions"


def lost(certificate, option):
    return {e.parameter: e for e in certificate.effects if e.option == option}


def test_a_colour_needs_no_boundary_and_a_shape_does(tmp_path):
    description = psdr.cornell_box()
    description["sensor"]["film"] |= {"width": 12, "height": 12}
    scene = psdr.load_dict(description)
    params = psdr.traverse(scene)
    params.requires_grad(COLOR, SHAPE)
    integrator = psdr.PathIntegrator(max_depth=3)
    found = psdr.certify(scene, params, integrator=integrator, budget=60.0, checks="necessity")
    assert [e.option for e in found.effects] == ["boundary=None"] * 2 + ["max_depth=2"] * 2
    without = lost(found, "boundary=None")
    assert without[COLOR].lost == pytest.approx(0.0, abs=1e-6)
    assert without[SHAPE].lost > 0.2 and without[SHAPE].lost > 5.0 * without[SHAPE].error
    assert 0.0 < without[SHAPE].saved < 1.0
    short = lost(found, "max_depth=2")[COLOR]
    # The same by hand: the first channel of the red wall, in direct light and with one bounce more.
    both = []
    for depth in (2, 3):
        image = np.zeros(3)
        for seed in range(4):
            given = {COLOR: np.float32([1.0, 0.0, 0.0])}
            shorter = psdr.PathIntegrator(max_depth=depth)
            moved = psdr.render_forward(scene, params, given, integrator=shorter, spp=64, seed=seed)
            image += moved.numpy().astype(float).mean(axis=(0, 1))
        both.append(image[0])
    assert short.lost == pytest.approx(1.0 - both[0] / both[1], abs=0.15)
    assert short.lost > 5.0 * short.error > 0.0
    assert "boundary=None" in str(found) and "loses" in found._repr_html_()
    found.save(tmp_path / "c.json")
    assert json.loads((tmp_path / "c.json").read_text())["effects"][0]["option"] == "boundary=None"
