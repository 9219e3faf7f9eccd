"""Textures with steps that move before a camera, behind a mirror, and over their surface."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.topology.texture_steps import film_lines, world_lines

from .measure import STANDARD_ERRORS, assert_transposes
from .scenes import T

#: Emission of the two kinds of fields, and how the texture lies on the board, so that no line meets a corner.
DARK, BRIGHT = 0.2, 1.0
TO_UV = np.array([[1.7, 0.0, 0.13], [0.0, 1.3, 0.21], [0.0, 0.0, 1.0]])
SIZE = 8
BATCHES = 6


def checkers(to_uv=TO_UV):
    colors = {f"color{i}": {"type": "rgb", "value": [value] * 3} for i, value in enumerate((DARK, BRIGHT))}
    return {"type": "checkerboard", "to_uv": to_uv, **colors}


def board(texture, **more):
    """A square of side 2 that shines as its texture says."""
    return {"type": "rectangle", "emitter": {"type": "area", "radiance": texture}, **more}


def camera(pose, rfilter="tent", **more):
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": rfilter}}
    return {"type": "perspective", "fov": 30.0, "to_world": pose, "film": film, **more}


def load(**objects):
    scene = psdr.load_dict({"type": "scene", **objects})
    return scene, psdr.traverse(scene)


def forward(scene, params, name, tangent, depth, spp, seed):
    integrator = psdr.PathIntegrator(max_depth=depth)
    tangents = {name: tangent.astype(np.float32)}
    return psdr.render_forward(scene, params, tangents, integrator=integrator, spp=spp, seed=seed).numpy()[..., 0]


def difference(scene, params, name, tangent, depth, spp, seed, step):
    base = params[name].numpy().copy()
    images = []
    for sign in (1.0, -1.0):
        params[name] = (base + sign * step * tangent).astype(np.float32)
        params.update()
        integrator = psdr.PathIntegrator(max_depth=depth)
        images.append(psdr.render(scene, integrator=integrator, spp=spp, seed=seed).numpy()[..., 0].astype(np.float64))
    params[name] = base
    params.update()
    return (images[0] - images[1]) / (2.0 * step)


def assert_slope(scene, params, name, tangent, depth, spp=256, difference_spp=4096, step=4e-3):
    """Regress batches of derivatives on a difference; the weights have random numbers of their own."""
    weights = difference(scene, params, name, tangent, depth, difference_spp, 900, step)
    pairs = [
        (
            (weights * forward(scene, params, name, tangent, depth, spp, seed)).sum(),
            (weights * difference(scene, params, name, tangent, depth, difference_spp, seed, step)).sum(),
        )
        for seed in range(BATCHES)
    ]
    a, b = np.array(pairs).T
    assert abs(b.mean()) > 20.0 * b.std(ddof=1) / np.sqrt(BATCHES)  # it moves
    slope = a.mean() / b.mean()
    error = np.hypot(a.std(ddof=1) / a.mean(), b.std(ddof=1) / b.mean()) / np.sqrt(BATCHES)
    assert abs(slope - 1.0) < 0.02 + STANDARD_ERRORS * error
    assert error < 0.02


def wave(x):
    """The integral from 0 of a square wave: 1 on [0, 1/2), -1 on [1/2, 1), and so on."""
    return 0.25 - np.abs(x - np.floor(x) - 0.5) / 1.0 + 0.25


def test_the_closed_form_of_a_board_before_parallel_rays() -> None:
    """A field's colour is the product of two square waves, so the mean over a pixel is that of their integrals."""
    pose = T.look_at([0, 0, 2], [0, 0, 0], [0, 1, 0]) @ T.scale([0.7, 0.7, 1.0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    sensor = {"type": "orthographic", "to_world": pose, "film": film}
    scene, params = load(sensor=sensor, board=board(checkers()))

    def pixels(shift):
        # Film points from left to right are x from .7 to -.7 or the other way round: the pose's first axis says.
        right = np.sign(params["sensor.to_world"].numpy()[0, 0])
        borders = np.linspace(1.0, -1.0, SIZE + 1) * 0.7
        s = TO_UV[0, 0] * (0.5 + 0.5 * (right * borders + shift)) + TO_UV[0, 2]
        t = TO_UV[1, 1] * (0.5 + 0.5 * borders) + TO_UV[1, 2]
        across, down = (np.diff(wave(x)) / np.diff(x) for x in (s, t))
        return 0.5 * (DARK + BRIGHT) + 0.5 * (DARK - BRIGHT) * down[:, None] * across[None]

    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=1), spp=1024).numpy()[..., 0]
    assert np.abs(image - pixels(0.0)).max() < 0.02
    exact = (pixels(1e-5) - pixels(-1e-5)) / 2e-5
    assert np.abs(exact).max() > 0.5
    tangent = np.zeros((4, 4))
    tangent[0, 3] = 1.0
    estimate = np.mean([forward(scene, params, "sensor.to_world", tangent, 1, 1024, seed) for seed in range(4)], axis=0)
    assert np.abs(estimate - exact).max() < 0.03 * np.abs(exact).max()
    assert (estimate * exact).sum() / (exact**2).sum() == pytest.approx(1.0, abs=0.01)
    # A board that moves the other way is the same motion.
    moved = np.mean([forward(scene, params, "board.to_world", -tangent, 1, 1024, seed) for seed in range(4)], axis=0)
    assert (moved * exact).sum() / (exact**2).sum() == pytest.approx(1.0, abs=0.01)


