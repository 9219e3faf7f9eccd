"""Scenes of the gradient table. In those for geometry nothing that moves has a discontinuity that counts.

* ``plane``, ``dome``: one convex surface that fills the view, under lights that nothing can block;
* ``gap``, ``rough``, ``brushed``: the dome under a ceiling, light going back and forth. The ceiling's edges are seen
  against black, which carries no boundary term in material form, and the camera does not see them;
* ``mirror``, ``glass``: the camera inside a ball of mirrors (which shines smoothly) or of glass (in an envmap).
"""

import functools
import warnings

import numpy as np
import trimesh

import warp_psdr as psdr

SIZE = 12  # pixels


def camera(origin, target, fov=40.0, up=(0.0, 1.0, 0.0), rfilter="box", size=SIZE):
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": psdr.Transform.look_at(origin, target, up),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": rfilter}},
    }


def noise(*shape, low=0.2, high=1.0, seed=0):
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def dome(n=5, half=2.5, rise=0.02):
    """A convex, slightly bent square sheet about z = 0: vertices, faces (normals towards +z), texture coordinates."""
    u = np.linspace(0.0, 1.0, n)
    x, y = (a.reshape(-1) for a in np.meshgrid(half * (2.0 * u - 1.0), half * (2.0 * u - 1.0)))
    vertices = np.stack([x, y, -rise * (x**2 + 0.5 * y**2)], axis=1)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], axis=1), np.stack([i, i + n + 1, i + n], axis=1)])
    texcoords = np.stack([x, y], axis=1) / (2.0 * half) + 0.5
    return vertices.astype(np.float32), faces.astype(np.int32), texcoords.astype(np.float32)


def sheet(bsdf, *, rise=0.02, **more):
    vertices, faces, texcoords = dome(rise=rise)
    return {"type": "mesh", "vertices": vertices, "faces": faces, "texcoords": texcoords, "bsdf": bsdf, **more}


def ball(inside: bool, subdivisions=2, **more):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    return {"type": "mesh", "vertices": vertices, "faces": faces[:, ::-1] if inside else faces, **more}


def ceiling(**more):
    """A shining square at z = 1.5 that faces down, larger than what the camera sees below it."""
    to_world = (
        psdr.Transform.translate([0.2, -0.1, 1.5]) @ psdr.Transform.rotate([1, 0, 0], 180) @ psdr.Transform.scale(2)
    )
    return {
        "type": "rectangle",
        "to_world": to_world,
        "emitter": {
            "type": "area",
            "radiance": {"type": "bitmap", "bitmap": noise(4, 4, 3, low=1.5, high=3.0, seed=3)},
        },
        **more,
    }


def ref(name):
    return {"type": "ref", "id": name}


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def environment(seed=5):
    turn = psdr.Transform.rotate([1, 0, 0], 90) @ psdr.Transform.rotate([0, 1, 0], 30)
    # A wave and a little noise: the derivative along a turn would drown in the slopes of plain noise.
    wave = (
        np.sin(np.arange(12) * np.pi / 6.0)[None, :, None] * np.sin((np.arange(6) + 0.5) * np.pi / 6.0)[:, None, None]
    )
    bitmap = (1.0 + 0.6 * wave * noise(3, seed=seed + 1) + 0.3 * noise(6, 12, 3, seed=seed)).astype(np.float32)
    return {"type": "envmap", "bitmap": bitmap, "to_world": turn, "scale": 1.3}


def plane_scene():
    to_uv = np.array([[1.1, 0.2, 0.1], [-0.1, 0.9, 0.3], [0.0, 0.0, 1.0]])
    texture = {"type": "bitmap", "bitmap": noise(6, 6, 3, seed=1), "to_uv": to_uv}
    return {
        "sensor": camera([0.3, -0.6, 2.5], [0.1, 0.0, 0.0]),
        "floor": {
            "type": "rectangle",
            "to_world": psdr.Transform.scale(4),
            "bsdf": {"type": "diffuse", "reflectance": texture},
        },
        "env": environment(),
        "point": {"type": "point", "position": [0.5, 0.4, 1.2], "intensity": rgb(2.0, 1.5, 1.0)},
        "spot": {
            "type": "spot",
            "to_world": psdr.Transform.look_at([-0.8, 0.3, 1.8], [0.1, 0.1, 0.0], [0, 1, 0]),
            "intensity": rgb(4.0, 6.0, 5.0),
            "cutoff_angle": 25.0,
            "beam_width": 10.0,
        },
        "sun": {"type": "directional", "direction": [0.3, 0.4, -1.0], "irradiance": rgb(0.5, 0.8, 1.1)},
    }


