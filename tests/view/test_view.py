"""The pictures that ``view`` draws, looked at pixel by pixel.

Where VTK has no OpenGL the pictures cannot be drawn; those tests are then skipped with the error's own words.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from warp_psdr.scene.description import (
    BsdfDescription,
    EmitterDescription,
    FilmDescription,
    MediumDescription,
    PhaseDescription,
    SceneDescription,
    SensorDescription,
    ShapeDescription,
    TextureDescription,
    VolumeDescription,
)
from warp_psdr.view import panels, vtk_window
from warp_psdr.view.viewer import view

SIZE = (400, 300)
#: A constant, and what moves the corner of a box to (-1, -1, -1).
ONE, CORNER = np.ones(1, np.float32), np.array([[0, 0, 0, 1], [0, 0, 0, 1], [0, 0, 0, 1], [0, 0, 0, 0]], np.float32)
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
SQUARE_UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


def sphere() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(4)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def constant(path: str, *value: float) -> TextureDescription:
    return TextureDescription(path, "constant", np.array(value, np.float32))


def diffuse(path: str, reflectance: TextureDescription) -> BsdfDescription:
    return BsdfDescription(path, "diffuse", {"reflectance": reflectance})


def sensor(origin=(0.0, 0.0, 5.0), fov: float = 45.0) -> SensorDescription:
    """A camera that looks at the world's origin, up along y."""
    forward = -np.array(origin) / np.linalg.norm(origin)
    left = np.cross([0.0, 1.0, 0.0], forward)
    left /= np.linalg.norm(left)
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :4] = np.stack([left, np.cross(forward, left), forward, np.array(origin)], axis=1)
    return SensorDescription("cam", "perspective", pose, fov, film=FilmDescription(*SIZE, 0, 0, *SIZE))


def ball(**changes) -> ShapeDescription:
    vertices, faces = sphere()
    return ShapeDescription(
        "ball", "ply", vertices, faces, diffuse("m", constant("m.reflectance", 0.5, 0.5, 0.5)), **changes
    )


def wall(texture: TextureDescription, half: float = 1.0) -> ShapeDescription:
    """A square facing +z, u to the right and v upwards."""
    vertices = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    return ShapeDescription("wall", "rectangle", vertices, QUAD, diffuse("p", texture), texcoords=SQUARE_UV)


def scene_of(*shapes: ShapeDescription, emitters=(), camera: SensorDescription | None = None) -> SceneDescription:
    return SceneDescription(list(shapes), list(emitters), [camera or sensor()])


@pytest.fixture(scope="session")
def can_draw() -> None:
    try:
        vtk_window.find_window(bool(os.environ.get("DISPLAY")), os.environ.get("VTK_DEFAULT_OPENGL_WINDOW", ""))
    except RuntimeError as error:
        pytest.skip(str(error))


@pytest.fixture
def draw(can_draw: None, tmp_path: Path) -> Callable[..., np.ndarray]:
    """Call ``view`` with a screenshot and return its pixels."""

    def call(scene: SceneDescription, params=None, **options) -> np.ndarray:
        options = {"window_size": SIZE, **options}
        view(scene, params, screenshot=tmp_path / "v.png", **options).close()
        assert [p.name for p in tmp_path.iterdir()] == ["v.png"]
        image = np.asarray(Image.open(tmp_path / "v.png").convert("RGB")).astype(int)
        return without_labels(image, options["window_size"]) if "fields" in options else image

    return call


def without_labels(image: np.ndarray, window_size: tuple[int, int]) -> np.ndarray:
    """Cut the margins that hold labels off a picture of one panel, or of two beside each other."""
    count = window_size[0] // SIZE[0]
    cells, whole = panels.arrangement(count, window_size, labels=True)
    assert image.shape[:2] == whole[::-1]
    top = cells[0].title
    columns = [image[top : top + window_size[1], round(c.x) : round(c.x + c.width)] for c in cells]
    return np.concatenate(columns, axis=1)


def red(image: np.ndarray) -> np.ndarray:
    return (image[..., 0] > image[..., 1] + 60) & (image[..., 0] > image[..., 2] + 40)


def blue(image: np.ndarray) -> np.ndarray:
    return image[..., 2] > image[..., 0] + 60


def yellow(image: np.ndarray) -> np.ndarray:
    return (image[..., 0] > 200) & (image[..., 1] > 150) & (image[..., 2] < 140)


def middle(image: np.ndarray) -> np.ndarray:
    """The pixels around the centre of a picture."""
    h, w = image.shape[0] // 2, image.shape[1] // 2
    return image[h - 25 : h + 25, w - 25 : w + 25]


