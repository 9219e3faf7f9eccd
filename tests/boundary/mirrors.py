"""Scenes whose discontinuities are seen through smooth mirrors and glass, and the rows of their table."""

import numpy as np

from .measure import Case
from .scenes import ball, box, camera, diffuse, floor, mesh, panel, register, sky
from .test_table import moved, scaled, turned

MIRROR = {"type": "conductor", "material": "none"}
GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
GILDED = {
    "type": "blendbsdf", "weight": 0.4, "paint": {"type": "diffuse", "reflectance": 0.6},
    "gilt": {"type": "conductor", "material": "none"},
}  # fmt: skip
LEAF = {"type": "mask", "opacity": 0.7, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.1}}}
THIN = {"type": "thindielectric", "int_ior": 1.8, "ext_ior": 1.0}
PLASTIC = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.6, 0.3, 0.2]}}


def shining(shape, r, g, b):
    """The shape with light of its own."""
    return {**shape, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [r, g, b]}}}


def lamp(center, radius, radiance=1.0):
    return shining(ball(center, radius, diffuse(0.0)), radiance, 0.8 * radiance, 0.6 * radiance)


def wall(z=0.8, y=1.2, half=1.6):
    """A square mirror that faces -y."""
    corners = [[-half, y, z - half], [half, y, z - half], [half, y, z + half], [-half, y, z + half]]
    return mesh(corners, [[0, 1, 2], [0, 2, 3]], MIRROR)


def behind(rfilter="tent"):
    """A lamp and a thin post behind the camera, which sees them in a mirror only."""
    return {
        "sensor": camera((0.3, -2.0, 0.6), (0.0, 1.2, 0.6), rfilter=rfilter),
        "mirror": wall(),
        "lamp": lamp((-0.6, -3.2, 0.9), 0.5),
        "post": shining(box((0.7, -3.0, 0.6), (0.04, 0.04, 0.9), diffuse(0.0), 0.3), 0.5, 1.0, 0.7),
    }


def unseen(y=-0.5):
    """A lamp that the camera looks through, at the mirror, which shows it; at y = 1.15 it runs through the mirror."""
    return {**behind(), "near": lamp((0.1, y, 0.7), 0.3, 0.7)}


def pierced():
    """A lamp behind the camera and a dim box that runs through it; and one through the mirror."""
    return {
        **behind(),
        "post": shining(box((-0.3, -3.0, 0.9), (0.45, 0.3, 0.2), diffuse(0.0), 0.5), 0.02, 0.05, 0.01),
        "stick": shining(box((0.6, 1.2, 0.7), (0.15, 0.2, 0.4), diffuse(0.0), 0.3), 0.2, 0.3, 0.8),
    }


def pierced_above():
    """The same above a floor, which the camera sees in a mirror only."""
    return {
        "sensor": camera((0.3, -1.0, 1.2), (0.0, 1.2, 0.7), fov=45.0),
        "mirror": wall(0.8, 1.2, 1.2),
        "floor": mesh([[-2, -3.5, 0], [2, -3.5, 0], [2, -1.1, 0], [-2, -1.1, 0]], [[0, 1, 2], [0, 2, 3]], diffuse(0.7)),
        "lamp": lamp((-0.3, -2.4, 1.2), 0.6, 4.0),
        "post": shining(box((0.1, -2.3, 1.1), (0.45, 0.25, 0.3), diffuse(0.0), 0.5), 0.5, 2.0, 6.0),
    }


def shadow(light):
    """A shadow on the floor, seen also in a mirror."""
    return {
        "sensor": camera((0.3, -2.6, 1.2), (0.0, 1.2, 0.6), fov=45.0),
        "mirror": wall(1.7),
        "floor": floor(),
        "occluder": ball((-0.2, -0.4, 0.9), 0.35, diffuse(0.3, 0.5, 0.7)),
        "light": light,
    }


