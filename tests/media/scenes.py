"""Small scenes with media, as dictionaries that Mitsuba takes, too."""

import numpy as np

import warp_psdr as psdr

T = psdr.Transform
NOTHING = {"type": "null"}
BLACK = {"type": "diffuse", "reflectance": 0.0}


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def volume(value):
    """A coefficient that may exceed one."""
    return {"type": "constvolume", "value": rgb(*value) if isinstance(value, tuple) else value}


def medium(sigma_t=1.0, albedo=0.75, g=None, scale=1.0):
    phase = {"type": "isotropic"} if g is None else {"type": "hg", "g": g}
    return {
        "type": "homogeneous",
        "sigma_t": volume(sigma_t),
        "albedo": volume(albedo),
        "scale": scale,
        "phase": phase,
    }


def grid(values, box=None, **more):
    """A grid (Z, Y, X[, C]) that fills the cube from -1 to 1, or the unit cube by ``box``."""
    values = np.asarray(values, np.float32)
    values = values[..., None] if values.ndim == 3 else values
    box = T.translate([-1, -1, -1]) @ T.scale(2.0) if box is None else box
    return {"type": "gridvolume", "data": values, "to_world": box, **more}


def grids(sigma_t=1.0, albedo=0.75, g=None, scale=1.0):
    """A medium of volumes, or of constants, which it has where its extinction is."""
    return {**medium(sigma_t if isinstance(sigma_t, dict) else 1.0, 0.5, g, scale), "type": "heterogeneous"} | {
        "sigma_t": sigma_t,
        "albedo": albedo if isinstance(albedo, dict) else volume(albedo),
    }


def puffs(n=16, channels=1, empty=0.1):
    """The density of some smoke, (n, n, n, channels), zero in most of the voxels at ``empty`` = 0.1."""
    x = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    found = np.zeros((n, n, n))
    for cx, cy, cz, r in ((-0.3, 0.1, -0.3, 0.5), (0.35, -0.2, 0.2, 0.45), (0.0, 0.3, 0.6, 0.3)):
        found += np.exp(-((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) / (0.5 * r * r))
    found = np.clip(found * (1.0 + 0.4 * np.sin(9.0 * x + 7.0 * y) * np.cos(8.0 * z)) - empty, 0.0, None)
    tint = np.array([1.0, 0.8, 0.5])[:channels]
    return (found[..., None] * tint).astype(np.float32)


def camera(origin, target, fov=1.0, size=4, up=(0, 0, 1), **more):
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    pose = T.look_at(origin, target, up)
    sampler = {"type": "independent", "sample_count": 16}
    return {"type": "perspective", "fov": fov, "to_world": pose, "film": film, "sampler": sampler, **more}


def square(z, half, bsdf=None, flipped=False, **more):
    """A square that faces +z, or -z."""
    turn = T.rotate([1, 0, 0], 180.0 if flipped else 0.0)
    pose = T.translate([0, 0, z]) @ turn @ T.scale(half)
    return {"type": "rectangle", "to_world": pose, "bsdf": bsdf or {"type": "diffuse"}, **more}


def lamp(z=4.0, half=1.0, radiance=(8.0, 7.0, 6.0)):
    return square(z, half, BLACK, flipped=True, emitter={"type": "area", "radiance": rgb(*radiance)})


def sky(*values):
    return {"type": "constant", "radiance": rgb(*values)}


def point(position, intensity=(1.0, 1.0, 1.0)):
    return {"type": "point", "position": list(position), "intensity": rgb(*intensity)}


def cube(interior, bsdf=None, scale=1.0, translate=(0, 0, 0), turn=0.0, **more):
    pose = T.translate(translate) @ T.rotate([0, 0, 1], turn) @ T.scale(scale)
    return {"type": "cube", "to_world": pose, "bsdf": bsdf or NOTHING, "interior": interior, **more}


def integrator(max_depth=-1, rr_depth=5, kind="volpath"):
    return {"type": kind, "max_depth": max_depth, "rr_depth": rr_depth}


def whole(**parts):
    return {"type": "scene", **parts}


FOG = medium((0.25, 0.2, 0.3), (0.9, 0.8, 0.7), g=0.5)
FLOOR = square(-1.5, 5.0, {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.3)})
VIEW = ([4, 3, 2.5], [0, 0, -0.3], 40.0, 24)