def test_the_camera_projects_as_in_rendering(draw) -> None:
    # A small lamp at a known point, through a pinhole camera: x to the left, y up, horizontal field of view.
    point = np.array([0.9, 0.7, 0.6], np.float32)
    camera = sensor((1.0, 2.0, 4.0), 50.0)
    lamp = wall(constant("p.reflectance", 0.5))
    facing = 0.05 * np.stack([-camera.to_world[:3, 0], camera.to_world[:3, 1]])
    lamp.vertices = point + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32) @ facing
    lamp.emitter = EmitterDescription("lamp", "area", constant("lamp.radiance", 5.0))
    local = np.linalg.inv(camera.to_world) @ [*point, 1.0]
    half = np.tan(np.radians(25.0))
    image = draw(scene_of(ball(), lamp, emitters=[lamp.emitter], camera=camera))
    rows, columns = np.nonzero(yellow(image))
    assert len(rows) > 20
    assert columns.mean() + 0.5 == pytest.approx(SIZE[0] * 0.5 * (1.0 - local[0] / local[2] / half), abs=1.0)
    assert rows.mean() + 0.5 == pytest.approx(0.5 * (SIZE[1] - SIZE[0] * local[1] / local[2] / half), abs=1.0)
    # A narrower window keeps the width of the film in view.
    tall = draw(scene_of(ball(), lamp, emitters=[lamp.emitter], camera=camera), window_size=(200, 300))
    _, columns = np.nonzero(yellow(tall))
    assert columns.mean() + 0.5 == pytest.approx(100 * (1.0 - local[0] / local[2] / half), abs=1.0)
    hidden = draw(scene_of(ball(), lamp, emitters=[lamp.emitter], camera=camera), show_emitters=False)
    assert not yellow(hidden).any()


@pytest.mark.parametrize("window", [SIZE, (200, 300)])
def test_an_orthographic_camera_has_no_perspective(draw, window) -> None:
    # Two small lamps, one behind the other: half the film's width is the first column's length, at any depth.
    camera = sensor((0.0, 0.0, 4.0))
    camera.kind = "orthographic"
    camera.to_world[:3, :2] *= 2.0
    lamp = wall(constant("p.reflectance", 0.5), 0.1)
    lamp.vertices = np.concatenate([lamp.vertices + np.array([1.2, 0.6, z]) for z in (0.5, -2.0)])
    lamp.faces = np.concatenate([lamp.faces, lamp.faces + 4])
    lamp.texcoords = np.concatenate([lamp.texcoords, lamp.texcoords])
    lamp.emitter = EmitterDescription("lamp", "area", constant("lamp.radiance", 5.0))
    image = draw(scene_of(lamp, emitters=[lamp.emitter], camera=camera), window_size=window)
    rows, columns = np.nonzero(yellow(image))
    shape = min(window[0] / window[1], SIZE[0] / SIZE[1])
    pixels = 0.5 * window[1] * shape / 2.0
    assert columns.mean() + 0.5 == pytest.approx(0.5 * window[0] + 1.2 * pixels, abs=1.0)
    assert rows.mean() + 0.5 == pytest.approx(0.5 * window[1] - 0.6 * pixels, abs=1.0)
    assert np.ptp(rows) + 1 == pytest.approx(0.2 * pixels, abs=2.0)


def test_media_are_shown_on_what_bounds_them_and_voxels_on_planes(draw) -> None:
    phase, albedo = PhaseDescription("m.phase_function", "isotropic"), VolumeDescription("m.albedo.value.value", ONE)
    for volume, pose in ((ONE, None), (np.ones((2, 2, 2, 1), np.float32), np.diag([2.0, 2.0, 2.0, 1.0]) - CORNER)):
        sigma_t = VolumeDescription("m.sigma_t.data", volume, pose)
        bounded = ball(interior=MediumDescription("m", sigma_t, albedo, 1.0, phase, pose is not None))
        for sign, colour in ((1.0, red), (-1.0, blue)):
            image = draw(scene_of(bounded), fields={"m.sigma_t.data": sign * volume})
            assert colour(middle(image)).mean() > 0.8


