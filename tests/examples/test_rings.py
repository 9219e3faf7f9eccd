"""What the benchmark of the rings reads and carves, on silhouettes of a ball that are drawn here."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

BENCHMARKS = Path(__file__).resolve().parents[2] / "examples" / "benchmarks"
#: The ball, m; cameras on a ring about it: distance, m, focal lengths and principal point, pixels.
MIDDLE, RADIUS = np.array([0.02, -0.01, 0.03]), 0.04
DISTANCE, FOCAL, CENTER, SIZE = 0.7, (900.0, 910.0), (161.0, 118.0), (320, 240)
#: Nodes of the hull's grid; how far apart they are, m.
NODES, NODE = 40, 0.0025


@pytest.fixture(scope="module")
def data(modules):
    return modules("rings_data")


@pytest.fixture(scope="module")
def ring(data, tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("ring")
    write_ring(folder)
    return data.Ring(folder, NODES)


def camera(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """R and t of a camera on the ring about the ball's z axis, which points to the right in its image."""
    away = np.array([np.cos(angle), np.sin(angle), 0.0])
    right = np.array([0.0, 0.0, 1.0])
    rotation = np.stack([right, np.cross(-away, right), -away])
    return rotation, -rotation @ (MIDDLE + DISTANCE * away)


def write_ring(folder: Path, offset: float = 0.0, count: int = 16) -> None:
    """A lit ball before a background that is not quite black, with a shadow on it; listed cameras have an offset."""
    lens = np.array([[FOCAL[0], 0.0, CENTER[0]], [0.0, FOCAL[1], CENTER[1]], [0.0, 0.0, 1.0]])
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    rays = np.stack([(x - CENTER[0]) / FOCAL[0], (y - CENTER[1]) / FOCAL[1], np.ones(x.shape)], axis=-1)
    told = lens - [[0.0, 0.0, 0.0], [0.0, 0.0, offset], [0.0, 0.0, 0.0]]
    lines = [str(count)]
    for i in range(count):
        rotation, move = camera(2.0 * np.pi * i / count)
        middle = rotation @ MIDDLE + move
        nearest = (rays @ middle)[..., None] / (rays**2).sum(axis=-1, keepdims=True) * rays
        codes = np.where(np.linalg.norm(nearest - middle, axis=-1) < RADIUS, 150, 12).astype(np.uint8)
        codes[112:117, 155:160] = 5
        Image.fromarray(codes).convert("RGB").save(folder / f"ball{i:02}.png")
        lines.append(" ".join([f"ball{i:02}.png", *(repr(float(v)) for v in (*told.flat, *rotation.flat, *move))]))
    (folder / "ball_par.txt").write_text("\n".join(lines) + "\n")
    (folder / "ball_good_silhouette_images.txt").write_text("\n".join(f"ball{i:02}.png" for i in range(1, count)))
    low, high = MIDDLE - 1.1 * RADIUS, MIDDLE + 1.1 * RADIUS
    rows = [f"({' '.join(map(str, corner))})" for corner in (low, high)]
    (folder / "README.txt").write_text("A ball\n\nThe (tight) bounding box is\n" + "\n".join(rows) + "\n\n(more)\n")


def test_the_hull_of_a_ring_holds_the_ball_closely(data, ring):
    assert ring.kept == [3, 7, 11, 15] and len(ring.given) == 12
    assert [view.carves for view in ring.views] == [False] + [True] * 15
    box = data.read_box(ring.views[0].file.parent)
    np.testing.assert_allclose(box, [MIDDLE - 1.1 * RADIUS, MIDDLE + 1.1 * RADIUS])
    assert ring.linear[0].shape == (60, 80, 3) and ring.linear[0].max() == pytest.approx(150.0 / 255.0)
    vertices, faces = ring.hull
    away = vertices - MIDDLE
    grown = (data.BLACK.grown - data.BLACK.shrunk) * DISTANCE / FOCAL[0]
    # In the ring's plane the hull is a polygon of 11 views around a circle; the ball is inside of it everywhere.
    assert np.linalg.norm(away, axis=1).min() > RADIUS - NODE
    assert np.linalg.norm(away, axis=1).max() < 1.15 * (RADIUS + grown) + NODE
    assert np.abs(away[:, 2]).max() < RADIUS + grown + NODE
    corners = vertices[faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert 4.0 / 3.0 * np.pi * RADIUS**3 < volume < 4.0 / 3.0 * np.pi * (1.05 * (RADIUS + grown)) ** 3


def test_silhouettes_tell_a_principal_point_that_is_too_high(data, tmp_path):
    write_ring(tmp_path, offset=1.5)
    views = data.read_views(tmp_path)[::2]
    silhouettes = [data.read_silhouette(view, judging=True) for view in views]
    assert data.offset_of(views, silhouettes, data.read_box(tmp_path)) == pytest.approx(1.5, abs=0.3)


def test_silhouettes_grow_a_little_and_shadows_are_filled(data):
    codes = np.zeros((120, 160))
    codes[30:90, 40:100] = 0.6
    codes[50:70, 60:80] = 0.05  # in shadow
    codes[5:9, 150:154] = 0.5  # something else
    found = data.silhouette(codes, 0.19)
    grown = data.BLACK.grown - data.BLACK.shrunk
    assert found[30:90, 40:100].all()
    assert found[60].sum() == found[:, 70].sum() == 60 + 2 * grown
    assert not found[:20, 140:].any()
    cut = data.silhouette(codes[45:], 0.19)
    assert cut[0, 40:100].all()  # an object that the frame cuts off
    with pytest.raises(ValueError, match="shows no object"):
        data.silhouette(np.zeros((20, 20)), 0.19)


def test_a_yellow_object_is_told_from_a_brighter_cloth_by_its_colour(data):
    codes = np.full((120, 160, 3), 0.3)
    codes[30:90, 40:100] = [0.28, 0.2, 0.14]
    codes[35:85, 60:75] = 0.3  # the cloth, through a gap
    codes[60:64, 85:89] = 0.03  # in shadow
    found = data.silhouette(data.CLOTH.signal(codes), data.CLOTH.carving, data.CLOTH)
    truth = np.zeros((120, 160), bool)
    truth[30:90, 40:100] = True
    truth[35:85, 60:75] = False
    assert (found != truth).sum() <= 16  # the gap's corners are closed


def test_cameras_see_where_the_matrices_say(data, ring):
    sensor = ring.sensor(5)
    view = ring.views[5]
    assert sensor["film"]["width"] == 80 and sensor["film"]["height"] == 60
    at = np.asarray(sensor["to_world"])[:3, 3]
    np.testing.assert_allclose(view.R @ at + view.t, 0.0, atol=1e-12)
    # A pixel of the reduced photograph has the middle of four by four pixels.
    x = (0.5 - sensor["principal_point_offset_x"]) * 80
    assert x == pytest.approx((CENTER[0] + 0.5) / data.REDUCE)
    y = (0.5 - sensor["principal_point_offset_y"]) * 60
    assert abs(ring.offset) < 0.3 and y == pytest.approx((CENTER[1] + ring.offset + 0.5) / data.REDUCE)
    with pytest.raises(FileNotFoundError, match=r"no \*_par.txt"):
        data.read_views(BENCHMARKS)


def test_decibels_count_the_silhouette_alone(ring):
    image = ring.linear[2] + 0.1
    assert ring.decibels(image, 2) == pytest.approx(20.0, abs=1e-4)
    image[~ring.inside[2]] = 1.0
    assert ring.decibels(image, 2) == pytest.approx(20.0, abs=1e-4)
