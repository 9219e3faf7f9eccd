"""``render_moment``: second moments of samples, by closed forms."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import assert_same_mean

RADIANCE = np.array([2.0, 0.5, 3.0])


def scene_of(rfilter="box", **more):
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": rfilter}}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": list(RADIANCE)}}
    pose = psdr.Transform.look_at([0.1, 0.2, 4.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    return psdr.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "moment", "nested": {"type": "path", "max_depth": 3}},
            "sensor": {"type": "perspective", "fov": 40, "to_world": pose, "film": film},
            "lamp": {"type": "rectangle", "emitter": lamp},
            **more,
        }
    )


def test_samples_that_see_a_light_or_nothing():
    """A sample is L or 0, so its square is L times itself, in every pixel, at the light's edges too."""
    image, second = psdr.render_moment(scene_of(), spp=32, seed=2)
    assert 0.1 < np.mean((image.numpy() > 0.0) & (image.numpy() < RADIANCE)) < 0.9
    np.testing.assert_allclose(second.numpy(), RADIANCE * image.numpy(), rtol=1e-6)


def test_the_variance_is_that_of_images():
    pose = psdr.Transform.look_at([0.0, 0.0, 2.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]) @ psdr.Transform.scale(0.5)
    lamp = {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": 3.0}}
    scene = scene_of(lamp=lamp, floor={"type": "rectangle", "to_world": psdr.Transform.scale(3.0)})
    spp, repeats = 32, 16
    found = [[a.numpy().astype(float) for a in psdr.render_moment(scene, spp=spp, seed=s)] for s in range(repeats)]
    images, seconds = (np.array(values) for values in zip(*found, strict=True))
    predicted = (seconds - images**2) / (spp - 1)
    deviations = (images - images.mean(axis=0)) ** 2 * repeats / (repeats - 1)
    assert_same_mean(deviations.mean(axis=(1, 2, 3)), predicted.mean(axis=(1, 2, 3)), "variance")


def test_filters_that_share_samples_are_refused():
    with pytest.raises(ValueError, match="'box' filter"):
        psdr.render_moment(scene_of("gaussian"), spp=2)