def test_materials_are_shown_in_their_colours(draw) -> None:
    texels = np.zeros((2, 2, 3), np.float32)
    texels[0, 0] = [0.8, 0.0, 0.0]  # first row: v below 1/2; first column: u below 1/2
    texels[1, 1] = [0.0, 0.0, 0.8]
    image = draw(scene_of(wall(TextureDescription("p.reflectance", "bitmap", texels))))
    rows, columns = np.nonzero(red(image))
    assert rows.min() >= 149
    assert columns.max() <= 200
    rows, columns = np.nonzero(blue(image))
    assert rows.max() <= 150
    assert columns.min() >= 199
    green = scene_of(ball())
    green.shapes[0].bsdf.textures["reflectance"].value[:] = [0.0, 0.7, 0.0]
    color = middle(draw(green)).mean(axis=(0, 1))
    assert color[1] > color[0] + 60
    assert color[1] > color[2] + 60


def test_current_values_stand_in_for_the_description(draw) -> None:
    scene = scene_of(ball())
    before = draw(scene)
    params = {
        "ball.vertex_positions": scene.shapes[0].vertices * 0.5 + np.float32([1.0, 0, 0]),
        "m.reflectance.value": np.array([0.9, 0.0, 0.0], np.float32),
    }
    after = draw(scene, params)
    assert not red(before).any()
    assert np.nonzero(red(after))[1].min() > 220  # moved to +x, which is right


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_growth_along_the_normal_is_red_against_it_blue(draw, sign: float) -> None:
    vertices, _ = sphere()
    image = draw(scene_of(ball()), fields={"ball.vertex_positions": 1e-4 * sign * vertices})
    colored, other = (red, blue) if sign > 0 else (blue, red)
    assert colored(middle(image)).mean() > 0.8  # the arrows hide the rest
    assert not other(middle(image)).any()


def test_zero_is_neutral_and_bright(draw) -> None:
    vertices, _ = sphere()
    field = np.where(vertices[:, :1] > 0.9, vertices, 0.0)  # not zero far from the middle only
    neutral = middle(draw(scene_of(ball()), fields={"ball.vertex_positions": field}))
    assert np.ptp(neutral, axis=-1).max() <= 4
    assert neutral.min() > 200


def test_arrows_are_drawn_outside_of_the_silhouette(draw) -> None:
    vertices, _ = sphere()
    scene = scene_of(ball(attributes={"vertex_color": np.zeros((len(vertices), 3), np.float32)}))
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    scale = SIZE[0] / 2 / np.tan(np.radians(22.5))
    distance = np.hypot(rows - 150, columns - 200) / (scale * np.tan(np.arcsin(1 / 5)))  # in radii of the silhouette
    ring = (distance > 1.03) & (distance < 1.15)
    dark = [
        (draw(scene, fields={name: vertices})[ring] < 80).all(axis=-1).mean()
        for name in ("ball.vertex_positions", "ball.vertex_color")
    ]
    assert dark[0] > 0.03
    assert dark[1] == 0.0


def test_attributes_are_drawn_at_vertices_and_faces(draw) -> None:
    vertices, faces = sphere()
    scene = scene_of(ball(attributes={"vertex_color": vertices, "face_color": np.ones((len(faces), 1), np.float32)}))
    left_to_right = np.repeat(vertices[:, :1], 3, axis=1)
    for name, values in [
        ("ball.vertex_color", left_to_right),
        ("ball.face_color", left_to_right[faces].mean(axis=1)[:, :1]),
    ]:
        image = draw(scene, fields={name: values})[100:200, 110:290]
        assert blue(image[:, :50]).mean() > 0.5
        assert red(image[:, -50:]).mean() > 0.5
        assert not red(image[:, :80]).any()


def test_boards_and_volumes_have_their_mean_colour(draw) -> None:
    deep = np.zeros((2, 2, 2, 3), np.float32) + np.array([0.7, 0.05, 0.05], np.float32)
    volume = TextureDescription("p.reflectance.volume", "volume", deep, to_world=np.eye(4))
    empty = np.zeros(0, np.float32)
    board = TextureDescription("p.reflectance", "checkerboard", empty, nested=(volume, constant("b", 0.1, 0.0, 0.0)))
    for texture in (volume, board):
        assert red(middle(draw(scene_of(wall(texture))))).all()