def test_fields_that_are_meshes_of_their_own_have_the_same_derivative() -> None:
    pose = T.look_at([0.3, -1.5, 2.5], [0, 0, 0], [0, 1, 0])
    scene, params = load(sensor=camera(pose), board=board(checkers()))
    cuts = [[(k / 2 - t) / m for k in range(12)] for m, t in ((TO_UV[0, 0], TO_UV[0, 2]), (TO_UV[1, 1], TO_UV[1, 2]))]
    lines = [[-1.0, *[2 * x - 1 for x in cut if 0 < x < 1], 1.0] for cut in cuts]
    objects = {}
    for k, value in enumerate((DARK, BRIGHT)):
        corners = [
            [[a, c, 0], [b, c, 0], [b, d, 0], [a, d, 0]]
            for i, (a, b) in enumerate(zip(lines[0], lines[0][1:], strict=False))
            for j, (c, d) in enumerate(zip(lines[1], lines[1][1:], strict=False))
            if (i + j) % 2 == k
        ]
        first = 4 * np.arange(len(corners))[:, None, None]
        faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        light = {"type": "area", "radiance": {"type": "rgb", "value": [value] * 3}}
        vertices = np.array(corners, np.float32).reshape(-1, 3)
        objects[f"part{k}"] = {"type": "mesh", "vertices": vertices, "faces": faces.astype(np.int32), "emitter": light}
    twin, of_twin = load(sensor=camera(pose), **objects)
    tangent = np.zeros((4, 4))
    tangent[:3, 3] = [1.0, 0.4, 0.3]
    means, errors = [], []
    for loaded, values in ((scene, params), (twin, of_twin)):
        batch = np.array([forward(loaded, values, "sensor.to_world", tangent, 1, 256, seed) for seed in range(8)])
        means.append(batch.mean(axis=0))
        errors.append(batch.var(axis=0, ddof=1) / len(batch))
    z = (means[0] - means[1]) / np.sqrt(errors[0] + errors[1] + 1e-8)
    assert np.abs(means[0]).max() > 0.5
    assert np.sqrt((z**2).mean()) < 1.6


@pytest.mark.parametrize("texture", ["checkerboard", pytest.param("nearest", marks=pytest.mark.slow)])
def test_to_uv_and_texture_coordinates_slide_what_the_camera_sees(texture) -> None:
    texels = np.random.default_rng(3).uniform(0.1, 1.0, (3, 4, 1)).repeat(3, axis=2).astype(np.float32)
    nearest = {"type": "bitmap", "bitmap": texels, "filter_type": "nearest", "raw": True, "to_uv": TO_UV}
    pose = T.look_at([0.3, -1.5, 3.5], [0, 0, 0], [0, 1, 0])
    made = checkers() if texture == "checkerboard" else nearest
    scene, params = load(sensor=camera(pose), board=board(made))
    slide = np.array([[0.3, 0.1, 1.0], [0.2, 0.0, 0.7], [0.0, 0.0, 0.0]])
    name = "board.emitter.radiance.to_uv"
    assert_slope(scene, params, name, slide, 1)
    bend = np.random.default_rng(5).normal(size=params["board.vertex_texcoords"].numpy().shape)
    assert_slope(scene, params, "board.vertex_texcoords", bend, 1)
    options = {"integrator": psdr.PathIntegrator(max_depth=1), "spp": 64, "seed": 2}
    assert_transposes(scene, params, [name, "board.vertex_texcoords"], options)


