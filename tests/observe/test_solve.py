"""Least squares on photographs: poses, grey levels and exposure come back, with error bars that hold them."""

import numpy as np
import pytest

import warp_psdr as psdr

from .board import HEIGHT, NEAR, POSE, SQUARES, TRUE, WIDTH, T, node


def solved(photo, **more):
    scene = psdr.load_dict(node(NEAR))
    params = psdr.traverse(scene)
    observed = psdr.Photograph(photo, unknowns=["exposure"])
    found = psdr.solve(scene, params, observed, unknowns=[psdr.unknowns.Rigid(POSE)], spp=8, **more)
    return params, found


def test_a_pose_and_an_exposure_come_back_within_their_bars(photo, tmp_path):
    told = []
    params, found = solved(photo, progress=told.append)
    assert len(told) == len(found.steps) <= 14 and "taken" in str(told[0])
    wrong = params[POSE].numpy() - TRUE.matrix
    assert np.abs(wrong[:3, :3]).max() < 3e-3 and np.abs(wrong[:3, 3]).max() < 2e-3
    assert found.labels[-1] == "exposure" and found.covariance.shape == (7, 7)
    low, high = found.interval(0.999)
    assert low[-1] < 0.7 < high[-1] and high[-1] - low[-1] < 0.03
    shift = TRUE.matrix[:3, 3] - NEAR.matrix[:3, 3]
    assert np.all((low[3:6] < shift) & (shift < high[3:6]))
    assert 0.001 < found.rms < 0.02
    sizes = [size for size, _direction in found.directions]
    assert sizes == sorted(sizes, reverse=True) and len(sizes) == 7
    softest = found.motion(params)
    assert list(softest) == [POSE] and np.abs(softest[POSE]).max() > 0.5 * found.std[:6].max()
    psdr.view(params.scene, params, fields=softest, screenshot=tmp_path / "softest.png")
    assert (tmp_path / "softest.png").stat().st_size > 1000
    assert "95 % bars" in str(found) and "exposure" in found._repr_html_()


def test_equal_seeds_give_equal_results(photo):
    with pytest.warns(RuntimeWarning, match="2 steps were not enough"):
        first, second = solved(photo, steps=2, seed=3)[1], solved(photo, steps=2, seed=3)[1]
    np.testing.assert_array_equal(first.values, second.values)


def test_tangents_of_a_rigid_motion_are_differences():
    scene = psdr.load_dict(node(NEAR))
    params = psdr.traverse(scene)
    for name, about in ((POSE, None), ("board.vertex_positions", [0.1, 0.2, 1.0])):
        unknown = psdr.unknowns.Rigid(name, about)
        rows, state, h = unknown.tangents(params), unknown.state(params), 1e-3
        for i, row in enumerate(rows):
            ends = []
            for sign in (1.0, -1.0):
                unknown.move(params, sign * h * np.eye(6)[i])
                ends.append(params[name].numpy().astype(float))
                unknown.restore(params, state)
            np.testing.assert_allclose(row[name], (ends[0] - ends[1]) / (2.0 * h), atol=1e-3)
            assert np.abs(row[name]).max() > 0.1


def test_a_function_of_few_numbers_moves_parameters(photo):
    scene = psdr.load_dict(node(TRUE))
    params = psdr.traverse(scene)
    name = next(n for n in params if n.endswith("reflectance.data"))
    levels = psdr.unknowns.Function(lambda x: {name: x[0] + x[1] * SQUARES}, [0.3, 0.3], ["dark", "contrast"])
    levels.restore(params, levels.x)
    params.update()
    found = psdr.solve(scene, params, psdr.Photograph(photo, exposure=0.7), unknowns=[levels], spp=8)
    np.testing.assert_allclose(found.values, [0.2, 0.5], atol=0.02)
    low, high = found.interval(0.999)
    assert np.all((low < [0.2, 0.5]) & ([0.2, 0.5] < high))


