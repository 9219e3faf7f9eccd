"""Shapes without triangles that the viewer draws: where their triangles are, and gradients by what defines them."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import warp_psdr as psdr
from tests.networks import fitted, sphere
from tests.path.test_sdfgrid import nodes
from warp_psdr.view.surfaces import grid_field, own_fields, surface_of

T = psdr.Transform
POSE = T.translate([0.1, -0.2, 0.3]).rotate([1, 2, 0], 30.0).scale([1.5, 1.2, -1.4])
X, Y, Z = nodes(25)
BALL = (np.sqrt((X - 0.5) ** 2 + (Y - 0.5) ** 2 + (Z - 0.5) ** 2) - 0.32).astype(np.float32)
NET = fitted(sphere, (24, 24))
SHAPES = {
    "sphere": {"type": "sphere", "exact": True},
    "disk": {"type": "disk", "exact": True},
    "cylinder": {"type": "cylinder", "exact": True},
    "linear": {"type": "sdfgrid", "grid": BALL},
    "cubic": {"type": "sdfgrid", "grid": psdr.sdf.coefficients(BALL), "interpolation": "cubic"},
    "network": NET.plugin(cells=32),
}


def loaded(**shape) -> psdr.Scene:
    return scene_of(body=shape)


def scene_of(**parts) -> psdr.Scene:
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    view = T.look_at([0.5, -4, 1.0], [0.3, 0.3, 0.5], [0, 0, 1])
    sensor = {"type": "perspective", "to_world": view, "film": film}
    return psdr.load_dict({"type": "scene", "sensor": sensor, "sky": {"type": "constant"}, **parts})


@pytest.mark.parametrize("kind", SHAPES)
def test_triangles_lie_on_the_surface_and_follow_edits(kind: str) -> None:
    scene = loaded(**SHAPES[kind])
    params = psdr.traverse(scene)
    shape = scene.description.shapes[0]
    assert len(surface_of({}, shape)[1]) > 60
    params["body.to_world"] = POSE.matrix
    vertices, faces, _texcoords = surface_of(dict(params), shape)
    local = (vertices - POSE.matrix[:3, 3]) @ np.linalg.inv(POSE.matrix[:3, :3]).T
    if kind in ("sphere", "cylinder", "disk"):
        across = local[:, :2] if kind == "cylinder" else local
        radii = np.linalg.norm(across, axis=1)
        assert (radii < 1.0 + 1e-6).all() and (kind == "disk" or (radii > 1.0 - 1e-6).all())
        assert kind == "sphere" or (local[:, 2] > -1e-6).all()
    else:
        # Marching cubes of 24 voxels and more.
        phi = NET.phi(local) if kind == "network" else np.linalg.norm(local - 0.5, axis=1) - 0.32
        np.testing.assert_allclose(phi, 0.0, atol=0.01)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = corners.mean(axis=1) - (POSE.matrix[:3, :3] @ local.mean(axis=0) + POSE.matrix[:3, 3])
    if kind not in ("disk", "cylinder"):
        assert ((normals * out).sum(axis=1) >= 0.0).all()


def test_a_grid_follows_the_instance_that_places_it() -> None:
    group = {"type": "shapegroup", "body": SHAPES["linear"]}
    scene = scene_of(group=group, placed={"type": "instance", "shapes": {"type": "ref", "id": "group"}})
    shape = scene.description.shapes[0]
    params = psdr.traverse(scene)
    before, _faces, _texcoords = surface_of(dict(params), shape)
    params["placed.to_world"] = POSE.matrix
    after, _faces, _texcoords = surface_of(dict(params), shape)
    moved = before @ POSE.matrix[:3, :3].T + POSE.matrix[:3, 3]
    # Marching cubes of a mirrored grid have the same vertices, in the same order.
    np.testing.assert_allclose(after, moved, atol=1e-5)


def test_a_gradient_by_a_grid_is_how_a_value_grows_as_the_surface_moves_outwards() -> None:
    scene = loaded(**SHAPES["linear"], to_world=POSE)
    vertices, faces, _texcoords = surface_of({}, scene.description.shapes[0])
    field, normals = grid_field(vertices, faces, POSE.matrix, X - 2.0)
    local = (field.vertices - POSE.matrix[:3, 3]) @ np.linalg.inv(POSE.matrix[:3, :3]).T
    np.testing.assert_allclose(field.values, 2.0 - local[:, 0], atol=1e-5)
    assert normals.shape == field.vertices.shape


def test_pictures(tmp_path) -> None:
    """A part that the gradient says should grow is red, and one that should shrink is blue."""
    scene = loaded(**SHAPES["linear"])
    params = psdr.traverse(scene)
    found = []
    for fields in (None, {"body.grid": (0.5 - X)[..., None]}):
        path = tmp_path / "view.png"
        try:
            psdr.view(scene, params, fields=fields, screenshot=path, window_size=(200, 150)).close()
        except RuntimeError as problem:
            pytest.skip(str(problem))
        found.append(np.asarray(Image.open(path).convert("RGB")).astype(int))
    plain, signed = found
    assert np.ptp(plain, axis=(0, 1)).max() > 30, "the shape is drawn"
    warm, cold = signed[..., 0] - signed[..., 2] > 60, signed[..., 2] - signed[..., 0] > 60
    assert warm.sum() > 100 and cold.sum() > 100
    middle = [np.argwhere(where)[:, 1].mean() for where in (warm[:150], cold[:150])]
    assert middle[0] > middle[1], "x grows to the right"


@pytest.mark.parametrize("kind", SHAPES)
def test_a_step_along_a_gradient_by_a_pose_moves_the_surface(kind: str) -> None:
    scene = loaded(**SHAPES[kind], to_world=POSE)
    shape, step = scene.description.shapes[0], 1e-3
    gradient = np.arange(16.0).reshape(4, 4) / 16.0
    gradient[3] = 0.0
    surface = surface_of({}, shape)
    size, drawn = own_fields({}, shape, surface)["body.to_world"]
    assert size == (4, 4)
    field, motion, normals = drawn(gradient)
    moved, _faces, _texcoords = surface_of({"body.to_world": POSE.matrix + step * gradient}, shape)
    np.testing.assert_allclose((moved - surface[0]) / step, motion, atol=2e-3)
    np.testing.assert_allclose(field.values, (motion * normals).sum(axis=1))


def test_a_step_along_a_gradient_by_the_weights_of_a_network_moves_the_surface() -> None:
    scene = loaded(**SHAPES["network"], to_world=POSE)
    shape, step = scene.description.shapes[0], 1e-3
    surface = surface_of({}, shape)
    fields = own_fields({}, shape, surface)
    rng, to_box = np.random.default_rng(2), np.linalg.inv(POSE.matrix[:3, :3])
    for name, held in (("layer1.weight", NET.layers[1][0]), ("layer2.bias", NET.layers[2][1])):
        gradient = rng.normal(size=held.shape)
        field, vectors, normals = fields[f"body.{name}"][1](gradient)
        assert vectors is None and np.abs(field.values).max() > 0.1
        changed = [list(layer) for layer in NET.layers]
        changed[int(name[5])][name.endswith("bias")] = held + step * gradient
        net = replace(NET, layers=[tuple(layer) for layer in changed])
        # The field of the network after the step, where the motion leads, is what it was before.
        q, there = (
            (x - POSE.matrix[:3, 3]) @ to_box.T
            for x in (field.vertices, field.vertices + step * field.values[:, None] * normals)
        )
        change = net.phi(there) - NET.phi(q)
        assert np.abs(change).max() < 0.05 * np.abs(net.phi(q) - NET.phi(q)).max()