MIRRORED = {
    "type": "rectangle",
    "to_world": T.translate([0, 1.4, 1.1]) @ T.rotate([1, 0, 0], 100),
    "bsdf": {"type": "conductor"},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["sensor.to_world", "board.to_world", "board.emitter.radiance.to_uv", "mirror.to_world"]
)
def test_steps_behind_a_mirror(name) -> None:
    pose = T.look_at([0.1, -3.5, 1.2], [0, 1.0, 0.6], [0, 0, 1])
    scene, params = load(sensor=camera(pose), board=board(checkers()), mirror=MIRRORED)
    tangent = np.zeros((3, 3) if name.endswith("to_uv") else (4, 4))
    tangent[:2, -1] = [1.0, 0.7]
    assert_slope(scene, params, name, tangent, 2, spp=512)
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 16, "seed": 2}
    assert_transposes(scene, params, [name], options)


@pytest.mark.slow
def test_steps_that_slide_on_a_light_move_what_it_lights() -> None:
    pose = T.look_at([0, -4.0, 1.0], [0, 0, 1.0], [0, 0, 1])
    wall = {"type": "rectangle", "to_world": T.translate([0, 0.9, 1.0]) @ T.rotate([1, 0, 0], 90)}
    scene, params = load(sensor=camera(pose), board=board(checkers()), wall=wall)
    slide = np.array([[0.3, 0.1, 1.0], [0.2, 0.0, 0.7], [0.0, 0.0, 0.0]])
    name = "board.emitter.radiance.to_uv"
    assert_slope(scene, params, name, slide, 2, spp=512, step=1e-2)
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 16, "seed": 2}
    assert_transposes(scene, params, [name, "board.vertex_texcoords"], options)


@pytest.mark.slow
def test_steps_that_slide_on_a_light_move_what_it_lights_in_fog() -> None:
    """The board is out of sight: fog and a wall show what moves."""
    pose = T.look_at([0, -4.0, 1.0], [0, 0, 1.0], [0, 0, 1])
    fog = {"type": "homogeneous", "sigma_t": 0.3, "albedo": 0.8, "phase": {"type": "hg", "g": 0.3}}
    air = {"type": "cube", "to_world": T.scale(9.0), "bsdf": {"type": "null"}, "interior": {"type": "ref", "id": "fog"}}
    wall = {"type": "rectangle", "to_world": T.translate([0, 0.9, 1.0]) @ T.rotate([1, 0, 0], 90)}
    sensor = camera(pose, medium={"type": "ref", "id": "fog"})
    scene, params = load(fog=fog, sensor=sensor, board=board(checkers()), wall=wall, air=air)
    slide = np.array([[0.3, 0.1, 1.0], [0.2, 0.0, 0.7], [0.0, 0.0, 0.0]])
    name = "board.emitter.radiance.to_uv"
    assert_slope(scene, params, name, slide, 2, spp=2048, difference_spp=16384, step=2e-2)
    assert_transposes(scene, params, [name], {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 16, "seed": 2})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["floor.bsdf.reflectance.to_uv", "floor.to_world", "sensor.to_world"])
def test_steps_of_a_lit_floor(name) -> None:
    pose = T.look_at([0.2, -3.0, 2.0], [0, 0, 0], [0, 0, 1])
    light = {"type": "rectangle", "to_world": T.translate([0.3, 0.2, 1.5]) @ T.rotate([1, 0, 0], 180) @ T.scale(0.4)}
    light["emitter"] = {"type": "area", "radiance": 8.0}
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": checkers()}}
    scene, params = load(sensor=camera(pose), floor=floor, light=light)
    tangent = np.zeros((3, 3) if name.endswith("to_uv") else (4, 4))
    tangent[:2, -1] = [1.0, 0.7]
    assert_slope(scene, params, name, tangent, 3)