def glass(shape):
    """Two lamps behind glass."""
    return {
        "sensor": camera((0.0, -4.0, 0.4), (0.0, 0.0, 0.0), fov=30.0),
        "glass": shape,
        "lamp": lamp((0.4, 2.0, 0.5), 0.5),
        "other": lamp((-0.8, 2.5, -0.6), 0.7, 0.5),
    }


def slab(bsdf=GLASS):
    return box((0.0, 0.0, 0.0), (1.0, 0.3, 0.8), bsdf, 0.5)


def under_a_leaf():
    """A floor in the soft shadow of a leaf, which lets a part of the light pass."""
    corners = [[-0.5, -0.4, 0.9], [0.5, -0.4, 1.0], [0.5, 0.4, 1.0], [-0.5, 0.4, 0.9]]
    return {
        "sensor": camera((0.0, -3.5, 1.0), (0.0, 0.2, 0.2), fov=40.0),
        "floor": floor(),
        "leaf": mesh(corners, [[0, 1, 2], [0, 2, 3]], LEAF),
        "light": panel((0.2, 0.3, 2.2), 0.4),
    }


def coated(bsdf=PLASTIC, **more):
    """A floor that shows a lamp and a box in its coat, and their light and shadow beneath it."""
    corners = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]]
    return {
        "sensor": camera((0.3, -2.6, 1.4), (0.0, 0.2, 0.2)),
        "floor": mesh(corners, [[0, 1, 2], [0, 2, 3]], bsdf),
        "lamp": lamp((-0.2, 1.0, 1.5), 0.5, 4.0),
        "occluder": box((0.3, 0.4, 0.55), (0.2, 0.15, 0.25), diffuse(0.3, 0.5, 0.7), 0.4),
        **more,
    }


def caustic():
    """A light that turns its back on the floor reaches it by way of a mirror alone."""
    light = {"type": "area", "radiance": {"type": "rgb", "value": [8.0, 7.0, 6.0]}}
    corners = [[-1.5, -1.9, 0.5], [1.5, -1.9, 0.5], [1.5, -1.9, 2.5], [-1.5, -1.9, 2.5]]
    return {
        "sensor": camera((0.0, -5.5, 2.5), (0.0, -3.0, 0.0), fov=30.0),
        "floor": mesh([[-2, -4, 0], [2, -4, 0], [2, -2.1, 0], [-2, -2.1, 0]], [[0, 1, 2], [0, 2, 3]], diffuse(0.7)),
        "mirror": wall(1.7, 0.0, 2.5),
        "lamp": mesh(corners, [[0, 2, 1], [0, 3, 2]], diffuse(0.0), emitter=light),
        "occluder": box((0.3, -0.8, 0.6), (0.3, 0.1, 0.3), diffuse(0.0), 0.4),
    }


def point(intensity=20.0):
    return {"type": "point", "position": [0.6, -0.9, 3.0], "intensity": {"type": "rgb", "value": intensity}}


register(
    {
        "behind": behind,
        "behind box": lambda: behind("box"),
        "point in a mirror": lambda: shadow(point()),
        "soft in a mirror": lambda: shadow(panel((0.5, -0.8, 2.2), 0.5)),
        "slab": lambda: glass(slab()),
        "hollow slab": lambda: glass(slab(THIN)),
        "no slab": lambda: glass(slab({"type": "null"})),
        "under a leaf": under_a_leaf,
        "behind a leaf": lambda: glass(slab(LEAF)),
        "faceted glass": lambda: glass(ball((0.0, 0.0, 0.0), 0.7, GLASS)),
        "glass ball": lambda: glass(ball((0.0, 0.0, 0.0), 0.7, GLASS, subdivisions=2, smooth=True)),
        "mirror ball": lambda: {
            **behind(),
            "mirror": ball((0.0, 1.5, 0.6), 1.0, MIRROR, subdivisions=2, smooth=True),
            "lamp": lamp((-1.6, -2.6, 1.9), 0.9),
        },
        "pierced": pierced,
        "pierced above": pierced_above,
        "pierced glass": lambda: {**glass(slab()), "other": lamp((0.0, 2.2, 0.1), 0.6, 0.5)},
        "caustic": caustic,
        "plastic floor": coated,
        "gilded floor": lambda: coated(GILDED),
        "plastic ball": lambda: coated(occluder=ball((0.2, 0.3, 0.5), 0.4, PLASTIC, subdivisions=2, smooth=True)),
        "plastic in a mirror": lambda: coated(mirror=wall(1.0, 1.7, 1.0)),
        "unseen in a mirror": unseen,
        "unseen in its mirror": lambda: unseen(1.15),
        "unseen before glass": lambda: {**glass(slab()), "near": lamp((0.2, -1.2, 0.1), 0.25, 0.6)},
        "mirror and sky": lambda: {**behind(), "sky": sky(0.3)},
    }
)