def plane_seen_by(kind, to_world=None, **parameters):
    """``plane`` seen by another camera."""
    scene = plane_scene()
    sensor = scene["sensor"]
    pose = sensor["to_world"] if to_world is None else sensor["to_world"] @ to_world
    kept = {k: v for k, v in sensor.items() if kind == "thinlens" or k != "fov"}
    return {**scene, "sensor": {**kept, "type": kind, "to_world": pose, **parameters}}


def plane_through(**distortion):
    """``plane`` seen through a lens that moves what it shows."""
    scene = plane_scene()
    more = {"fov": 62.0, "pixel_aspect": 1.1, "skew": 0.05, "principal_point_offset_x": 0.03, **distortion}
    return {**scene, "sensor": scene["sensor"] | more}


def projected_scene():
    """A floor under a projector, whose image has a black border: it ends without an edge."""
    image = np.pad(noise(4, 5, 3, seed=7), ((1, 1), (1, 1), (0, 0)))
    return {
        "sensor": camera([0.3, -0.6, 2.5], [0.1, 0.0, 0.0]),
        "floor": {"type": "rectangle", "to_world": psdr.Transform.scale(4)},
        "lamp": {
            "type": "projector",
            "irradiance": {"type": "bitmap", "bitmap": image, "raw": True},
            "to_world": psdr.Transform.look_at([-0.8, 0.3, 1.8], [0.1, 0.1, 0.0], [0, 1, 0]),
            "fov": 50.0,
            "scale": 3.0,
        },
    }


def dome_scene():
    _vertices, faces, _texcoords = dome()
    reflectance = {"type": "mesh_attribute", "name": "face_color"}
    return {
        "sensor": camera([0.0, -0.3, 2.0], [0.0, 0.0, 0.0]),
        "floor": sheet({"type": "diffuse", "reflectance": reflectance}, face_color=noise(len(faces), 3, seed=2)),
        "sky": {"type": "constant", "radiance": rgb(0.5, 0.8, 1.1)},
    }


DIFFUSE = {"type": "diffuse", "reflectance": rgb(0.6, 0.3, 0.2)}


def gap_scene(floor=None):
    vertices, _faces, _texcoords = dome()
    color = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    return {
        "sensor": camera([0.0, -0.3, 1.2], [0.0, 0.1, 0.0]),
        "floor": sheet(floor or color, vertex_color=noise(len(vertices), 3, low=0.5, high=0.8, seed=4)),
        "ceiling": ceiling(bsdf={"type": "diffuse", "reflectance": rgb(0.6, 0.7, 0.5)}),
    }


def rough_scene(distribution="ggx"):
    return gap_scene({"type": "roughconductor", "material": "Cu", "distribution": distribution, "alpha": 0.35})


def brushed_scene(distribution="beckmann"):
    metal = {"type": "roughconductor", "material": "Al", "distribution": distribution, "alpha_u": 0.5, "alpha_v": 0.25}
    return gap_scene({**metal, "specular_reflectance": rgb(0.9, 0.8, 0.7)})


def plastic_scene():
    return gap_scene(
        {"type": "plastic", "diffuse_reflectance": rgb(0.6, 0.3, 0.2), "specular_reflectance": rgb(0.9, 0.8, 0.7)}
    )


def checkered_scene():
    """``gap`` with checkerboards on everything, a bitmap in one."""
    to_uv = np.array([[1.9, 0.3, 0.1], [-0.4, 2.1, 0.3], [0.0, 0.0, 1.0]])
    bitmap = {"type": "bitmap", "bitmap": noise(4, 4, 3, low=0.5, seed=7)}
    floor = {"type": "checkerboard", "color0": rgb(0.8, 0.5, 0.3), "color1": bitmap, "to_uv": to_uv}
    scene = gap_scene({"type": "diffuse", "reflectance": floor})
    shine = {"type": "checkerboard", "color0": rgb(3.0, 2.5, 2.0), "color1": rgb(1.0, 1.5, 2.0)}
    scene["ceiling"]["emitter"]["radiance"] = shine
    return scene