def fog_in_a_room():
    """Fog everywhere, the camera in it; a box of diffuse walls, a block, a lamp."""
    wall = {"type": "diffuse", "reflectance": rgb(0.7, 0.3, 0.2)}
    room = {
        "type": "cube",
        "flip_normals": True,
        "to_world": T.scale([3.0, 3.0, 2.0]),
        "bsdf": wall,
    }
    block = {
        "type": "cube",
        "to_world": T.translate([0.5, 0.3, -1.2]) @ T.rotate([0, 0, 1], 25.0) @ T.scale(0.7),
        "bsdf": {"type": "diffuse", "reflectance": rgb(0.3, 0.5, 0.7)},
    }
    return whole(
        integrator=integrator(max_depth=6),
        fog={**FOG, "id": "fog"},
        sensor=camera([-2.5, -2.4, 0.8], [0.5, 0.5, -0.8], 60.0, 24, medium={"type": "ref", "id": "fog"}),
        room=room,
        block=block,
        lamp=lamp(1.9, 0.7, (12.0, 11.0, 10.0)),
    )


def milk():
    """A cube of milk behind a surface that is not there, under a lamp and a sky."""
    return whole(
        integrator=integrator(max_depth=8),
        sensor=camera(*VIEW),
        floor=FLOOR,
        cube=cube(medium(3.0, (0.95, 0.9, 0.8), g=0.6), turn=20.0),
        lamp=lamp(),
        sky=sky(0.2, 0.3, 0.4),
    )


def striped_milk():
    """``milk`` whose albedo differs by layer, in a medium that is ``homogeneous`` all the same."""
    parts = milk()
    stripes = np.where(np.arange(6) % 2, 0.95, 0.3).reshape(6, 1, 1)
    parts["cube"]["interior"] = {**medium(3.0, g=0.6), "albedo": grid(stripes)}
    return parts


def ink_in_glass():
    """A coloured medium behind a dielectric, in a second, thinner medium that a null cube bounds."""
    thin = {**medium(0.15, 0.6), "id": "thin"}
    ref = {"type": "ref", "id": "thin"}
    ink = medium((0.5, 2.0, 4.0), (0.3, 0.6, 0.8))
    return whole(
        integrator=integrator(max_depth=8),
        thin=thin,
        sensor=camera(*VIEW),
        floor=FLOOR,
        shell=cube(ref, scale=1.4, turn=10.0),
        glass=cube(ink, {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.3}, scale=0.8, turn=30.0, exterior=ref),
        lamp=lamp(),
        sky=sky(0.3, 0.4, 0.5),
        bulb=point([2.0, -1.5, 2.5], (9.0, 9.0, 9.0)),
    )


def ink_in_fog():
    """A cube of ink, .1 to 4 by channel, in a larger one of fog, under a lamp and a sky."""
    fog = {**medium(0.3, 0.9, g=0.5), "id": "thin"}
    ref = {"type": "ref", "id": "thin"}
    return whole(
        integrator=integrator(max_depth=8),
        thin=fog,
        sensor=camera(*VIEW),
        floor=FLOOR,
        shell=cube(ref, scale=1.4, turn=10.0),
        ink=cube(medium((0.1, 0.8, 4.0), (0.6, 0.8, 0.9), g=-0.3), scale=0.8, turn=30.0, exterior=ref),
        lamp=lamp(),
        sky=sky(0.3, 0.4, 0.5),
    )


def ink_in_the_sun():
    """Ink behind smooth glass in the sun, the camera in the fog around it."""
    fog = {**medium(0.15, (0.9, 0.8, 0.7)), "id": "thin"}
    ref = {"type": "ref", "id": "thin"}
    ink = medium((0.1, 0.8, 4.0), (0.6, 0.8, 0.9), g=0.5)
    return whole(
        integrator=integrator(max_depth=6),
        thin=fog,
        sensor=camera([2.4, 1.8, 1.5], [0, 0, -0.3], 60.0, 24, medium=ref),
        floor=FLOOR,
        shell=cube(ref, scale=3.5, turn=10.0),
        glass=cube(ink, {"type": "dielectric", "int_ior": 1.3}, scale=0.8, turn=30.0, exterior=ref),
        sun={"type": "directional", "direction": [0.3, -0.4, -1.0], "irradiance": rgb(3.0, 2.5, 2.0)},
        sky=sky(0.3, 0.4, 0.5),
    )


