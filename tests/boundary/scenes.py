"""Scenes of the boundary term's table: small, coarse, and with discontinuities that count."""

import functools

import numpy as np
import trimesh

import warp_psdr as psdr

T = psdr.Transform
SIZE = 16  # pixels
WHITE = {"type": "rgb", "value": [1.0, 1.0, 1.0]}


def camera(origin=(0.0, -3.5, 3.0), target=(0.0, 0.0, 0.3), up=(0.0, 0.0, 1.0), fov=40.0, rfilter="tent"):
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": T.look_at(list(origin), list(target), list(up)),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": rfilter}},
    }


def diffuse(r, g=None, b=None):
    return {
        "type": "diffuse",
        "reflectance": {"type": "rgb", "value": [r, r if g is None else g, r if b is None else b]},
    }


def mesh(vertices, faces, bsdf, **more):
    return {
        "type": "mesh",
        "vertices": np.asarray(vertices, np.float32),
        "faces": np.asarray(faces, np.int32),
        "bsdf": bsdf,
        **more,
    }


def ball(center, radius, bsdf, subdivisions=1, smooth=False, **more):
    m = trimesh.creation.icosphere(subdivisions=subdivisions)
    return mesh(radius * np.asarray(m.vertices) + center, m.faces, bsdf, face_normals=not smooth, **more)


def box(center, half, bsdf, turn=0.0, split=False):
    """A box turned about z by ``turn`` radians; ``split``: every face has vertices of its own."""
    m = trimesh.creation.box(extents=2.0 * np.asarray(half))
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    vertices, faces = np.asarray(m.vertices) @ rotation.T + center, np.asarray(m.faces)
    if split:
        vertices, faces = vertices[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)
    return mesh(vertices, faces, bsdf, face_normals=True)


def floor(z=0.0, half=3.0, bsdf=None):
    return {
        "type": "rectangle",
        "to_world": T.translate([0, 0, z]) @ T.scale(half),
        "bsdf": bsdf or diffuse(0.7, 0.6, 0.5),
    }


def panel(center, half, radiance=8.0):
    """A square light that faces down."""
    x, y, z = center
    corners = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]], np.float32)
    return mesh(
        corners + np.array([x, y, z], np.float32),
        [[0, 2, 1], [0, 3, 2]],
        diffuse(0.0),
        emitter={"type": "area", "radiance": {"type": "rgb", "value": [radiance, 0.9 * radiance, 0.8 * radiance]}},
    )


def sky(radiance=1.0):
    return {"type": "constant", "radiance": {"type": "rgb", "value": [radiance] * 3}}


def occluder():
    return ball((0.1, 0.1, 0.9), 0.4, diffuse(0.5, 0.4, 0.6))


def silhouette(rfilter, **more):
    return {
        "sensor": camera((0, -4, 0.5), (0, 0, 0), rfilter=rfilter),
        "sky": sky(),
        "shape": ball((0.1, 0, 0.1), 0.8, diffuse(0.3, 0.5, 0.7), **more),
    }


def under(light, rfilter="tent"):
    """An occluder above a floor."""
    return {"sensor": camera(rfilter=rfilter), "floor": floor(), "occluder": occluder(), "light": light}


def checkers():
    """Two colours in fields that the shadows of ``under`` cross."""
    texture = {"type": "checkerboard", "to_uv": T.scale([4, 4, 1])}
    texture["color0"] = {"type": "rgb", "value": [0.9, 0.7, 0.5]}
    texture["color1"] = {"type": "rgb", "value": [0.2, 0.3, 0.4]}
    return {"type": "diffuse", "reflectance": texture}


def instances():
    """Two occluders of one group, the second stretched and mirrored."""
    poses = {"one": T.translate([0.6, 0.1, 0.9]), "two": T.translate([-0.6, 0.0, 0.8]) @ T.scale([1.0, -0.8, 1.3])}
    group = {"type": "shapegroup", "ball": ball((0.0, 0.0, 0.0), 0.4, diffuse(0.5, 0.4, 0.6))}
    made = {n: {"type": "instance", "g": {"type": "ref", "id": "group"}, "to_world": p} for n, p in poses.items()}
    scene = under(panel((0.5, -0.3, 2.2), 0.35)) | {"group": group, **made}
    del scene["occluder"]
    return scene


def spot():
    return {
        "type": "spot",
        "to_world": T.look_at([0.6, -0.4, 3.0], [0.1, 0.1, 0.0], [0, 1, 0]),
        "intensity": {"type": "rgb", "value": [20.0, 18.0, 16.0]},
        "cutoff_angle": 35.0,
        "beam_width": 20.0,
    }


def projector():
    """It throws a picture with a black border: its light ends without an edge."""
    image = np.pad(np.linspace(0.4, 1.0, 75, dtype=np.float32).reshape(5, 5, 3), ((1, 1), (1, 1), (0, 0)))
    return {
        "type": "projector",
        "to_world": T.look_at([0.6, -0.4, 3.0], [0.1, 0.1, 0.0], [0, 1, 0]),
        "irradiance": {"type": "bitmap", "bitmap": image, "raw": True},
        "scale": 8.0,
        "fov": 55.0,
    }