ALONG = moved(1.0, 0.3, 0.4)
LAMP, WALL, GLASSES, ETA = (
    "lamp.vertex_positions",
    "mirror.vertex_positions",
    "glass.vertex_positions",
    "glass.bsdf.eta",
)
CAMERA, OCCLUDER, POST = "sensor.to_world", "occluder.vertex_positions", "post.vertex_positions"
STICK, NEAR = "stick.vertex_positions", "near.vertex_positions"
MANY = {"spp": 2048, "difference_spp": 8192}
CASES = [
    # Objects in a flat mirror.
    Case("behind", LAMP, ALONG, 0.01, "lamp moves", **MANY),
    Case("behind box", LAMP, scaled, 0.01, "lamp scales", **MANY),
    Case("behind", POST, ALONG, 0.005, "thin post moves", **MANY),
    Case("behind", WALL, turned(2), 0.002, "mirror turns", **MANY),
    Case("behind", CAMERA, ALONG, 0.01, "camera moves", **MANY),
    # In a curved one.
    Case("mirror ball", WALL, ALONG, 0.002, "mirror moves", spp=4096, difference_spp=16384),
    Case("mirror ball", LAMP, ALONG, 0.01, "lamp moves", spp=4096, difference_spp=16384),
    # Through glass.
    Case("slab", LAMP, ALONG, 0.01, "lamp moves", depth=4, spp=1024, difference_spp=4096),
    Case("slab", GLASSES, turned(2), 0.01, "slab turns", depth=4, **MANY),
    Case("slab", ETA, np.ones_like, 0.01, "index changes", depth=4, **MANY),
    # Through thin glass, and through nothing.
    Case("hollow slab", LAMP, ALONG, 0.01, "lamp moves", depth=4, spp=1024, difference_spp=4096),
    Case("hollow slab", GLASSES, turned(2), 0.01, "slab turns", depth=4, spp=12288, difference_spp=49152),
    Case("hollow slab", CAMERA, ALONG, 0.01, "camera moves", depth=4, **MANY),
    Case("no slab", LAMP, ALONG, 0.01, "lamp moves", depth=4, spp=1024, difference_spp=4096),
    Case("under a leaf", "leaf.vertex_positions", ALONG, 0.02, "leaf moves", depth=4, spp=16384, difference_spp=65536),
    Case("under a leaf", "light.vertex_positions", ALONG, 0.02, "light moves", depth=4, spp=8192, difference_spp=32768),
    Case("behind a leaf", LAMP, ALONG, 0.01, "lamp moves", depth=4, spp=1024, difference_spp=4096),
    Case("faceted glass", GLASSES, ALONG, 0.005, "glass moves", depth=4, spp=256, difference_spp=2048),
    Case("faceted glass", ETA, np.ones_like, 0.005, "index changes", depth=4, **MANY),
    Case("glass ball", LAMP, ALONG, 0.01, "lamp moves", depth=4, spp=1024, difference_spp=4096),
    Case("glass ball", GLASSES, ALONG, 0.002, "glass moves", depth=4, **MANY),
    Case("glass ball", ETA, np.ones_like, 0.005, "index changes", depth=4, spp=6144, difference_spp=24576),
    # Surfaces that run through each other.
    Case("pierced", LAMP, scaled, 0.01, "lamp scales", **MANY),
    Case(
        "pierced",
        "stick.vertex_positions",
        moved(0.3, 1.0, 0.4),
        0.01,
        "stick moves",
        spp=64,
        difference_spp=512,
        slow=False,
    ),
    Case("pierced", WALL, turned(2), 0.002, "mirror turns", **MANY),
    Case("pierced above", POST, ALONG, 0.02, "box moves", depth=3, **MANY),
    Case("pierced above", LAMP, scaled, 0.02, "lamp scales", depth=3, **MANY),
    Case("pierced glass", LAMP, ALONG, 0.01, "lamp moves", depth=4, spp=1024, difference_spp=4096),
    # Light that mirrors throw on a floor.
    # The lamp's lower edge cuts off its own image: with a step of 0.05 a difference is 5 % less than its limit.
    Case("caustic", LAMP, scaled, 0.02, "lamp scales", depth=3, spp=49152, difference_spp=65536),
    Case("caustic", WALL, moved(0.0, 1.0, 0.3), 0.05, "mirror moves", depth=3, spp=32768, difference_spp=65536),
    Case("caustic", OCCLUDER, scaled, 0.05, "occluder scales", depth=3, spp=32768, difference_spp=32768),
    # Shadows in a mirror.
    Case("point in a mirror", OCCLUDER, ALONG, 0.01, "occluder moves", depth=3, spp=512, difference_spp=2048),
    Case("point in a mirror", "light.position", ALONG, 0.02, "light moves", depth=3, **MANY),
    Case("point in a mirror", WALL, turned(2), 0.005, "mirror turns", depth=3, **MANY),
    Case("soft in a mirror", OCCLUDER, ALONG, 0.02, "occluder moves", depth=3, spp=1024, difference_spp=4096),
    Case("soft in a mirror", "light.vertex_positions", ALONG, 0.02, "light moves", 3, spp=10240, difference_spp=8192),
    # In the coat of plastic.
    Case("plastic floor", LAMP, ALONG, 0.01, "lamp moves", depth=3, spp=1024, difference_spp=4096),
    Case("plastic floor", OCCLUDER, ALONG, 0.01, "occluder moves", depth=3, spp=4096, difference_spp=16384),
    Case(
        "plastic floor",
        "floor.vertex_positions",
        turned(0),
        0.005,
        "floor turns",
        depth=3,
        spp=4096,
        difference_spp=16384,
    ),
    Case("plastic ball", OCCLUDER, ALONG, 0.005, "ball moves", depth=3, spp=8192, difference_spp=32768),
    Case("plastic in a mirror", OCCLUDER, ALONG, 0.01, "occluder moves", depth=4, spp=4096, difference_spp=16384),
    # In a blend of a mirror and paint.
    Case("gilded floor", OCCLUDER, ALONG, 0.01, "occluder moves", depth=3, spp=4096, difference_spp=16384),
    # Through lights that the camera does not see.
    Case("unseen in a mirror", NEAR, ALONG, 0.01, "light moves", hidden=True, **MANY),
    Case("unseen in a mirror", WALL, turned(2), 0.002, "mirror turns", hidden=True, **MANY),
    Case("unseen in a mirror", CAMERA, ALONG, 0.01, "camera moves", hidden=True, **MANY),
    Case("unseen in its mirror", NEAR, moved(0.7, 0.3, 0.4), 0.01, "light moves", hidden=True, **MANY),
    Case("unseen in its mirror", NEAR, moved(0.0, 0.0, 1.0), 0.01, "light rises", hidden=True, **MANY),
    Case("unseen before glass", GLASSES, turned(2), 0.01, "slab turns", depth=4, hidden=True, **MANY),
]
