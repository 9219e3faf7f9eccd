"""What a camera can see of edges, on the host: exact for a pinhole and parallel rays, nothing lost through a lens."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary.scenes import ball, diffuse
from warp_psdr.scene.distortion import distort, undistort
from warp_psdr.topology.camera_view import camera_view
from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.film_edges import film_edges, primary_edges

T = psdr.Transform
FILM = {"type": "hdrfilm", "width": 20, "height": 12, "rfilter": {"type": "tent"}}
FILM |= {"crop_width": 12, "crop_height": 8, "crop_offset_x": 5, "crop_offset_y": 2}
POSE = T.look_at([0.3, -0.5, -4.0], [0.0, 0.1, 0.0], [0.0, 1.0, 0.0])
RADIUS, FOCUS, FOV = 0.6, 2.5, 40.0
SENSORS = {
    "perspective": {"fov": FOV, "to_world": POSE},
    "thinlens": {"fov": FOV, "to_world": POSE, "aperture_radius": RADIUS, "focus_distance": FOCUS},
    "orthographic": {"to_world": POSE @ T.scale([1.5, 1.2, 2.0])},
}
CLIPS = {"near_clip": 1.5, "far_clip": 6.0}
#: What the radius of the filter is beyond half a pixel: by so much the film is extended if it samples its border.
MARGIN = 0.5


def load(kind, border=True, **shapes):
    sensor = {"type": kind, "film": FILM | {"sample_border": border}, **CLIPS, **SENSORS[kind]}
    return psdr.load_dict({"type": "scene", "sensor": sensor, "sky": {"type": "constant"}, **shapes})


def pixels(kind, x, lens):
    """Positions in the crop window (..., 2), and which points lie between the clip planes: as the definitions say."""
    pose = (SENSORS[kind]["to_world"]).matrix.astype(np.float64)
    p = (x - pose[:3, 3]) @ np.linalg.inv(pose[:3, :3]).T
    z = p[..., 2:]
    if kind == "orthographic":
        film = p[..., :2]
        size = np.linalg.norm(pose[:3, 2])
        near, far = CLIPS["near_clip"], CLIPS["near_clip"] + (CLIPS["far_clip"] - CLIPS["near_clip"]) / size
    else:
        # Through the lens point, to the plane in focus.
        at_focus = lens + (p[..., :2] - lens) * FOCUS / z
        film = at_focus / FOCUS / np.tan(np.radians(0.5 * FOV))
        near, far = CLIPS["near_clip"], CLIPS["far_clip"]
    film = np.stack([10.0 * (1.0 - film[..., 0]) - 5.0, 6.0 - 10.0 * film[..., 1] - 2.0], axis=-1)
    return film, (z[..., 0] > near) & (z[..., 0] < far)


@pytest.mark.parametrize("border", [True, False], ids=["sampled border", "border"])
@pytest.mark.parametrize("kind", SENSORS)
def test_clipped_stretches_hold_what_is_seen(kind, border):
    margin = MARGIN if border else 0.0
    random = np.random.default_rng(2)
    ends = random.uniform([-3, -3, -6], [3, 3, 4], (400, 2, 3))
    s = np.linspace(0.0, 1.0, 201)
    x = ends[:, :1] * (1.0 - s)[:, None] + ends[:, 1:] * s[:, None]
    low, high, length = camera_view(load(kind, border), 0).clip(ends)
    outside = (s < low[:, None] - 1e-9) | (s > high[:, None] + 1e-9) | (length[:, None] == 0.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    disk = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = [r * d for r in (1.0, 0.5) for d in disk] if kind == "thinlens" else [np.zeros(2)]
    seen = np.zeros(outside.shape, bool)
    squared = []
    for point in points:
        film, between = pixels(kind, x, RADIUS * point)
        inside = (film > -margin).all(-1) & (film[..., 0] < 12 + margin) & (film[..., 1] < 8 + margin) & between
        seen |= inside
        ends_seen = np.stack([ends[:, 0] * (1.0 - q)[:, None] + ends[:, 1] * q[:, None] for q in (low, high)], axis=1)
        image = pixels(kind, ends_seen, RADIUS * point)[0]
        squared.append(((image[:, 1] - image[:, 0]) ** 2).sum(axis=-1))
    assert seen.sum() > 1000
    assert not (seen & outside).any()
    if kind != "thinlens":
        # Nothing more than that is sampled either.
        assert (~outside & ~seen).sum() <= 2 * (length > 0.0).sum()
        expected = np.sqrt(squared[0])
    else:
        # Rings of radius 1 and 1/2 in the shares 1/3 and 2/3 have the disk's mean square, 1/2.
        rings = np.array(squared).reshape(2, len(disk), -1).mean(axis=1)
        expected = np.sqrt(rings[0] / 3.0 + 2.0 * rings[1] / 3.0)
    np.testing.assert_allclose(length[length > 0.0], expected[length > 0.0], rtol=1e-5)


@pytest.mark.parametrize("border", [True, False], ids=["sampled border", "border"])
@pytest.mark.parametrize("kind", ["perspective", "thinlens"])
@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_edges_through_a_distorting_lens_are_clipped_by_what_it_shows(model, kind, border):
    """Edges through points of random rays are kept there: they are lines where the lens has not yet bent them."""
    lens = {"distortion": model, "k1": -0.2 if model == "opencv" else 0.1, "k2": 0.05, "pixel_aspect": 1.2, "skew": 0.1}
    sensor = {"type": kind, "film": FILM | {"sample_border": border}, **CLIPS, **SENSORS[kind], **lens, "fov": 70.0}
    scene = psdr.load_dict({"type": "scene", "sensor": sensor, "sky": {"type": "constant"}})
    random, margin = np.random.default_rng(5), MARGIN if border else 0.0
    film = random.uniform([5.0 - margin, 2.0 - margin], [17.0 + margin, 10.0 + margin], (2000, 2))
    k = np.tan(np.radians(35.0))
    numbers = np.array([1.2, 0.1, lens["k1"], lens["k2"], *np.zeros(6)])
    y = np.stack([(1.0 - film[:, 0] / 10.0) * k, (1.0 - film[:, 1] / 6.0) * k * 12.0 / 20.0], axis=1)
    x = undistort(model, numbers, y)
    np.testing.assert_allclose(distort(model, numbers, x), y, atol=1e-9)
    angle = random.uniform(0.0, 2.0 * np.pi, 2000)
    disk = (RADIUS if kind == "thinlens" else 0.0) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    z = random.uniform(CLIPS["near_clip"] + 0.01, CLIPS["far_clip"] - 0.01, 2000)[:, None]
    local = np.concatenate([disk + (x - disk / FOCUS) * z, z], axis=1)
    along, at = random.normal(size=(2000, 3)), random.uniform(0.1, 0.9, 2000)
    ends = np.stack([local - at[:, None] * along, local + (1.0 - at)[:, None] * along], axis=1)
    pose = POSE.matrix
    low, high, length = camera_view(scene, 0).clip(ends @ pose[:3, :3].T + pose[:3, 3])
    # Only what is in front of the clip plane counts; the point itself is.
    assert ((low <= at) & (at <= high) & (length > 0.0)).all()
    # And the box is no larger than it has to be: beside the film nothing is kept.
    view = camera_view(scene, 0)
    room = (view.bounds[1] - view.bounds[0]) / np.ptp(view.center - view.scale * x, axis=0)
    assert (room < 1.15).all()


@pytest.mark.parametrize("kind", SENSORS)
def test_every_silhouette_of_a_smooth_shape_is_kept(kind):
    scene = load(kind, shape=ball((0.1, 0.0, -0.5), 0.5, diffuse(0.5), subdivisions=2, smooth=True))
    edges, view = scene_adjacency(scene), camera_view(scene, 0)
    points = scene.points
    corners = points[scene.builder.indices].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    first = edges.faces[edges.first[:-1]]
    second = edges.faces[edges.first[:-1] + 1]
    kept = primary_edges(scene, film_edges(scene, 0, {0}, camera_moves=False))
    numbers = {tuple(sorted(e)) for e in kept.ends.numpy().tolist()}
    silhouettes = set()
    for angle in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False):
        shift = view.radius * (view.pose[:3, 0] * np.cos(angle) + view.pose[:3, 1] * np.sin(angle))
        facing = (normal * (view.towards(corners[:, 0]) + shift)).sum(axis=1)
        silhouettes |= {tuple(sorted(e)) for e in edges.ends[facing[first] * facing[second] < 0.0].tolist()}
    assert silhouettes <= numbers
    # And few others, though more than the outline through a wide lens.
    assert 0 < len(numbers) < (0.6 if kind == "thinlens" else 0.15) * len(edges.length)
    if kind != "thinlens":
        assert silhouettes == numbers


def test_edges_are_clipped_one_by_one():
    # In pieces, that is: whatever their number, and also of none.
    view = camera_view(load("thinlens"), 0)
    ends = np.random.default_rng(4).uniform([-3, -3, -6], [3, 3, 4], (10_000, 2, 3))
    whole = view.clip(ends)
    assert (whole[2] > 0.0).any() and not (whole[2] > 0.0).all()
    some = [0, 4095, 4096, 8191, 8192, 9999]
    for found, expected in zip(view.clip(ends[some]), whole, strict=True):
        np.testing.assert_allclose(found, expected[some], rtol=1e-12)
    assert [len(part) for part in view.clip(ends[:0])] == [0, 0, 0]