def smoke(**more):
    """Smoke in a cube over a floor, under a sky, a point light and a lamp."""
    parts = {
        "sensor": camera(*VIEW),
        "floor": FLOOR,
        "cube": cube(grids(grid(puffs()), (0.9, 0.8, 0.7), g=0.4, scale=4.0)),
        "lamp": lamp(),
        "bulb": point([2.0, -1.5, 2.5], (6.0, 7.0, 8.0)),
        "sky": sky(0.2, 0.3, 0.4),
    }
    return whole(integrator=integrator(max_depth=6), **parts | more)


def coloured_smoke():
    """Extinction and albedo by channel and voxel, nearest and mirrored, a box that ends before the cube."""
    albedo = np.random.default_rng(1).uniform(0.2, 0.95, (3, 4, 5, 3))
    box = T.translate([-0.8, -0.9, -1.0]) @ T.scale([1.6, 1.7, 1.9])
    return smoke(
        cube=cube(
            grids(grid(puffs(11, 3, 0.2)[:9], box), grid(albedo, filter_type="nearest", wrap_mode="mirror"), scale=5.0)
        )
    )


def blended():
    """``two_phases`` with a blend in each cube, of a table and of a lobe, both with air."""
    parts = two_phases()
    air, lobe = {"type": "rayleigh"}, {"type": "hg", "g": -0.6}
    table = parts["table"]["interior"]["phase"]
    parts["table"]["interior"]["phase"] = {"type": "blendphase", "weight": 0.3, "a": table, "b": air}
    parts["air"]["interior"]["phase"] = {"type": "blendphase", "weight": 0.8, "a": air, "b": lobe}
    return parts


def blended_by_grids():
    """``two_phases`` with blends whose weights vary, one of them from 0 to 1."""
    parts = two_phases()
    air, lobe = {"type": "rayleigh"}, {"type": "hg", "g": 0.7}
    weights = np.random.default_rng(6).uniform(0.0, 1.0, (2, 3, 2))
    for name, second, values in (("table", air, weights), ("air", lobe, np.linspace(0.0, 1.0, 4).reshape(1, 4, 1))):
        inner = parts[name]["interior"]["phase"]
        box = parts[name]["to_world"] @ T.translate([-1, -1, -1]) @ T.scale(2.0)
        parts[name]["interior"]["phase"] = {
            "type": "blendphase",
            "weight": grid(values, box),
            "a": inner,
            "b": second,
        }
    return parts


def microflakes():
    """A cube of fibres beside one of sheets in a bulb's light, scattered once.

    Directions that Mitsuba 3.9.1 draws do not have the density that it says (a furnace shows 0.47 in place of 1), so
    there is no light that they could meet.
    """
    parts = {**two_phases(), "integrator": integrator(max_depth=2)}
    del parts["lamp"], parts["sky"]
    for name, values in (("air", [1.0, 0.8, 0.05, 0.1, 0.0, -0.05]), ("table", [0.1, 0.1, 1.0, 0.05, 0.1, 0.0])):
        box = T.translate([-3, -3, -3]) @ T.scale(6.0)
        grid_of_one = {"type": "gridvolume", "data": np.float32(values).reshape(1, 1, 1, 6), "to_world": box}
        parts[name]["interior"]["phase"] = {"type": "sggx", "S": grid_of_one}
    return parts


def two_phases():
    """A cube of air beside one of a medium with a table, under a lamp and a sky."""
    table = {"type": "tabphase", "values": "0.5, 0.1, 0.2, 0.4, 3.0"}
    parts = {
        "sensor": camera(*VIEW),
        "floor": FLOOR,
        "air": cube({**medium(1.5, 0.9), "phase": {"type": "rayleigh"}}, scale=0.6, translate=(-0.7, 0.2, 0.0)),
        "table": cube(
            {**medium(2.0, (0.9, 0.8, 0.7)), "phase": table}, scale=0.6, translate=(0.7, -0.2, 0.0), turn=20.0
        ),
        "lamp": lamp(),
        "bulb": point([2.0, -1.5, 2.5], (6.0, 7.0, 8.0)),
        "sky": sky(0.2, 0.3, 0.4),
    }
    return whole(integrator=integrator(max_depth=6), **parts)


def inside_smoke():
    """The camera in the smoke, which is a room's air."""
    air = {**grids(grid(puffs(12, 1, -0.1), T.translate([-3, -3, -2]) @ T.scale([6, 6, 4])), 0.8), "id": "fog"}
    return {**fog_in_a_room(), "fog": air}


def points(image):
    """All pixels of images (count, H, W, 3) that look at one point, as samples (count H W, 3)."""
    return np.asarray(image).reshape(-1, 3)
