"""Sensors from OpenCV's numbers, COLMAP's and nerfstudio's files: where points lie on the photograph, and bad input."""

import json
import struct

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.kernels.sensor.projection import make_projection
from warp_psdr.kernels.structs import Camera, Scene

SIZE = (64, 48)
FX, FY, CX, CY, SKEW = 70.0, 77.0, 33.3, 22.1, 2.5
K = np.array([[FX, SKEW, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]])
TURN, SHIFT = np.array([0.2, -0.3, 2.9]), np.array([0.1, 0.2, 3.0])
DIST = (-0.2, 0.05, 0.01, -0.02, 0.01)
#: What float32 leaves of a position, pixels.
ROUNDING = 1e-3
POINTS = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 3))


def rotation(vector):
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


R = rotation(TURN)
#: (w, x, y, z) of R.
QUATERNION = np.array(
    [np.cos(0.5 * np.linalg.norm(TURN)), *(np.sin(0.5 * np.linalg.norm(TURN)) * TURN / np.linalg.norm(TURN))]
)


def pixels(sensor):
    """Positions of ``POINTS`` on the film, pixels from its corner, and which are seen."""
    scene = psdr.load_dict({"type": "scene", "sensor": sensor, "sky": {"type": "constant"}})
    camera = scene.camera(0)
    project = make_projection(camera.kind)[0]

    @wp.kernel(module="unique", enable_backward=False)
    def positions(scene: Scene, camera: Camera, x: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.vec3)):
        at = project(scene, camera, x[wp.tid()], wp.vec2(0.0, 0.0))
        out[wp.tid()] = wp.vec3(at.pixel[0], at.pixel[1], wp.float32(at.valid))

    out = wp.zeros(len(POINTS), dtype=wp.vec3, device="cpu")
    points = wp.array((POINTS - scene.origin).astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(positions, len(POINTS), inputs=[scene.data(), camera, points], outputs=[out], device="cpu")
    found = out.numpy().astype(np.float64)
    inside = (found[:, :2] > 0.0).all(axis=1) & (found[:, :2] < SIZE).all(axis=1)
    assert inside.sum() > 20
    np.testing.assert_array_equal(found[:, 2], inside)
    return found[:, :2]


def expected(focal=(FX, FY), center=(CX, CY), skew=0.0, dist=(), fisheye=False):
    """The pinhole's formulas with OpenCV's axes: pixels in the same count as ``center``."""
    x, y, z = R @ POINTS.T + SHIFT[:, None]
    x, y = x / z, y / z
    k = [*dist, *[0.0] * (8 - len(dist))]
    r2 = x * x + y * y
    if fisheye:
        t = np.arctan(np.sqrt(r2))
        factor = (t + k[0] * t**3 + k[1] * t**5 + k[2] * t**7 + k[3] * t**9) / np.sqrt(r2)
        x, y = x * factor, y * factor
    else:
        factor = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
        x, y = (
            x * factor + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            y * factor + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y,
        )
    return np.stack([focal[0] * x + skew * y + center[0], focal[1] * y + center[1]], axis=1)


@pytest.mark.parametrize("name", ["pinhole", "skewed", "distorted"])
def test_opencvs_cameras(name):
    """Pixel centres are whole numbers there, and lie half a pixel from the corner here."""
    k = np.array([[FX, 0.0, CX], [0.0, FX, CY], [0.0, 0.0, 1.0]]) if name == "pinhole" else K
    dist = DIST if name == "distorted" else None
    found = pixels(psdr.cameras.from_opencv(k, R, SHIFT, SIZE, dist))
    skew = 0.0 if name == "pinhole" else SKEW
    formulas = expected((FX, k[1, 1]), skew=skew, dist=dist or ())
    np.testing.assert_allclose(found, formulas + 0.5, atol=ROUNDING)


def test_they_are_cv2s():
    cv2 = pytest.importorskip("cv2")
    k = np.array([[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]])
    found = pixels(psdr.cameras.from_opencv(k, TURN, SHIFT[:, None], SIZE, np.array([DIST])))
    theirs = cv2.projectPoints(POINTS, TURN, SHIFT, k, np.array(DIST))[0][:, 0]
    np.testing.assert_allclose(found, theirs + 0.5, atol=ROUNDING)
    found = pixels(psdr.cameras.from_opencv(k, TURN, SHIFT, SIZE, DIST[:4], fisheye=True))
    theirs = cv2.fisheye.projectPoints(POINTS[:, None], TURN, SHIFT, k, np.array(DIST[:4]))[0][:, 0]
    np.testing.assert_allclose(found, theirs + 0.5, atol=ROUNDING)


def test_no_distortion_is_a_pinhole_and_zeros_are_parameters():
    k = np.array([[FX, 0.0, CX], [0.0, FX, CY], [0.0, 0.0, 1.0]])
    plain = psdr.cameras.from_opencv(k, R, SHIFT, SIZE)
    assert not {"distortion", "pixel_aspect", "skew", "k1"} & set(plain)
    zeros = psdr.cameras.from_opencv(k, R, SHIFT, SIZE, np.zeros(14))
    assert zeros["distortion"] == "opencv" and zeros["k6"] == 0.0
    scene = psdr.load_dict({"type": "scene", "sensor": zeros, "sky": {"type": "constant"}})
    assert {"sensor.k1", "sensor.p2", "sensor.skew", "sensor.pixel_aspect"} <= set(psdr.traverse(scene))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": np.eye(4)}, r"K has the shape \(4, 4\)"),
        ({"K": K.T}, "expected .*fx, skew, cx"),
        ({"K": np.diag([-1.0, 1.0, 1.0])}, "expected .*fx, skew, cx"),
        ({"R": 2.0 * np.eye(3)}, "R is no rotation"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "R is no rotation"),
        ({"t": [0.0, 1.0]}, "t has the shape"),
        ({"t": [0.0, 1.0, np.nan]}, "finite"),
        ({"size": (64.5, 48)}, "size"),
        ({"size": (0, 48)}, "size"),
        ({"dist": [0.1, 0.2, 0.3]}, "dist has 3 numbers, expected 4, 5, 8"),
        ({"dist": np.full(14, 0.01)}, "thin prisms"),
        ({"dist": DIST, "fisheye": True}, "dist has 5 numbers, expected 4"),
    ],
)
def test_wrong_numbers_are_refused(change, message):
    given = {"K": K, "R": R, "t": SHIFT, "size": SIZE} | change
    with pytest.raises(ValueError, match=message):
        psdr.cameras.from_opencv(**given)


