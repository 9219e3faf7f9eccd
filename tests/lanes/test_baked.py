"""Materials that paths side by side fetch whole are those that the scene has now, however they were changed."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients import scenes
from tests.lanes.test_lanes import images_and_gradients, sky_and_lamps
from warp_psdr.kernels.lanes.path_lanes import side_by_side

NAME = "floor.bsdf.reflectance.value"
BEFORE, AFTER = np.float32([0.6, 0.7, 0.5]), np.float32([0.2, 0.3, 0.8])


def assign(scene, params):
    params[NAME] = AFTER


def update(scene, params):
    params[NAME].assign(AFTER)
    params.update(NAME)


def write_in_place(scene, params):
    params[NAME].assign(AFTER)


def write_on_tape(scene, params):
    with wp.Tape():
        wp.copy(params[NAME], wp.array(AFTER, dtype=float, device=scene.device))


def restore(scene, params):
    params[NAME] = AFTER
    state = scene.state()
    params[NAME] = BEFORE
    results(scene)
    scene.restore(state)


def step(scene, params):
    params.requires_grad(NAME)
    optimizer = psdr.optim.Adam(params, lr=0.05)
    params[NAME].grad.fill_(1.0)
    optimizer.step()


def load(color=BEFORE):
    return psdr.load_dict({**sky_and_lamps(), "floor": {"type": "rectangle", "bsdf": diffuse(color)}})


def diffuse(color):
    return {"type": "diffuse", "reflectance": scenes.rgb(*map(float, color))}


def results(scene):
    """Return an image, a gradient and a derivative image, flat."""
    names = [name for name in scene.parameters if name.endswith((".data", ".value", "color"))]
    image, gradients, derivative = images_and_gradients(scene, 3, "sobol", 4, names)
    return np.concatenate([image.ravel(), derivative.ravel(), *(gradient.ravel() for gradient in gradients.values())])


@pytest.mark.parametrize("change", [assign, update, write_in_place, write_on_tape, restore, step])
def test_changed_values_are_read(change):
    scene = load()
    assert side_by_side(psdr.plan(scene).config)
    before = results(scene)
    params = psdr.traverse(scene)
    change(scene, params)
    after = results(scene)
    assert (after != before).any()
    np.testing.assert_array_equal(after, results(load(params[NAME].numpy())))


def test_sides_have_records_of_their_own():
    """Values that differ between the sides of a surface, seen from the front and from the back."""
    both = {"type": "twosided", "front": diffuse(BEFORE), "back": diffuse(AFTER)}
    seen = {}
    for turn, color in ((0.0, BEFORE), (180.0, AFTER)):
        pose = psdr.Transform.rotate([1, 0, 0], turn)
        for what, bsdf in (("both", both), ("one", {"type": "twosided", "bsdf": diffuse(color)})):
            scene = psdr.load_dict({**sky_and_lamps(), "floor": {"type": "rectangle", "to_world": pose, "bsdf": bsdf}})
            seen[turn, what] = psdr.render(scene, spp=3, seed=1).numpy()
        np.testing.assert_array_equal(seen[turn, "both"], seen[turn, "one"])
    assert (seen[0.0, "both"] != seen[180.0, "both"]).any()