def test_texture_gradients_lie_where_the_texture_is_read(draw) -> None:
    texture = TextureDescription("p.reflectance", "bitmap", np.full((4, 4, 3), 0.5, np.float32))
    gradient = np.zeros((4, 4, 3))
    gradient[0, 3] = 1.0
    gradient[3, 0] = -1.0
    image = draw(scene_of(wall(texture)), fields={"p.reflectance.data": gradient})[:, :315]
    half = SIZE[0] / 2 / np.tan(np.radians(22.5)) / 5  # half the wall in pixels
    rows, columns = np.nonzero(red(image))
    assert (rows.mean(), columns.mean()) == pytest.approx((150 + 0.75 * half, 200 + 0.75 * half), abs=2.0)
    rows, columns = np.nonzero(blue(image))
    assert (rows.mean(), columns.mean()) == pytest.approx((150 - 0.75 * half, 200 - 0.75 * half), abs=2.0)
    assert red(image).sum() == pytest.approx(half**2 / 4, rel=0.15)
    assert image[150, 200].min() > 225  # zero is white

    texture.to_uv = np.diag([2.0, 2.0, 1.0])  # repeats twice in each direction
    image = draw(scene_of(wall(texture)), fields={"p.reflectance.data": gradient})[:, :315]
    quarters = [red(image[a:b, c:d]).sum() for a, b in [(50, 150), (150, 250)] for c, d in [(100, 200), (200, 300)]]
    assert quarters == pytest.approx([half**2 / 16] * 4, rel=0.25)

    texture.wrap = "clamp"
    image = draw(scene_of(wall(texture)), fields={"p.reflectance.data": gradient})[:, :315]
    assert red(image[150:250, 200:300]).sum() > 3 * half**2 / 16  # the last texel goes on to the border


def test_a_constant_colours_the_surfaces_that_share_it(draw) -> None:
    left, right = ball(), ball()
    left.vertices, right.vertices = left.vertices * 0.5 - [1, 0, 0], right.vertices * 0.5 + np.array([1, 0, 0])
    right.path, right.bsdf = "other", left.bsdf
    image = draw(scene_of(left, right), fields={"m.reflectance.value": [-1.0, -1.0, -1.0]})
    assert blue(image[100:200, 90:150]).mean() > 0.5
    assert blue(image[100:200, 250:300]).mean() > 0.5


def test_labels_stand_beside_the_panel(can_draw, tmp_path: Path) -> None:
    vertices, _ = sphere()
    near = scene_of(ball(), camera=sensor((0.0, 0.0, 1.5)))  # fills the panel
    texts = []
    plotter = view(near, fields={"ball.vertex_positions": vertices}, screenshot=tmp_path / "v.png", window_size=SIZE)
    for renderer in plotter.renderers:
        texts += [actor.input for actor in renderer.actors.values() if hasattr(actor, "input")]
    plotter.close()
    image = np.asarray(Image.open(tmp_path / "v.png").convert("RGB")).astype(int)
    (cell,), _ = panels.arrangement(1, SIZE, labels=True)
    bar = image[:, SIZE[0] :]
    assert red(bar[: SIZE[1] // 2]).any() and blue(bar[SIZE[1] // 2 :]).any()
    for margin in (image[: cell.title], image[cell.title + SIZE[1] :]):
        assert not red(margin).any() and margin.min() < 80  # letters and background alone
    assert "ball.vertex_positions" in texts
    assert any("per world unit" in text and "clip" in text for text in texts)


@pytest.mark.parametrize(("count", "rows"), [(1, [1]), (2, [2]), (3, [1, 2]), (4, [2, 2]), (5, [2, 3]), (7, [2, 2, 3])])
def test_panels_leave_no_place_empty(count: int, rows: list[int]) -> None:
    cells, whole = panels.arrangement(count, (800, 600), labels=True)
    heights = sorted({cell.y for cell in cells}, reverse=True)
    assert [sum(cell.y == y for cell in cells) for y in heights] == rows
    covered = [cell.viewport(whole, margins=True) for cell in cells]
    assert sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in covered) == pytest.approx(1.0)
    wide, _ = panels.arrangement(3, (1200, 300), labels=False)
    assert len({cell.y for cell in wide}) == 1


def test_shapes_share_a_panel_and_a_scale(draw) -> None:
    left, right = ball(), ball()
    left.vertices, right.vertices = left.vertices * 0.5 - [1, 0, 0], right.vertices * 0.5 + np.array([1, 0, 0])
    right.path = "other"
    vertices, _ = sphere()
    image = draw(
        scene_of(left, right), fields={"ball.vertex_positions": 0.01 * vertices, "other.vertex_positions": -vertices}
    )
    assert blue(image[120:180, 265:300]).mean() > 0.3
    assert not red(image[100:200, 90:150]).any()  # a hundredth of the scale is as good as white


def test_kinds_of_parameters_have_panels_that_do_not_light_each_other(draw) -> None:
    vertices, _ = sphere()
    half = np.broadcast_to(np.where(vertices[:, :1] > 0.9, 1.0, 0.4), vertices.shape)  # 0.4 of the limit in the middle
    scene = scene_of(ball(attributes={"vertex_a": vertices, "vertex_b": vertices}))
    alone = draw(scene, fields={"ball.vertex_a": half})
    both = draw(scene, fields={"ball.vertex_a": half, "ball.vertex_b": -half}, window_size=(800, 300))
    assert np.abs(middle(both[:, :400]).mean(axis=(0, 1)) - middle(alone).mean(axis=(0, 1))).max() < 3.0
    assert blue(middle(both[:, 400:])).mean() > 0.5


def test_the_environment_is_drawn_in_its_directions(draw) -> None:
    texture = TextureDescription("env", "bitmap", np.ones((16, 32, 3), np.float32))
    emitter = EmitterDescription("env", "envmap", texture, to_world=np.eye(4))
    gradient = np.zeros((16, 32, 3))
    gradient[2:6, 14:18] = 1.0  # above +z, behind the camera
    gradient[9:13, :2] = gradient[9:13, 30:] = -1.0  # below -z, ahead
    scene = scene_of(ball(), emitters=[emitter])
    image = draw(scene, fields={"env.data": gradient}, window_size=(800, 300))
    ahead, behind = image[20:280, :310], image[20:280, 400:710]
    assert blue(ahead).sum() > 200
    assert not red(ahead).any()
    assert red(behind).sum() > 200
    assert not blue(behind).any()
    assert np.nonzero(blue(ahead))[0].min() > 130  # the lower half of the panel
    assert np.nonzero(red(behind))[0].max() < 130
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])  # by half a turn about y: now the other way round
    image = draw(scene, {"env.to_world": turned}, fields={"env.data": gradient}, window_size=(800, 300))
    assert red(image[20:280, :310]).sum() > 200
    assert blue(image[20:280, 400:710]).sum() > 200