def rough(alpha):
    """A rough mirror of no particular metal."""
    return {"type": "roughconductor", "alpha": alpha, "eta": {"type": "rgb", "value": 0.5}, "k": 3.0}


def envmap():
    bitmap = np.full((6, 12, 3), 0.3, np.float32)
    bitmap[1:3, 4:7] = [4.0, 3.0, 2.0]
    return {"type": "envmap", "bitmap": bitmap, "to_world": T.rotate([1, 0, 0], 90)}


def room(height=0.0, turn=0.3, lamp=False):
    """Walls of one colour each, a light (``lamp``: a point) below the ceiling, and a box on the floor, or above it."""
    c = np.array([[x, y, z] for z in (0.0, 2.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)], np.float32)
    sides = {
        "ground": ([0, 1, 3, 2], (0.7, 0.7, 0.7)),
        "ceiling": ([4, 6, 7, 5], (0.7, 0.7, 0.7)),
        "left": ([0, 2, 6, 4], (0.6, 0.1, 0.1)),
        "right": ([1, 5, 7, 3], (0.1, 0.6, 0.1)),
        "back": ([2, 3, 7, 6], (0.7, 0.7, 0.7)),
    }
    walls = {n: mesh(c[i], [[0, 1, 2], [0, 2, 3]], diffuse(*color)) for n, (i, color) in sides.items()}
    return {
        "sensor": camera((0, -4.0, 1.0), (0, 0, 1.0), fov=32.0),
        **walls,
        "light": {"type": "point", "position": [0.0, 0.1, 1.7], "intensity": {"type": "rgb", "value": 3.0}}
        if lamp
        else panel((0.0, 0.1, 1.98), 0.4, 6.0),
        "box": box((0.25, -0.2, 0.3 + height), (0.3, 0.25, 0.3), diffuse(0.6, 0.6, 0.8), turn),
    }


def close():
    """A plate that a luminous ball almost touches: their distance is 0.01."""
    shine = {"type": "area", "radiance": {"type": "rgb", "value": [9.0, 8.0, 7.0]}}
    light = ball((0.19, 0.07, 2.35), 0.25, diffuse(0.0), emitter=shine)
    corners = [[0.47, -0.62, 2.20], [0.04, -0.59, 2.25], [0.085, -0.17, 2.32], [0.51, -0.20, 2.28]]
    plate = mesh(corners, [[0, 1, 2], [0, 2, 3]], {"type": "twosided", "bsdf": diffuse(0.3)})
    return {"sensor": camera(), "floor": floor(), "occluder": plate, "light": light}


SCENES = {
    "silhouette box": lambda: silhouette("box"),
    "silhouette tent": lambda: silhouette("tent"),
    "silhouette gaussian": lambda: silhouette("gaussian"),
    "smooth": lambda: silhouette("tent", smooth=True),
    "split": lambda: {
        "sensor": camera((0, -4, 1.5), (0, 0, 0)),
        "sky": sky(),
        "shape": box((0.1, 0.0, 0.0), (0.6, 0.5, 0.4), diffuse(0.3, 0.5, 0.7), 0.4, split=True),
    },
    "soft": lambda: under(panel((0.5, -0.3, 2.2), 0.35)),
    "sky": lambda: under(sky()),
    "checkered": lambda: under(panel((0.5, -0.3, 2.2), 0.35)) | {"floor": floor(bsdf=checkers())},
    "envmap": lambda: under(envmap()),
    "point": lambda: under(
        {"type": "point", "position": [0.6, -0.4, 3.0], "intensity": {"type": "rgb", "value": 20.0}}
    ),
    "spot": lambda: under(spot()),
    "projector": lambda: under(projector()),
    "sun": lambda: under(
        {
            "type": "directional",
            "to_world": T.look_at([0.6, -0.4, 2.0], [0, 0, 0], [0, 1, 0]),
            "irradiance": {"type": "rgb", "value": [3.0, 2.5, 2.0]},
        }
    ),
    "instances": instances,
    "room": room,
    "floating": lambda: room(0.1),
    "rough": lambda: under(panel((0.5, -0.3, 2.2), 0.35)) | {"floor": floor(bsdf=rough(0.2))},
    "rough sky": lambda: under(sky()) | {"floor": floor(bsdf=rough(0.3))},
    "lamp": lambda: room(lamp=True),
    "close": close,
}


def register(scenes) -> None:
    """Add a file's scenes; names are unique, whatever files are imported.

    Raises:
        KeyError: a name is taken.
    """
    taken = sorted(set(scenes) & set(SCENES))
    if taken:
        raise KeyError(f"scenes {taken} exist already; choose other names")
    SCENES.update(scenes)


@functools.cache
def load(name):
    """Return a scene that is loaded once; only a method guides its gradients, so that no test depends on others."""
    scene = psdr.load_dict({"type": "scene", **SCENES[name]()})
    psdr.guiding.set_automatic(scene, False)
    return scene, psdr.traverse(scene)