#: COLMAP's model, its number, its parameters, and those of ``expected``.
MODELS = [
    ("SIMPLE_PINHOLE", 0, (FX, CX, CY), {"focal": (FX, FX)}),
    ("PINHOLE", 1, (FX, FY, CX, CY), {}),
    ("SIMPLE_RADIAL", 2, (FX, CX, CY, -0.1), {"focal": (FX, FX), "dist": (-0.1,)}),
    ("RADIAL", 3, (FX, CX, CY, -0.1, 0.02), {"focal": (FX, FX), "dist": (-0.1, 0.02)}),
    ("OPENCV", 4, (FX, FY, CX, CY, *DIST[:4]), {"dist": DIST[:4]}),
    ("OPENCV_FISHEYE", 5, (FX, FY, CX, CY, 0.1, -0.02, 0.01, 0.0), {"dist": (0.1, -0.02, 0.01, 0.0), "fisheye": True}),
    ("FULL_OPENCV", 6, (FX, FY, CX, CY, *DIST, 0.01, 0.02, 0.03), {"dist": (*DIST, 0.01, 0.02, 0.03)}),
    ("SIMPLE_RADIAL_FISHEYE", 8, (FX, CX, CY, 0.1), {"focal": (FX, FX), "dist": (0.1,), "fisheye": True}),
    ("RADIAL_FISHEYE", 9, (FX, CX, CY, 0.1, 0.02), {"focal": (FX, FX), "dist": (0.1, 0.02), "fisheye": True}),
]


def write_text(folder, model, parameters, names=("b.png", "a 1.png")):
    numbers = " ".join(map(repr, map(float, parameters)))
    (folder / "cameras.txt").write_text(f"# list\n7 {model} {SIZE[0]} {SIZE[1]} {numbers}\n")
    pose = " ".join(map(repr, map(float, (*QUATERNION, *SHIFT))))
    # The second photograph has no points: its line is empty.
    lines = [f"1 {pose} 7 {names[0]}", "10.5 20.5 -1 3.0 4.0 12", f"2 {pose} 7 {names[1]}", ""]
    (folder / "images.txt").write_text("# list\n" + "\n".join(lines) + "\n")


def write_binary(folder, number, parameters, names=("b.png", "a 1.png")):
    data = struct.pack("<QiiQQ", 1, 7, number, *SIZE) + struct.pack(f"<{len(parameters)}d", *parameters)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(names))
    for i, name in enumerate(names):
        data += struct.pack("<i7di", i + 1, *QUATERNION, *SHIFT, 7) + name.encode() + b"\0"
        data += struct.pack("<Q", 2 - i) + struct.pack("<ddq", 1.0, 2.0, -1) * (2 - i)
    (folder / "images.bin").write_bytes(data)


@pytest.mark.parametrize(("model", "number", "parameters", "numbers"), MODELS, ids=[m[0] for m in MODELS])
def test_colmaps_models(tmp_path, model, number, parameters, numbers):
    """Its principal point counts from the image's corner. Text and binary files tell the same."""
    write_text(tmp_path, model, parameters)
    text = psdr.cameras.from_colmap(tmp_path)
    write_binary(tmp_path, number, parameters)
    binary = psdr.cameras.from_colmap(tmp_path)
    assert list(text) == list(binary) == ["a 1.png", "b.png"]
    for name, sensor in text.items():
        assert sensor.keys() == binary[name].keys()
        np.testing.assert_array_equal(sensor["to_world"], binary[name]["to_world"])
        assert {k: v for k, v in sensor.items() if k != "to_world"} == {
            k: v for k, v in binary[name].items() if k != "to_world"
        }
    np.testing.assert_allclose(pixels(binary["b.png"]), expected(**numbers), atol=ROUNDING)


