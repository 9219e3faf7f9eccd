"""A checkerboard under an even sky, and poses of it."""

import numpy as np

import warp_psdr as psdr

WIDTH, HEIGHT = 40, 30
T = psdr.Transform
POSE = "board.to_world"
TRUE = T.translate([0.02, 0.01, 1.6]) @ T.rotate([1, 0, 0], 25.0) @ T.rotate([0, 1, 0], -20.0)
NEAR = T.translate([0.03, -0.01, 1.62]) @ T.rotate([1, 0, 0], 22.0) @ T.rotate([0, 1, 0], -17.0)
SQUARES = np.kron((np.add.outer(np.arange(6), np.arange(8)) % 2), np.ones((4, 4)))[..., None] * np.ones(3)


def node(pose, **more):
    """A checkerboard under an even sky."""
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    paint = {"type": "bitmap", "data": (0.2 + 0.5 * SQUARES).astype(np.float32), "raw": True, "wrap_mode": "clamp"}
    corners = np.float32([[-0.4, -0.3, 0.0], [0.4, -0.3, 0.0], [0.4, 0.3, 0.0], [-0.4, 0.3, 0.0]])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {"type": "perspective", "fov": 40.0, "film": film},
        "board": {
            "type": "mesh",
            "vertices": corners,
            "faces": np.int32([[0, 1, 2], [0, 2, 3]]),
            "texcoords": np.float32([[0, 0], [1, 0], [1, 1], [0, 1]]),
            "face_normals": True,
            "to_world": pose,
            "bsdf": {"type": "twosided", "inner": {"type": "diffuse", "reflectance": paint}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}},
        **more,
    }