def test_gradients_are_taken_from_the_parameters(draw) -> None:
    class Parameter:
        def __init__(self, values, grad):
            self.values, self.grad = values, grad

        def numpy(self):
            return self.values

    vertices, _ = sphere()
    params = {
        "ball.vertex_positions": Parameter(vertices, -vertices),
        "m.reflectance.value": Parameter(np.ones(3), None),
    }
    assert blue(middle(draw(scene_of(ball()), params, fields="ball.vertex_positions"))).mean() > 0.8
    with pytest.raises(ValueError, match=r"no gradient.*requires_grad"):
        view(scene_of(ball()), params, fields=["m.reflectance.value"])


def test_from_outside_everything_is_in_view(draw) -> None:
    lights = [
        EmitterDescription("p", "point", constant("p.intensity", 1.0), position=np.array([0.0, 1.3, 0.0])),
        EmitterDescription("s", "spot", constant("s.intensity", 1.0), to_world=np.eye(4)),
        EmitterDescription("d", "directional", constant("d.irradiance", 1.0), to_world=np.eye(4)),
    ]
    image = draw(scene_of(ball(), emitters=lights), camera=None)
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert (np.ptp(border, axis=0) <= 4).all()
    assert yellow(image).sum() > 50
    assert (np.abs(image - image[0, 0]).max(axis=-1) > 20).mean() > 0.15


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fields": {"ball.to_world": np.eye(4)}}, r"cannot draw ball\.to_world.*ball\.vertex_positions"),
        ({"fields": {"ball.vertex_positions": np.zeros((3, 3))}}, "shape"),
        ({"fields": "ball.vertex_positions"}, "no parameter"),
        ({"fields": ["nothing"], "params": {"something": 0}}, "something"),
        ({"camera": 1}, "sensors 0 to 0"),
    ],
)
def test_what_cannot_be_drawn_is_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        view(scene_of(ball()), **options)


def test_without_opengl_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def crash(command, env, **options):
        tried.append(env["VTK_DEFAULT_OPENGL_WINDOW"])
        return subprocess.CompletedProcess(command, -11, b"", b"")

    monkeypatch.setattr(vtk_window.subprocess, "run", crash)
    monkeypatch.setattr(vtk_window.sys, "platform", "linux")
    with pytest.raises(RuntimeError, match="apt-get install libosmesa6"):
        vtk_window.find_window.__wrapped__(True)
    assert tried == ["vtkXOpenGLRenderWindow", "vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere VTK's own choice is taken")
def test_a_window_class_that_does_not_exist_is_an_error() -> None:
    with pytest.raises(RuntimeError, match="vtkNoSuchWindow"):
        vtk_window.find_window.__wrapped__(False, "vtkNoSuchWindow")


def test_the_environment_is_left_as_it_was(draw, monkeypatch: pytest.MonkeyPatch) -> None:
    before = dict(os.environ)
    draw(scene_of(ball()))
    assert dict(os.environ) == before