def test_steps_out_of_a_range_are_not_taken(photo):
    scene = psdr.load_dict(node(TRUE))
    params = psdr.traverse(scene)
    name = next(n for n in params if n.endswith("reflectance.data"))
    levels = psdr.unknowns.Function(lambda x: {name: x[0] + x[1] * SQUARES}, [0.3, 0.3])
    levels.restore(params, levels.x)
    # At this exposure the light squares reflect more than all.
    with pytest.warns(RuntimeWarning) as told:
        found = psdr.solve(scene, params, psdr.Photograph(photo, exposure=0.45), unknowns=[levels], spp=8, steps=8)
    assert any("8 steps were not enough" in str(warning.message) for warning in told)
    assert 0.9 < found.values.sum() <= 1.0
    np.testing.assert_allclose(params[name].numpy().max(), found.values.sum(), rtol=1e-6)


def test_what_pictures_do_not_tell_is_named(photo):
    scene = psdr.load_dict(node(TRUE))
    params = psdr.traverse(scene)
    params.requires_grad("sky.radiance.value")
    both = psdr.Photograph(photo, exposure=0.7, unknowns=["white_balance"])
    with pytest.warns(RuntimeWarning, match="the pictures do not tell .* together with"):
        found = psdr.solve(scene, params, both, spp=8)
    assert np.isinf(found.std).all() and len(found.undetermined) == 3
    assert "not determined" in str(found)
    with pytest.raises(ValueError, match="the pictures do not tell"):
        found.motion(params)


def test_a_wrong_start_is_told(photo):
    scene = psdr.load_dict(node(T.translate([0.0, 0.0, 3.5]) @ T.rotate([1, 0, 0], -40.0)))
    params = psdr.traverse(scene)
    upside = np.ascontiguousarray(255 - photo)
    with pytest.warns(RuntimeWarning) as told:
        psdr.solve(scene, params, psdr.Photograph(upside), unknowns=[psdr.unknowns.Rigid(POSE)], spp=4, steps=2)
    assert any("does not look like them" in str(warning.message) for warning in told)


def test_two_cameras_share_an_unknown(photo):
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    aside = {"type": "perspective", "fov": 40.0, "to_world": T.translate([0.05, 0.0, 0.0]), "film": film}
    truth = psdr.load_dict(node(TRUE, aside=aside))
    images = {s: psdr.render(truth, sensor=s, spp=128, seed=7).numpy() for s in (0, "aside")}
    scene = psdr.load_dict(node(NEAR, aside=aside))
    params = psdr.traverse(scene)
    unknowns = [psdr.unknowns.Rigid(POSE), psdr.unknowns.Entries("aside.x_fov")]
    params["aside.x_fov"] = np.float32([39.0])
    params.update()
    found = psdr.solve(scene, params, images, unknowns=unknowns, spp=8)
    assert found.labels[-1] == "aside.x_fov" and abs(found.values[-1] - 40.0) < 0.1
    assert np.abs(params[POSE].numpy() - TRUE.matrix)[:3].max() < 3e-3


def test_bad_requests_are_refused(photo):
    scene = psdr.load_dict(node(NEAR))
    params = psdr.traverse(scene)
    with pytest.raises(ValueError, match="nothing is unknown"):
        psdr.solve(scene, params, psdr.Photograph(photo))
    with pytest.raises(ValueError, match="40 x 29 pixels, the film"):
        psdr.solve(scene, params, psdr.Photograph(photo[1:], unknowns=["exposure"]))
    params.requires_grad("board.bsdf.*.data")
    with pytest.raises(ValueError, match="takes up to 512"):
        psdr.solve(scene, params, psdr.Photograph(photo), method="dense")
    with pytest.raises(ValueError, match="expected one of 'auto', 'dense', 'conjugate_gradients'"):
        psdr.solve(scene, params, psdr.Photograph(photo), method="newton")
    scene = psdr.load_dict(node(T.translate([0.0, 0.0, -3.0])))
    params = psdr.traverse(scene)
    with pytest.raises(ValueError, match="no unknown changes any picture"):
        psdr.solve(scene, params, psdr.Photograph(photo), unknowns=[psdr.unknowns.Rigid(POSE)], spp=1)
