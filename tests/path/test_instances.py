"""Groups, their instances and merged shapes: images, edits and gradients are those of copies made by hand."""

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from warp_psdr.scene import describe_dict, describe_string
from warp_psdr.scene.parameters import check_independent
from warp_psdr.scene.shapes import groups

from .helpers import assert_same_mean

T = psdr.Transform
TURN = [[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]
#: One turns, the other mirrors, stretches and shears.
POSES = {
    "one": T.translate([1.0, 0.0, 0.0]) @ T.rotate([0, 0, 1], 30),
    "two": T.translate([-1.0, 0.2, 0.3]) @ T.scale([1.0, -0.7, 0.6]) @ T.rotate([1, 0, 0], 20),
}
PLACED = {"ball": T.translate([0, 0, 0.3]), "box": T.translate([0, 0, -0.5]) @ T.scale([0.5, 0.4, 0.2])}
SIZE = 16


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def world(**shapes):
    camera = {
        "type": "perspective",
        "fov": 40.0,
        "to_world": T.look_at([0, -6, 3], [0, 0, 0], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
    }
    lamp = {"type": "point", "position": [2, -3, 4], "intensity": 20.0}
    return {"type": "scene", "sensor": camera, "sky": {"type": "constant"}, "lamp": lamp, **shapes}


def mesh(**more):
    """Return a coarse ball, smooth, without normals of its own."""
    m = trimesh.creation.icosphere(subdivisions=1, radius=0.6)
    return {"type": "mesh", "vertices": np.asarray(m.vertices), "faces": np.asarray(m.faces), **more}


def reference(name):
    return {"type": "ref", "id": name}


def members(**more):
    uv = {"type": "checkerboard", "to_uv": T.scale([4, 4, 1])}
    ball = {"type": "sphere", "radius": 0.6, "bsdf": {"type": "diffuse", "reflectance": uv}}
    box = {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": rgb(0.7, 0.4, 0.3)}}
    return {name: {**s, "to_world": PLACED[name], **more} for name, s in (("ball", ball), ("box", box))}


def instanced(shapes, poses=POSES):
    group = {"group": {"type": "shapegroup", **shapes}}
    return world(**group, **{n: {"type": "instance", "g": reference("group"), "to_world": p} for n, p in poses.items()})


def copied(shapes, poses=POSES):
    """The same, each copy made by hand; spheres and meshes that a pose mirrors would be inside out."""
    made = {}
    for pose, matrix in poses.items():
        mirrored = np.linalg.det(matrix.matrix[:3, :3]) < 0.0
        for name, s in shapes.items():
            turned = {"flip_normals": True} if mirrored and s["type"] == "sphere" else {}
            if mirrored and s["type"] == "mesh":
                turned = {"faces": s["faces"][:, [0, 2, 1]]}
            made[f"{pose}_{name}"] = {**s, "to_world": matrix @ s.get("to_world", T.scale(1)), **turned}
    return world(**made)


def image(scene, **options):
    return psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=3), **{"spp": 16, **options}).numpy()


def test_images_are_those_of_copies():
    expected = image(psdr.load_dict(copied(members())))
    found = image(psdr.load_dict(instanced(members())))
    np.testing.assert_allclose(found, expected, atol=2e-6)
    assert expected.std() > 0.1


def test_names_are_mitsubas_and_what_is_shared_has_one():
    scene = psdr.load_dict(instanced(members()))
    names = [n for n in psdr.traverse(scene) if n.startswith(("group", "one", "two"))]
    positions = [f"group.{n}.vertex_{kind}" for n in PLACED for kind in ("positions", "normals", "texcoords")]
    poses = ["one.to_world", "two.to_world"]
    colors = [f"group.ball.bsdf.reflectance.{n}" for n in ("color0.value", "color1.value", "to_uv")]
    assert sorted(names) == sorted([*positions, *poses, *colors, "group.box.bsdf.reflectance.value"])


def test_images_equal_mitsubas():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")

    def theirs(value):
        if isinstance(value, dict):
            return {k: theirs(v) for k, v in value.items()}
        return mi.ScalarTransform4f(value.matrix.tolist()) if isinstance(value, T) else value

    scene = instanced(members()) | {"integrator": {"type": "path", "max_depth": 3}}
    given = mi.load_dict(theirs(scene))
    ours = psdr.load_dict(scene)
    # Edges of the tessellated sphere: its silhouette is 0.1 % of a pixel inside of theirs.
    a = np.stack([psdr.render(ours, spp=64, seed=i).numpy() for i in range(8)]).astype(np.float64)
    b = np.stack([np.array(mi.render(given, spp=64, seed=i)) for i in range(8)]).astype(np.float64)
    assert_same_mean(a.reshape(8, -1, 3), b.reshape(8, -1, 3), "instances", rounding=5e-3)


# -- edits ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("by", ["assignment", "kernel"])
def test_copies_follow_the_vertices_of_the_group_and_the_poses(by):
    shapes = {"ball": mesh(), "flat": mesh(face_normals=True, to_world=T.translate([0, 0, 1.0]))}
    scene = psdr.load_dict(instanced(shapes))
    params, before = psdr.traverse(scene), image(scene)
    state = scene.state()
    vertices = params["group.ball.vertex_positions"].numpy() * [1.3, 0.8, 1.0]
    pose = np.float32(T.translate([0.2, 0.3, 0.1]).matrix) @ params["two.to_world"].numpy()
    for name, values in (("group.ball.vertex_positions", np.float32(vertices)), ("two.to_world", pose)):
        if by == "assignment":
            params[name] = values
        else:
            params[name].assign(values)
    params.update()
    assert scene.edited() == []
    edited = {**shapes, "ball": mesh(vertices=vertices)}
    expected = image(psdr.load_dict(instanced(edited, {**POSES, "two": T.translate([0.2, 0.3, 0.1]) @ POSES["two"]})))
    np.testing.assert_allclose(image(scene), expected, atol=1e-5)
    assert np.abs(expected - before).max() > 0.1
    scene.restore(state)
    np.testing.assert_array_equal(image(scene), before)


def test_an_edit_that_mirrors_an_instance_is_refused():
    scene = psdr.load_dict(instanced({"ball": mesh()}))
    params = psdr.traverse(scene)
    params["one.to_world"] = params["one.to_world"].numpy() @ np.diag([1, 1, -1, 1])
    with pytest.raises(ValueError, match=r"one\.to_world: the edit mirrors an instance"):
        params.update()


@pytest.mark.slow
def test_normals_and_vertices_of_a_group_cannot_change_together_and_normals_alone_are_kept():
    scene = psdr.load_dict(instanced({"ball": mesh()}))
    params = psdr.traverse(scene)
    names = ["group.ball.vertex_positions", "group.ball.vertex_normals"]
    with pytest.raises(ValueError, match="follows"):
        check_independent(scene, names)
    before = image(scene)
    turned = params[names[1]].numpy() @ np.float32(TURN)
    params[names[1]] = turned
    params.update(names[1])
    assert np.abs(image(scene) - before).max() > 0.01


# -- gradients ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "flat", [pytest.param(False, id="smooth", marks=pytest.mark.slow), pytest.param(True, id="flat")]
)
def test_gradients_are_the_sums_of_those_of_copies_through_each_pose(flat):
    """Interior and boundary terms, with the same random numbers; smooth copies turn only, to have the same normals."""
    poses = POSES if flat else {"one": POSES["one"], "two": T.translate([-1, 0, 0.2]) @ T.rotate([0.6, 0.8, 0], 50)}
    color = {"bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}}
    color["vertex_color"] = np.random.default_rng(3).uniform(0.3, 0.8, (42, 3))
    shapes = {"ball": mesh(face_normals=flat, **color)}
    weights = np.random.default_rng(0).random((SIZE, SIZE, 3)).astype(np.float32)
    integrator = psdr.PathIntegrator(max_depth=2)

    def gradients(scene, names):
        params = psdr.traverse(scene)
        params.requires_grad(*names)
        psdr.render_backward(scene, params, weights, integrator=integrator, spp=32, seed=1)
        return [params[n].grad.numpy().astype(np.float64) for n in names]

    ours = psdr.load_dict(instanced(shapes, poses))
    positions, pose, colors = gradients(
        ours, ["group.ball.vertex_positions", "two.to_world", "group.ball.vertex_color"]
    )
    copies = psdr.load_dict(copied(shapes, poses))
    found = gradients(copies, [f"{n}_ball.{kind}" for kind in ("vertex_positions", "vertex_color") for n in poses])
    matrices = [p.matrix[:3, :3] for p in poses.values()]
    expected = sum(g @ m for g, m in zip(found[:2], matrices, strict=True))
    np.testing.assert_allclose(positions, expected, atol=2e-4 * np.abs(expected).max())
    np.testing.assert_allclose(colors, sum(found[2:]), atol=2e-4 * np.abs(colors).max())
    if flat:
        local = np.hstack([mesh()["vertices"], np.ones((42, 1))])
        np.testing.assert_allclose(pose[:3], found[1].T @ local, atol=2e-4 * np.abs(pose).max())

    # Forward mode is the transpose.
    params = psdr.traverse(ours)
    tangents = {
        "group.ball.vertex_positions": np.random.default_rng(1).normal(size=positions.shape).astype(np.float32),
        "two.to_world": np.pad(np.random.default_rng(2).normal(size=(3, 4)), ((0, 1), (0, 0))).astype(np.float32),
    }
    change = psdr.render_forward(ours, params, tangents, integrator=integrator, spp=32, seed=1).numpy()
    params.requires_grad_only(*tangents)
    params.zero_grad()
    psdr.render_backward(ours, params, weights, integrator=integrator, spp=32, seed=1)
    total = sum(float((params[n].grad.numpy().astype(np.float64) * t).sum()) for n, t in tangents.items())
    assert total == pytest.approx(float((change * weights).astype(np.float64).sum()), rel=2e-3)


# -- loading --------------------------------------------------------------------------------------------------------


def test_scenes_far_from_the_origin_keep_the_group_in_its_space():
    far = T.translate([1e5, 0, 0])
    scene = instanced({"ball": mesh()}, {n: far @ p for n, p in POSES.items()})
    scene["sensor"]["to_world"] = far @ scene["sensor"]["to_world"]
    scene["lamp"]["position"] = [1e5 + 2, -3, 4]
    with pytest.warns(psdr.SceneWarning, match="far from the origin"):
        loaded = psdr.load_dict(scene)
    np.testing.assert_allclose(image(loaded), image(psdr.load_dict(instanced({"ball": mesh()}))), atol=5e-2)
    params = psdr.traverse(loaded)
    np.testing.assert_allclose(params["group.ball.vertex_positions"].numpy(), mesh()["vertices"], atol=1e-6)
    np.testing.assert_allclose(params["one.to_world"].numpy()[0, 3], 1e5 + 1)


def test_files_refer_to_groups_before_and_after_them():
    instance = '<shape type="instance"><ref id="g"/><transform name="to_world"><translate x="{}"/></transform></shape>'
    group = '<shape type="shapegroup" id="g"><shape type="cube"/><shape type="cube" id="b"/></shape>'
    text = f'<scene version="3.0.0">{instance.format(1)}{group}{instance.format(-1)}<emitter type="constant"/></scene>'
    found = describe_string(text).shapes
    assert [s.source for s in found] == ["g._arg_0", "g.b"] * 2
    assert found[0].prototype is found[2].prototype and found[0].bsdf is found[2].bsdf
    assert [s.vertices[:, 0].mean() for s in found] == pytest.approx([1, 1, -1, -1])


def test_merged_shapes_are_those_shapes():
    shapes = {"a": mesh(), "b": {"type": "cube", "to_world": T.translate([1, 0, 0])}}
    inner = {"type": "merge", "b": shapes["b"], "id": "m"}
    merged = psdr.load_dict(world(all={"type": "merge", "a": shapes["a"], "inner": inner}))
    np.testing.assert_array_equal(image(merged), image(psdr.load_dict(world(**shapes))))
    assert {"a.vertex_positions", "b.to_world"} <= set(psdr.traverse(merged))


def group(**shapes):
    return {"type": "shapegroup", **shapes}


CUBE = {"type": "cube"}
BAD = {
    "no group": ({"type": "instance"}, r"an 'instance' without a 'shapegroup'; nest one"),
    "no group but a shape": ({"type": "instance", "a": CUBE}, r"an 'instance' of a 'cube'; give a 'shapegroup'"),
    "two groups": ({"type": "instance", "a": group(), "b": group()}, r"2 shape plugins.*at most 1"),
    "a model": ({"type": "instance", "a": group(a=CUBE), "b": {"type": "diffuse"}}, r"takes no bsdf plugin here"),
    "a group in a group": (group(a=group(a=CUBE)), r"a 'shapegroup' inside a 'shapegroup'"),
    "an instance in a group": (
        group(a={"type": "instance", "g": group(a=CUBE)}),
        r"an? 'instance' inside a 'shapegroup'",
    ),
    "a light": (group(a={**CUBE, "emitter": {"type": "area"}}), r"instances do not shine"),
    "a mirror without volume": (
        {"type": "instance", "g": group(a=CUBE), "to_world": np.diag([1, 1, 0, 1])},
        "singular",
    ),
    "an unknown reference": ({"type": "instance", "g": reference("nobody")}, "unknown id 'nobody'"),
    "a group of itself": (group(a={"type": "instance", "g": reference("x")}), "this 'shapegroup' contains itself"),
    "a pose of a merged shape": ({"type": "merge", "a": CUBE, "to_world": T.scale(2)}, "no parameter 'to_world'"),
    "a pose of a group": (group(a=CUBE, to_world=T.scale(2)), "no parameter 'to_world'"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_is_named_with_its_place(name):
    plugin, words = BAD[name]
    with pytest.raises(ValueError, match=words) as caught:
        describe_dict(world(x=plugin))
    assert "scene['x']" in str(caught.value)


def test_instances_are_counted_before_they_are_made(monkeypatch):
    monkeypatch.setattr(groups, "MANY_TRIANGLES", 13)
    scene = instanced({"box": CUBE})
    assert any("instances are copies, with more than 13 triangles" in note for note in describe_dict(scene).notes)
    monkeypatch.setattr(groups, "MOST_TRIANGLES", 23)
    with pytest.raises(ValueError, match=r"scene\['two'\]: the instances have more than 23 triangles.*fewer instances"):
        describe_dict(scene)