def carved_scene():
    """``gap`` with a floor whose colours are those of a turned grid of voxels, and a ceiling whose light is scaled."""
    pose = psdr.Transform.translate([-2.0, -3.2, -1.4]) @ psdr.Transform.rotate([0.3, 0.5, 0.8], 20)
    voxels = noise(4, 5, 6, 3, low=0.4, seed=8)
    grid = {"type": "gridvolume", "data": voxels, "to_world": pose @ psdr.Transform.scale([5.5, 6.0, 2.5])}
    scene = gap_scene({"type": "diffuse", "reflectance": {"type": "volume", "volume": grid}})
    glow = {"type": "mesh_attribute", "name": "vertex_glow", "scale": 1.7}
    corners = np.array([[-1.8, -2.1, 1.5], [2.2, -2.1, 1.5], [2.2, 1.9, 1.5], [-1.8, 1.9, 1.5]])
    ceiling = {"type": "mesh", "vertices": corners, "faces": [[0, 2, 1], [0, 3, 2]], "face_normals": True}
    shine = {"vertex_glow": noise(4, 3, low=1.0, high=2.0, seed=9), "emitter": {"type": "area", "radiance": glow}}
    return {**scene, "ceiling": {**ceiling, **shine}}


def sunny_scene():
    """A plane before a clear sky and its sun."""
    sky = {"type": "sunsky", "turbidity": 3.6, "albedo": rgb(0.2, 0.3, 0.5), "sun_direction": [0.5, -0.4, 0.6]}
    floor = {"type": "rectangle", "to_world": psdr.Transform.scale(4), "bsdf": DIFFUSE}
    turn = psdr.Transform.rotate([0.3, 0.2, 0.9], 15)
    return {"sensor": camera([0.3, -0.6, 2.5], [0.1, 0.0, 0.0]), "floor": floor, "sky": {**sky, "to_world": turn}}


def checkered_metal_scene():
    alpha = {"type": "checkerboard", "color0": 0.5, "color1": 0.3, "to_uv": psdr.Transform.scale([3, 2, 1])}
    return gap_scene({"type": "roughconductor", "material": "Cu", "alpha": alpha})


def blend_scene(weight=0.4):
    """Paint and rough metal."""
    metal = {"type": "roughconductor", "material": "Cu", "alpha": 0.35}
    return gap_scene({"type": "blendbsdf", "weight": weight, "paint": DIFFUSE, "metal": metal})


def gilded_scene():
    """Paint with a mirror reflection, by a mesh attribute; the ceiling is seen in it."""
    scene = gap_scene({
        "type": "blendbsdf", "weight": {"type": "mesh_attribute", "name": "vertex_gilt"},
        "paint": {"type": "plastic", "diffuse_reflectance": rgb(0.6, 0.3, 0.2)},
        "metal": {"type": "conductor", "material": "Cu"},
    })  # fmt: skip
    scene["floor"]["vertex_gilt"] = noise(len(scene["floor"]["vertices"]), 1, low=0.2, high=0.8, seed=9)
    return scene


def rough_plastic_scene(distribution="beckmann", **more):
    paint = {"diffuse_reflectance": rgb(0.6, 0.3, 0.2), "specular_reflectance": rgb(0.9, 0.8, 0.7)}
    return gap_scene({"type": "roughplastic", "distribution": distribution, "alpha": 0.3, **paint, **more})


def turned_floor(kind, name, values, **more):
    """A rough floor, which reads a bitmap under a normal or bump map."""
    to_uv = np.array([[1.1, 0.2, 0.1], [-0.1, 0.9, 0.3], [0.0, 0.0, 1.0]])
    texture = {"type": "bitmap", "bitmap": values, "raw": True, "to_uv": to_uv}
    metal = {"type": "roughconductor", "material": "Cu", "alpha_u": 0.5, "alpha_v": 0.3}
    return gap_scene({"type": kind, name: texture, "nested": metal, **more})


def mapped_scene():
    normals = (0.5 + noise(4, 4, 3, low=-0.15, high=0.15, seed=10)).astype(np.float32)
    normals[..., 2] = 0.9
    return turned_floor("normalmap", "normalmap", normals)


def bumped_scene():
    return turned_floor("bumpmap", "heights", noise(4, 4, 1, low=0.0, high=0.08, seed=11), scale=1.2)