@pytest.mark.parametrize("cells", [1, 4])
def test_a_line_is_listed_once_wherever_it_runs(cells) -> None:
    """Lines that run along sides of triangles are on one of the two; those along the border are on none."""
    x, y = (g.reshape(-1) for g in np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1)))
    at = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (at[i : i + cells, j : j + cells].reshape(-1) for i, j in ((0, 0), (0, 1), (1, 1), (1, 0)))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    plane = {"type": "mesh", "vertices": np.stack([x, y, 0 * x], 1).astype(np.float32), "faces": faces}
    plane |= {"texcoords": np.stack([x, y], 1).astype(np.float32)}
    plane["bsdf"] = {"type": "diffuse", "reflectance": checkers(np.diag([2.0, 1.0, 1.0]))}
    scene, _params = load(
        sensor=camera(T.look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])), plane=plane, sky={"type": "constant"}
    )
    stepped = scene.builder.stepped
    edges = world_lines(scene, frozenset((shape, t) for shape, numbers in stepped.items() for t in numbers))
    points = edges.points.numpy()
    length = np.linalg.norm(points[:, 1] - points[:, 0], axis=1).sum()
    assert length == pytest.approx(4.0)  # three lines of s, one of t


def test_a_line_along_a_seam_is_listed_for_what_slides() -> None:
    """The seam of a cylinder, where a whole number of fields meet."""
    tube = {"type": "cylinder", "bsdf": {"type": "diffuse", "reflectance": checkers(np.diag([2.0, 0.4, 1.0]))}}
    scene, params = load(
        sensor=camera(T.look_at([0, -4, 0.5], [0, 0, 0.5], [0, 0, 1])), tube=tube, sky={"type": "constant"}
    )
    carriers = frozenset((0, t) for t in scene.builder.stepped[0])
    lines = {seams: film_lines(scene, 0, carriers, seams) for seams in (False, True)}
    counts = [len(found[0].first.numpy()) - 1 for found in lines.values()]
    assert 0 < counts[0] < counts[1]
    params.requires_grad_only("tube.bsdf.reflectance.to_uv")
    assert psdr.plan(scene, params).boundary is not None
    params.requires_grad("sensor.to_world")
    with pytest.raises(ValueError, match=r"along a seam.*in a call of their own"):
        psdr.plan(scene, params)


def test_steps_on_shapes_without_triangles_are_refused_where_they_move() -> None:
    ball = {"type": "sphere", "exact": True, "bsdf": {"type": "diffuse", "reflectance": checkers()}}
    scene, params = load(
        sensor=camera(T.look_at([0, -4, 0.5], [0, 0, 0], [0, 0, 1])), ball=ball, sky={"type": "constant"}
    )
    params.requires_grad_only("ball.to_world")
    with pytest.raises(ValueError, match="not known on shapes without triangles"):
        psdr.plan(scene, params)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_steps_of_two_textures_that_lie_on_each_other_count_once(scale) -> None:
    """A board whose colour and roughness share their fields, or lines: the camera moves, and one texture slides."""
    fine = np.diag([scale, scale, 1.0]) @ TO_UV
    rough = {"type": "checkerboard", "color0": 0.1, "color1": 0.6, "to_uv": fine}
    bsdf = {"type": "principled", "base_color": checkers(), "roughness": rough}
    sky = {"type": "constant"}
    scene, _params = load(
        sensor=camera(T.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])), board={"type": "rectangle", "bsdf": bsdf}, sky=sky
    )
    (color, other) = sorted(scene.builder.stepped[0])
    both, one, two = (
        film_lines(scene, 0, frozenset((0, t) for t in textures), True)[1]
        for textures in ((color, other), (color,), (other,))
    )
    assert both == pytest.approx(max(one, two), rel=1e-6) and both < 0.9 * (one + two)
    with pytest.raises(ValueError, match="two textures of 'board' lie on each other and slide"):
        psdr.plan(scene, names=["board.bsdf.base_color.to_uv"], integrator=psdr.PathIntegrator(max_depth=2))