def test_colmaps_files_that_cannot_be_read_say_why(tmp_path):
    with pytest.raises(FileNotFoundError, match="sparse/0"):
        psdr.cameras.from_colmap(tmp_path)
    write_text(tmp_path, "FOV", (FX, FY, CX, CY, 0.5))
    with pytest.raises(ValueError, match=r"FOV is not supported.*undistort.*SIMPLE_RADIAL"):
        psdr.cameras.from_colmap(tmp_path)
    write_text(tmp_path, "PINHOLE", (FX, CX, CY))
    with pytest.raises(ValueError, match="PINHOLE with 3 parameters; expected 4"):
        psdr.cameras.from_colmap(tmp_path)
    write_text(tmp_path, "PINHOLE", (FX, FY, CX, CY))
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 8 a.png\n\n")
    with pytest.raises(ValueError, match="camera 8 is not in"):
        psdr.cameras.from_colmap(tmp_path)
    for line in ("1 1 0 0", "1 1 0 0 0 0 0 zero 7 a.png"):
        (tmp_path / "images.txt").write_text(f"{line}\n\n")
        with pytest.raises(ValueError, match=rf"images\.txt: got the line '{line}'; expected"):
            psdr.cameras.from_colmap(tmp_path)
    write_binary(tmp_path, 10, (FX, FY, CX, CY))
    with pytest.raises(ValueError, match="number 10 is not supported"):
        psdr.cameras.from_colmap(tmp_path)
    write_binary(tmp_path, 1, (FX, FY, CX, CY))
    whole = (tmp_path / "images.bin").read_bytes()
    for count in (4, 40, 70, 90):
        (tmp_path / "images.bin").write_bytes(whole[:count])
        with pytest.raises(ValueError, match="ends too early"):
            psdr.cameras.from_colmap(tmp_path)


def transforms(**more):
    """A file whose camera is that of ``expected``: OpenGL's axes."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.T @ np.diag([1.0, -1.0, -1.0]), -R.T @ SHIFT
    told = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": SIZE[0], "h": SIZE[1]}
    return {**told, "frames": [{"file_path": "images/1.png", "transform_matrix": pose.tolist()}], **more}


@pytest.mark.parametrize(
    ("more", "numbers"),
    [
        ({"camera_model": "OPENCV", "k1": -0.2, "k2": 0.05, "p1": 0.01, "p2": -0.02}, {"dist": DIST[:4]}),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": -0.02}, {"dist": (0.1, -0.02), "fisheye": True}),
        ({"camera_model": "PINHOLE", "fl_y": FX}, {"focal": (FX, FX)}),
    ],
)
def test_nerfstudios_files(tmp_path, more, numbers):
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(**more)))
    sensors = psdr.cameras.from_nerfstudio(tmp_path)
    assert list(sensors) == ["images/1.png"]
    np.testing.assert_allclose(pixels(sensors["images/1.png"]), expected(**numbers), atol=ROUNDING)


def test_files_of_synthetic_scenes(tmp_path):
    """An angle alone: the size is that of the photographs, and numbers of a frame come before the file's."""
    told = transforms()
    file = tmp_path / "transforms_train.json"
    angle = 2.0 * np.arctan(0.5 * SIZE[0] / FX)
    frame = {**told["frames"][0], "camera_angle_x": angle}
    file.write_text(json.dumps({"camera_angle_x": 1.0, "frames": [frame]}))
    with pytest.raises(ValueError, match="from_nerfstudio\\(path, size\\)"):
        psdr.cameras.from_nerfstudio(file)
    sensor = psdr.cameras.from_nerfstudio(file, SIZE)["images/1.png"]
    assert "distortion" not in sensor
    middle = (0.5 * SIZE[0], 0.5 * SIZE[1])
    np.testing.assert_allclose(pixels(sensor), expected((FX, FX), middle), atol=ROUNDING)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR is not supported.*OPENCV_FISHEYE"),
        ({"k4": 0.1}, "k4"),
        ({"fl_x": None}, "not a transforms.json"),
        ({"frames": [{}]}, "not a transforms.json"),
        ({"frames": None}, "not a transforms.json"),
    ],
)
def test_nerfstudios_files_that_cannot_be_read_say_why(tmp_path, change, message):
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(**change)))
    with pytest.raises(ValueError, match=message):
        psdr.cameras.from_nerfstudio(tmp_path)
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(ValueError, match=r"not a transforms.json"):
        psdr.cameras.from_nerfstudio(tmp_path)