def instanced_scene():
    """``gap`` whose floor is the instance of a group, smooth, stretched, sheared and mirrored."""
    scene = gap_scene({"type": "diffuse", "reflectance": rgb(0.8, 0.6, 0.5)})
    pose = np.array([[-1.0, 0.1, 0.0, 0.05], [0.05, 1.2, 0.0, 0.0], [0.0, 0.0, 1.5, 0.02], [0.0, 0.0, 0.0, 1.0]])
    group = {"type": "shapegroup", "sheet": scene.pop("floor")}
    return {**scene, "group": group, "floor": {"type": "instance", "group": ref("group"), "to_world": pose}}


def phong_scene():
    colors = {"reflectance": rgb(0.6, 0.4, 0.2), "specular_reflectance": rgb(0.3, 0.5, 0.7)}
    return gap_scene({"type": "ashikhminshirley", "nu": 12.0, "nv": 5.0, **colors})


def abc_scene():
    return gap_scene({"type": "abc", "material": "Au", "A": 0.6, "B": 20.0, "C": 1.5})


def principled_scene():
    """All lobes but the transmitted one; at all weights the same is drawn, for the differences' sake."""
    weights = {"metallic": 0.4, "spec_tint": 0.4, "sheen": 0.6, "sheen_tint": 0.6, "flatness": 0.4, "specular": 0.6}
    more = {"roughness": 0.55, "anisotropic": 0.4, "clearcoat": 0.5, "clearcoat_gloss": 0.2}
    more |= {"clearcoat_sampling_rate": 0.0, "diffuse_reflectance_sampling_rate": 0.0}
    return gap_scene({"type": "principled", "base_color": rgb(0.6, 0.3, 0.2), **weights, **more})


def sheet_scene():
    """A frosted, translucent sheet, lit from both sides; hardly any glossy sample, for the differences' sake."""
    weights = {"spec_trans": 0.4, "diff_trans": 0.9, "spec_tint": 0.5, "sheen": 0.5, "sheen_tint": 0.5, "flatness": 0.4}
    rates = {f"specular_{way}_sampling_rate": 1e-3 for way in ("reflectance", "transmittance")}
    sheet = {"type": "principledthin", "base_color": rgb(0.6, 0.3, 0.5), "roughness": 0.6, "anisotropic": 0.3}
    sky = {"type": "constant", "radiance": rgb(0.6, 0.8, 0.5)}
    return gap_scene(sheet | {"eta": 1.6} | weights | rates) | {"sky": sky}


def principled_glass_scene():
    scene = glass_scene()
    glass = {"type": "principled", "base_color": rgb(0.6, 0.5, 0.8), "spec_trans": 0.6, "roughness": 0.5, "eta": 1.4}
    return scene | {"ball": ball(False, subdivisions=3, bsdf=glass)}


def mirror_scene():
    room = ball(True, bsdf={"type": "conductor", "material": "Au"})
    room["vertex_radiance"] = (1.0 + 0.6 * np.sin(room["vertices"] @ noise(3, 3, low=-2.0, high=2.0, seed=6))).astype(
        np.float32
    )
    room["emitter"] = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_radiance"}}
    return {"sensor": camera([0.15, 0.1, -0.1], [1.0, 0.3, 0.2]), "room": room}


def glass_scene(kind="dielectric", **more):
    glass = {"type": kind, "int_ior": 1.4, "ext_ior": 1.0, **more}
    glass |= {"specular_reflectance": rgb(0.9, 0.8, 0.7), "specular_transmittance": rgb(0.7, 0.8, 0.9)}
    return {
        "sensor": camera([0.15, 0.1, -0.1], [1.0, 0.3, 0.2]),
        "ball": ball(False, subdivisions=3, bsdf=glass),
        "env": environment(),
    }


def leaf_scene():
    """Above a floor under a ceiling that shines, and under a lamp of no area: a leaf with soft holes."""
    scene = gap_scene(DIFFUSE)
    holes = {"type": "bitmap", "bitmap": noise(4, 4, 1, low=0.1, high=0.9, seed=8), "raw": True}
    return {
        **scene,
        "leaf": {
            "type": "rectangle",
            "to_world": psdr.Transform.translate([0.2, 0.2, 0.5]) @ psdr.Transform.scale(0.5),
            "bsdf": {"type": "mask", "opacity": holes, "leaf": {"type": "twosided", "bsdf": DIFFUSE}},
        },
        "lamp": {"type": "point", "position": [0.3, 0.2, 1.1], "intensity": rgb(1.0, 0.8, 0.6)},
    }


