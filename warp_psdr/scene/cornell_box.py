"""The Cornell box as a dictionary, under the names of Mitsuba 3's ``mi.cornell_box()``."""

from __future__ import annotations

from typing import Any

from warp_psdr.scene.transforms import Transform

#: Reflectances of the walls and radiance of the light, linear RGB, as Mitsuba has them.
_WHITE, _GREEN, _RED = (0.885809, 0.698859, 0.666422), (0.105421, 0.37798, 0.076425), (0.570068, 0.0430135, 0.0443706)
_RADIANCE = (18.387, 13.9873, 6.75357)


def cornell_box() -> dict[str, Any]:
    """Return the Cornell box, for ``psdr.load_dict``, in a new dictionary that may be changed.

    Its names, numbers and defaults are those of Mitsuba's function: 256 x 256 pixels, 64 samples a pixel, depth 8, so
    that ``psdr.traverse`` has ``"white.reflectance.value"``, ``"light.emitter.radiance.value"``,
    ``"small-box.vertex_positions"`` and so on. ``scenes/cornell_box.xml`` is the same box as a file.
    """
    t = Transform
    x, y = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8},
        "sensor": {
            "type": "perspective",
            "fov_axis": "smaller",
            "near_clip": 0.001,
            "far_clip": 100.0,
            "fov": 39.3077,
            "to_world": t.look_at(origin=[0.0, 0.0, 3.9], target=[0.0, 0.0, 0.0], up=y),
            "sampler": {"type": "independent", "sample_count": 64},
            "film": {
                "type": "hdrfilm",
                "width": 256,
                "height": 256,
                "rfilter": {"type": "gaussian"},
                "pixel_format": "rgb",
            },
        },
        "white": _diffuse(_WHITE),
        "green": _diffuse(_GREEN),
        "red": _diffuse(_RED),
        "light": {
            **_shape(
                "rectangle", "white", t.translate([0.0, 0.99, 0.01]) @ t.rotate(x, 90) @ t.scale([0.23, 0.19, 0.19])
            ),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(_RADIANCE)}},
        },
        "floor": _shape("rectangle", "white", t.translate([0.0, -1.0, 0.0]) @ t.rotate(x, -90)),
        "ceiling": _shape("rectangle", "white", t.translate([0.0, 1.0, 0.0]) @ t.rotate(x, 90)),
        "back": _shape("rectangle", "white", t.translate([0.0, 0.0, -1.0])),
        "green-wall": _shape("rectangle", "green", t.translate([1.0, 0.0, 0.0]) @ t.rotate(y, -90)),
        "red-wall": _shape("rectangle", "red", t.translate([-1.0, 0.0, 0.0]) @ t.rotate(y, 90)),
        "small-box": _shape(
            "cube", "white", t.translate([0.335, -0.7, 0.38]) @ t.rotate(y, -17) @ t.scale([0.3, 0.3, 0.3])
        ),
        "large-box": _shape(
            "cube", "white", t.translate([-0.33, -0.4, -0.28]) @ t.rotate(y, 18.25) @ t.scale([0.3, 0.61, 0.3])
        ),
    }


def _diffuse(reflectance: tuple[float, float, float]) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(reflectance)}}


def _shape(kind: str, bsdf: str, to_world: Transform) -> dict[str, Any]:
    return {"type": kind, "to_world": to_world, "bsdf": {"type": "ref", "id": bsdf}}
