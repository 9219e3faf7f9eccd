"""Tessellated shapes: closed, on the surface, with Mitsuba's normals and texture coordinates."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene import Transform, describe_dict
from warp_psdr.scene.kinds.table import TESSELLATED

#: Float32 rounding of coordinates of size 1 to 10.
ROUNDING = 2e-5


def shape(kind, **parameters):
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "x": {"type": kind, **parameters}}
    return describe_dict(scene).shapes[0]


def positions_and_faces(vertices, faces):
    """Merge vertices of equal bits; returns the merged faces."""
    _, index = np.unique(np.ascontiguousarray(vertices).view(np.uint32).reshape(-1, 3), axis=0, return_inverse=True)
    return index.reshape(-1)[faces]


def open_edges(faces):
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = {tuple(edge) for edge in directed.tolist()}
    assert len(edges) == len(directed), "an edge is used twice in the same direction"
    return [edge for edge in edges if edge[::-1] not in edges]


@pytest.mark.parametrize("kind", TESSELLATED)
@pytest.mark.parametrize("resolution", [3, 5, 64])
def test_triangles_face_the_way_their_normals_point(kind, resolution):
    mesh = TESSELLATED[kind](resolution)
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(np.einsum("mi,mki->mk", normal, mesh.normals[mesh.faces]) > 0.0)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-12)
    assert mesh.texcoords.min() >= 0.0 and mesh.texcoords.max() <= 1.0


@pytest.mark.parametrize("kind, ends", [("cube", 0), ("sphere", 0), ("rectangle", 4), ("disk", 7), ("cylinder", 14)])
def test_seams_are_closed_bit_for_bit(kind, ends):
    # An oblique pose: equal object-space points must stay equal after rounding.
    pose = Transform.translate([0.1, 0.7, -3.3]).rotate([0.48, 0.8, 0.36], 37.0).scale([1.7, 0.3, 2.9])
    extra = {"resolution": 7} if kind in ("sphere", "disk", "cylinder") else {}
    x = shape(kind, to_world=pose, **extra)
    assert len(open_edges(positions_and_faces(x.vertices, x.faces))) == ends


def test_vertices_lie_on_the_surface():
    x = shape("sphere", center=[1.0, 2.0, 3.0], radius=2.5)
    np.testing.assert_allclose(np.linalg.norm(x.vertices - [1.0, 2.0, 3.0], axis=1), 2.5, atol=ROUNDING)
    y = shape("cylinder", p0=[1.0, 0.0, 0.0], p1=[1.0, 0.0, 4.0], radius=0.5)
    np.testing.assert_allclose(np.hypot(y.vertices[:, 0] - 1.0, y.vertices[:, 1]), 0.5, atol=ROUNDING)
    assert (y.vertices[:, 2].min(), y.vertices[:, 2].max()) == (0.0, 4.0)


@pytest.mark.parametrize("kind, exact", [("sphere", 4.0 * np.pi), ("disk", np.pi), ("cylinder", 2.0 * np.pi)])
def test_area_error_is_the_stated_one(kind, exact):
    mesh = TESSELLATED[kind](64)
    corners = mesh.vertices[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert 0.0 < 1.0 - area / exact < (np.pi / 64) ** 2


@pytest.mark.parametrize("kind", TESSELLATED)
def test_world_vertices_follow_from_the_local_ones(kind):
    pose = Transform.translate([1.0, 2.0, 3.0]).rotate([0.0, 1.0, 0.0], 30.0).scale([1.0, 2.0, 0.5])
    x = shape(kind, to_world=pose)
    world = x.local_vertices @ x.to_world[:3, :3].T + x.to_world[:3, 3]
    np.testing.assert_allclose(x.vertices, world, atol=ROUNDING)
    normals = x.local_normals @ np.linalg.inv(x.to_world[:3, :3])
    np.testing.assert_allclose(x.normals, normals / np.linalg.norm(normals, axis=1, keepdims=True), atol=ROUNDING)


def test_mirroring_keeps_the_side_of_a_rectangle_and_turns_a_sphere():
    mirror = Transform.scale([-1.0, 1.0, 1.0])
    for kind, flipped in (("rectangle", False), ("cube", False), ("sphere", True)):
        x = shape(kind, to_world=mirror)
        corners = x.vertices[x.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.all(np.einsum("mi,mki->mk", normal, x.normals[x.faces]) > 0.0)
        assert x.flip_normals is flipped


@pytest.mark.parametrize("kind", ["rectangle", "cube", "disk", "cylinder", "sphere"])
def test_mirroring_keeps_the_side_without_normals_too(kind):
    mirror = Transform.scale([-1.0, 1.0, 1.0])
    smooth, flat = shape(kind, to_world=mirror), shape(kind, to_world=mirror, face_normals=True)
    np.testing.assert_array_equal(flat.faces, smooth.faces)
    assert flat.flip_normals is smooth.flip_normals


def test_flip_and_face_normals():
    x = shape("sphere", flip_normals=True, face_normals=True, resolution=8)
    assert x.flip_normals and x.normals is None and x.local_normals is None and not x.normals_computed


def test_a_flat_cube_follows_its_pose():
    held = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective"},
            "sky": {"type": "constant"},
            "c": {"type": "cube", "face_normals": True},
        }
    )
    params = psdr.traverse(held)
    before = params["c.vertex_positions"].numpy().copy()
    params["c.to_world"] = Transform.translate([1.0, 0.0, 0.0]).matrix
    params.update()
    np.testing.assert_allclose(params["c.vertex_positions"].numpy(), before + np.float32([1.0, 0.0, 0.0]), atol=1e-6)


def test_resolution_is_settable():
    assert len(shape("sphere", resolution=16).faces) == 2 * 16 * 7
    assert len(shape("sphere").faces) == 2 * 64 * 31
    assert len(shape("disk", resolution=16).faces) == 16


@pytest.mark.parametrize("kind", TESSELLATED)
def test_normals_and_texcoords_equal_mitsubas(kind):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    pose = Transform.translate([0.3, -0.2, 0.1]).rotate([0.8, 0.48, -0.36], 50.0).scale([1.5, 1.5, 1.5])
    extra = {"p0": [0.1, 0.2, 0.3], "p1": [0.5, 1.0, -0.7], "radius": 0.4} if kind == "cylinder" else {}
    extra = {"center": [0.1, 0.2, 0.3], "radius": 1.3} if kind == "sphere" else extra
    x = shape(kind, to_world=pose, **extra)
    theirs = {"type": kind, "to_world": mi.ScalarTransform4f(pose.matrix), **extra}
    scene = mi.load_dict({"type": "scene", "x": theirs}, optimize=False)
    if kind != "cube":
        parameters = mi.traverse(scene)
        np.testing.assert_allclose(np.array(parameters["x.to_world"].matrix), x.to_world, atol=ROUNDING)
    # Shoot at the middles of triangles: there interpolated values differ from exact ones by the tessellation only.
    tolerance = 2.0 * (np.pi / 64) ** 2
    for face in x.faces[:: max(1, len(x.faces) // 40)]:
        p, n, uv = (values[face].mean(axis=0) for values in (x.vertices, x.normals, x.texcoords))
        n /= np.linalg.norm(n)
        hit = scene.ray_intersect(mi.Ray3f((p + 0.1 * n).tolist(), (-n).tolist()))
        assert hit.is_valid()
        np.testing.assert_allclose(np.array(hit.p), p, atol=5e-3)
        np.testing.assert_allclose(np.array(hit.sh_frame.n), n, atol=tolerance)
        if kind == "sphere" and min(uv[1], 1.0 - uv[1]) < 0.05:
            continue  # next to the poles the azimuth is interpolated across a whole segment
        np.testing.assert_allclose(np.array(hit.uv), uv, atol=5e-3)


def test_cube_equals_mitsubas_vertex_by_vertex():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    theirs, x = mi.traverse(mi.load_dict({"type": "cube"})), shape("cube")
    for name, ours in (("positions", x.vertices), ("normals", x.normals), ("texcoords", x.texcoords)):
        np.testing.assert_array_equal(np.array(theirs[f"vertex_{name}"]), ours.ravel())
    np.testing.assert_array_equal(np.array(theirs["faces"]), x.faces.ravel())


def light(kind, pose=None, **parameters):
    """Return the triangles of a shape that shines, (M, 3, 3) float64."""
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": 2.0}}
    x = shape(kind, emitter=emitter, **({} if pose is None else {"to_world": pose}), **parameters)
    assert x.emitter.radiance.value.tolist() == [2.0] * 3
    world = x.local_vertices.astype(np.float64) @ x.to_world[:3, :3].T + x.to_world[:3, 3]
    np.testing.assert_allclose(x.vertices, world, atol=ROUNDING)
    return world[x.faces]


def area_of(corners):
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()


def spheroid(a, c):
    """Return the area of an oblate spheroid, c < a."""
    e = np.sqrt(1.0 - (c / a) ** 2)
    return 2.0 * np.pi * a**2 * (1.0 + (1.0 - e**2) / e * np.arctanh(e))


@pytest.mark.parametrize("resolution", [12, 64])
def test_lights_have_the_area_and_so_the_power_of_their_shape(resolution):
    flat, tall = Transform.scale([2.0, 2.0, 0.5]), Transform.scale([2.0, 2.0, 5.0])
    areas = {
        area_of(light("sphere", radius=2.5, resolution=resolution)): 4.0 * np.pi * 2.5**2,
        area_of(light("sphere", flat, resolution=resolution)): spheroid(2.0, 0.5),
        area_of(light("disk", flat, resolution=resolution)): 4.0 * np.pi,
        area_of(light("cylinder", tall, radius=0.5, resolution=resolution)): 10.0 * np.pi,
    }
    for ours, exact in areas.items():
        assert ours == pytest.approx(exact, rel=2e-6)
    # Only lights are widened.
    assert area_of(shape("disk").vertices[shape("disk").faces]) < 0.999 * np.pi


def irradiance(corners, radiance):
    """Return the irradiance of a surface at the origin that looks along +z (Lambert's formula, over edges in view)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = corners[np.einsum("mi,mi->m", normal, corners[:, 0]) < 0.0]
    p = seen / np.linalg.norm(seen, axis=2, keepdims=True)
    total = 0.0
    for i in range(3):
        a, b = p[:, i], p[:, (i + 1) % 3]
        cross = np.cross(a, b)
        length = np.linalg.norm(cross, axis=1)
        total += (np.arctan2(length, np.einsum("mi,mi->m", a, b)) * cross[:, 2] / length).sum()
    return abs(0.5 * radiance * total)


def test_what_a_luminous_sphere_lights_receives_the_closed_forms_irradiance():
    pose = Transform.translate([0.0, 0.0, 4.0]).rotate([0.6, 0.8, 0.0], 50.0)
    exact = np.pi * 2.0 * (1.0 / 4.0) ** 2
    assert irradiance(light("sphere", pose), 2.0) == pytest.approx(exact, rel=2e-4)
    inscribed = shape("sphere", to_world=pose)
    assert irradiance(inscribed.vertices.astype(np.float64)[inscribed.faces], 2.0) < (1.0 - 1.5e-3) * exact