def plate_scene():
    """Inside of a ball that shines, behind two plates: one of thin glass, and one that is not there."""
    room = {**mirror_scene()["room"], "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.6, 0.7)}}
    glass = {"type": "thindielectric", "int_ior": 1.6, "ext_ior": 1.0}
    glass |= {"specular_reflectance": rgb(0.3, 0.2, 0.1), "specular_transmittance": rgb(0.7, 0.8, 0.9)}
    facing = psdr.Transform.look_at([0.4, 0.1, 0.05], [0.0, 0.0, 0.0], [0, 0, 1])
    return {
        "sensor": camera([-0.1, 0.05, -0.1], [1.0, 0.3, 0.2]),
        "room": room,
        "plate": {"type": "rectangle", "to_world": facing @ psdr.Transform.scale(0.6), "bsdf": glass},
        "nothing": {
            "type": "rectangle",
            "to_world": psdr.Transform.translate([0.15, 0.0, 0.0]) @ facing @ psdr.Transform.scale(0.5),
            "bsdf": {"type": "null"},
        },
        "lamp": {"type": "point", "position": [-0.3, -0.1, 0.2], "intensity": rgb(0.3, 0.2, 0.4)},
    }


def rough_window_scene():
    """The ceiling of ``gap``, a light, seen through its floor."""
    scene = gap_scene({"type": "roughdielectric", "distribution": "ggx", "alpha": 0.3, "int_ior": 1.4, "ext_ior": 1.0})
    return {**scene, "sensor": camera([0.0, -0.3, -1.2], [0.0, 0.1, 0.0])}


SCENES = {
    "plane": plane_scene,
    "plane, parallel": lambda: plane_seen_by("orthographic", psdr.Transform.scale([0.9, 1.1, 1.5])),
    "plane, lens": lambda: plane_seen_by("thinlens", aperture_radius=0.3, focus_distance=1.7),
    "plane, distorted": lambda: plane_through(
        **{"k1": -0.1, "k2": 0.06, "p1": 0.02, "p2": -0.015, "k3": 0.01, "k4": 0.02, "k5": 0.01, "k6": -0.01}
    ),
    "plane, fisheye": lambda: plane_through(distortion="fisheye", k1=0.1, k2=-0.03, k3=0.01, k4=0.004),
    "projected": projected_scene,
    "dome": dome_scene,
    "gap": gap_scene,
    "rough": rough_scene,
    "brushed": brushed_scene,
    "beckmann": lambda: rough_scene("beckmann"),
    "brushed ggx": lambda: brushed_scene("ggx"),
    "plastic": plastic_scene,
    "checkered": checkered_scene,
    "carved": carved_scene,
    "sunny": sunny_scene,
    "instanced": instanced_scene,
    "checkered metal": checkered_metal_scene,
    "blend": blend_scene,
    "gilded": gilded_scene,
    "rough plastic": rough_plastic_scene,
    "rough plastic ggx": lambda: rough_plastic_scene("ggx", nonlinear=True),
    "mapped": mapped_scene,
    "bumped": bumped_scene,
    "grooves": lambda: gap_scene({"type": "orennayar", "reflectance": rgb(0.8, 0.5, 0.6), "sigma": 0.5}),
    "phong": phong_scene,
    "abc": abc_scene,
    "principled": principled_scene,
    "principled glass": principled_glass_scene,
    "sheet": sheet_scene,
    "mirror": mirror_scene,
    "rough glass": lambda: glass_scene("roughdielectric", alpha=0.3),
    "rough window": rough_window_scene,
    "glass": glass_scene,
    "plate": plate_scene,
    "leaf": leaf_scene,
}


#: Scenes that are noted: a sun without a disk, a grid that ends inside of its interface.
NOTED = ("sunny", "smoky slab")


@functools.cache
def load(name: str):
    """Return a scene and its parameters; every test leaves their values as they were."""
    with warnings.catch_warnings(action="ignore" if name in NOTED else "error", category=psdr.SceneWarning):
        scene = psdr.load_dict({"type": "scene", **SCENES[name]()})
    return scene, psdr.traverse(scene)
