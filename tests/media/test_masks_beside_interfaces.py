"""Media that end at surfaces that are none (``null``), beside surfaces that let a part of the light through."""

import numpy as np

import warp_psdr as psdr


def seen(opacity: float) -> np.ndarray:
    """Means of four images of a ball of fog under a lamp, with a black sheet that is masked between both."""
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.8}
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    above = psdr.Transform.translate((0, 1.5, 0)) @ psdr.Transform.rotate((1, 0, 0), 90)
    scene = psdr.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 3},
            "camera": {
                "type": "perspective",
                "to_world": psdr.Transform.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0)),
                "film": {"type": "hdrfilm", "width": 8, "height": 8},
            },
            "fog": {"type": "cube", "interior": fog, "bsdf": {"type": "null"}},
            "sheet": {
                "type": "rectangle",
                "to_world": above @ psdr.Transform.scale((4, 4, 1)),
                "bsdf": {"type": "mask", "opacity": opacity, "nested": black},
            },
            "lamp": {
                "type": "rectangle",
                "to_world": psdr.Transform.translate((0, 3, 0)) @ psdr.Transform.rotate((1, 0, 0), 90),
                "emitter": {"type": "area", "radiance": 5.0},
            },
        },
        device="cpu",
    )
    return np.array([psdr.render(scene, spp=64, seed=k).numpy().mean() for k in range(4)])


def test_light_reaches_a_medium_through_a_mask_in_proportion() -> None:
    clear, half = seen(0.0), seen(0.5)
    error = 0.5 * np.hypot(0.5 * clear.std(ddof=1), half.std(ddof=1))
    assert clear.mean() > 0.01
    assert abs(half.mean() - 0.5 * clear.mean()) < 4.0 * error
