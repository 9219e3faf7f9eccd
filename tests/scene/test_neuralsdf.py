"""Networks of signed distances: what loads, what is refused, and how they follow edits."""

import io
import tracemalloc
import zipfile
from collections.abc import Callable

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import fitted, neck
from tests.stability import corpus
from warp_psdr.options import boundary, interior
from warp_psdr.scene import describe_dict

from .test_sdfgrid import FLAT, TILES, T

NET = fitted(widths=(12, 16))
W0, W1 = NET.layers[0][0], NET.layers[1][0]


def described(without: str = "", **properties) -> dict:
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "to_world": T.look_at([0.5, -2, 0.5], [0.5, 0, 0.5], [0, 0, 1]), "film": film}
    body = {**NET.plugin(cells=16), **properties}
    if "filename" in properties or without == "layer":
        body = {key: value for key, value in body.items() if not key.startswith("layer")}
    body = {key: value for key, value in body.items() if key != without}
    path = {"type": "path", "max_depth": 1}  # what is seen before the sky; other tests compile what it scatters
    return {"type": "scene", "integrator": path, "sensor": sensor, "sky": {"type": "constant"}, "body": body}


def spoiled(value: float) -> np.ndarray:
    values = W1.copy()
    values[1, 2] = value
    return values


@pytest.mark.parametrize(
    ("properties", "problem"),
    [
        ({"without": "layer"}, "got 0 layers; give layer0.weight"),
        ({"without": "layer1.bias"}, "'layer1.bias' is missing"),
        ({"layer1.weight": W1[:, :5]}, r"got the shape \(16, 5\), and layer0 make 12 numbers; give \(out, 12\)"),
        ({"layer0.weight": W0[:, :2]}, r"x, y, z and the sines and cosines of 'frequencies' make 3 numbers"),
        ({"frequencies": 2}, r"make 15 numbers; give \(out, 15\)"),
        ({"frequencies": 11}, "frequencies"),
        ({"layer1.weight": W1[0]}, r"got the shape \(12,\); give weights \(out, in\)"),
        ({"layer1.bias": np.zeros(3)}, r"got the shape \(3,\); give \(16,\)"),
        ({"layer2.weight": np.zeros((2, 16)), "layer2.bias": np.zeros(2)}, "the last layer makes 2 numbers; give one"),
        ({"layer0.weight": "much"}, "got no array of numbers"),
        ({"layer1.weight": spoiled(np.nan)}, "1 of 192 values are not finite"),
        ({"layer1.weight": spoiled(np.inf)}, "1 of 192 values are not finite"),
        ({"layer1.weight": spoiled(1e30)}, r"a value of 1e\+30; give 1e\+15 at most"),
        ({"layer1.weight": 1e9 * W1, "layer0.weight": 1e9 * W0}, "its weights overflow"),
        ({"layer0.weight": np.zeros((129, 3)), "layer0.bias": np.zeros(129)}, "a layer of 129 numbers; give 1 to 128"),
        ({"activation": "relu"}, "got 'relu', whose kinks are creases.*give one of: softplus, sine"),
        ({"activation": "tangent"}, "got 'tangent'; give one of: softplus, sine"),
        ({"omega": 3.0}, "'omega' beside the activation 'softplus'"),
        ({"beta": -1.0}, "beta"),
        ({"cells": 20}, "got 20; give one of: 16, 32, 64, 128"),
        ({"face_normals": True}, "its normals are smooth"),
        ({"to_world": FLAT}, "singular|no inverse"),
        ({"emitter": {"type": "area"}}, "an emitter on a 'neuralsdf'.*'sdfgrid'"),
        ({"sensor": {"type": "irradiancemeter"}}, "a sensor on a 'neuralsdf'"),
        ({"interior": {"type": "homogeneous"}, "bsdf": {"type": "null"}}, "a medium on a 'neuralsdf'"),
        ({"bsdf": {"type": "diffuse", "reflectance": TILES}}, "'bitmap' for 'reflectance'.*no texture coordinates"),
    ],
)
def test_what_it_does_not_do_is_refused(properties: dict, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        psdr.load_dict(described(**properties))


def test_files(tmp_path) -> None:
    arrays = {k: v for k, v in NET.plugin().items() if k.startswith("layer")}
    np.savez(tmp_path / "net.npz", **arrays)
    held = psdr.load_dict(described(filename=str(tmp_path / "net.npz")))
    np.testing.assert_array_equal(psdr.traverse(held)["body.layer1.weight"].numpy(), W1.astype(np.float32))
    (tmp_path / "bad.npz").write_bytes(b"PK no archive")
    np.savez(tmp_path / "other.npz", **arrays, extra=np.ones(3))
    for name, problem in (("bad.npz", "is no .npz file that can be read"), ("other.npz", "holds 'extra'")):
        with pytest.raises(ValueError, match=problem):
            psdr.load_dict(described(filename=str(tmp_path / name)))
    both = described(filename=str(tmp_path / "net.npz"))
    both["body"]["layer0.bias"] = arrays["layer0.bias"]
    with pytest.raises(ValueError, match=r"got filename and layer0.bias"):
        psdr.load_dict(both)


def header(shape: str) -> bytes:
    """Return the start of an array's file that declares a shape, with hardly anything behind it."""
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + b"\0" * 64


def packed(packing: int, *entries: bytes, declared: int = -1) -> bytes:
    """Return an archive; ``declared``: size of its first entry by its own account."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", packing) as archive:
        for number, data in enumerate(entries):
            archive.writestr(f"layer{number}.weight.npy", data)
    data = bytearray(stream.getvalue())
    if declared >= 0:
        at = data.rindex(b"PK\x01\x02") + 24
        data[at : at + 4] = declared.to_bytes(4, "little")
    return bytes(data)


WHOLE = corpus.network(np.savez)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"PK\3\4" + b"x" * 99, "not a zip file"),
        (WHOLE[:-40], "not a zip file"),
        (WHOLE.replace(b"NUMPY", b"numpy", 1), "Bad CRC-32"),
        (corpus.network(np.savez_compressed).replace(b"\xda", b"\xdb"), "."),
        (packed(zipfile.ZIP_STORED, header("(2147483648, 3)")), r"of shape \(2147483648, 3\) is longer or shorter"),
        (packed(zipfile.ZIP_STORED, header("(3, (((")), "."),
        (packed(zipfile.ZIP_STORED, header("(3,), 'x': 0")), "."),
        (
            lambda: packed(zipfile.ZIP_DEFLATED, *3 * (bytes(1 << 25),)),
            "its arrays take 100663296 bytes, and at most 67108864",
        ),
        (lambda: packed(zipfile.ZIP_DEFLATED, bytes(1 << 25), declared=99), "."),
        (lambda: packed(zipfile.ZIP_BZIP2, bytes(99)), "packed otherwise than by numpy.savez"),
    ],
)
def test_damaged_files_and_such_as_unpack_to_too_much(
    content: bytes | Callable[[], bytes], problem: str, tmp_path
) -> None:
    (tmp_path / "net.npz").write_bytes(content() if callable(content) else content)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=rf"'net.npz' is no .npz file that can be read \(.*{problem}.*\)"):
            describe_dict(described(filename="net.npz"), base=tmp_path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 24  # of 96 MB and 24 GB
    finally:
        tracemalloc.stop()


def test_it_is_refused_in_groups() -> None:
    whole = described()
    whole["group"] = {"type": "shapegroup", "body": whole.pop("body")}
    whole["copy"] = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    with pytest.raises(ValueError, match="a 'neuralsdf' inside a 'shapegroup'"):
        psdr.load_dict(whole)


def test_one_sign_is_empty_and_noted() -> None:
    with pytest.warns(psdr.SceneWarning, match="phi has one sign in the box"):
        held = psdr.load_dict(described(**{"layer2.bias": np.array([9.0])}))
    assert psdr.render(held, spp=4).numpy() == pytest.approx(1.0)


def test_parameters_plan_and_updates() -> None:
    held = psdr.load_dict(described())
    params = psdr.traverse(held)
    names = [name for name in params if name.startswith("body.") and "bsdf" not in name]
    assert names == ["body.to_world", *(f"body.layer{n}.{what}" for n in range(3) for what in ("weight", "bias"))]
    with pytest.raises(KeyError, match=r"its parameters are 'body.layer0.weight' and 'body.to_world'"):
        params["body.vertex_positions"]
    said = str(psdr.plan(held))
    assert "network body" in said and "3 - 12 - 16 - 1" in said and "softplus, beta 10" in said

    def image() -> np.ndarray:
        return psdr.render(held, spp=16, seed=3).numpy()

    # New weights, and a new pose, render as if they had been loaded.
    other = fitted(neck, widths=(12, 16))
    changed = {key: value for key, value in other.plugin().items() if key.startswith("layer")}
    turned = T.translate([0.3, 0.0, 0.0]).scale(0.7)
    for more in (changed, {**changed, "to_world": turned}):
        before = image()
        for name, value in more.items():
            params[f"body.{name}"] = value.matrix if name == "to_world" else value
        params.update()
        assert (image() != before).any()
        fresh = psdr.render(psdr.load_dict(described(**more)), spp=16, seed=3).numpy()
        np.testing.assert_allclose(image(), fresh, atol=1e-5)
    params["body.layer1.weight"].assign(spoiled(np.nan))
    with pytest.raises(ValueError, match=r"body.layer1.weight is nan in 1 of 192 places after an edit"):
        params.update()
    params["body.layer1.weight"] = 1e12 * W1
    with pytest.raises(ValueError, match="body: its weights overflow"):
        params.update()


@pytest.mark.parametrize("name", ["body.layer1.weight", "body.to_world", "sensor.to_world"])
def test_what_moves_beside_it(name: str) -> None:
    held = psdr.load_dict(described())
    for form in (boundary.Projective(), boundary.EdgeSampling()):
        with pytest.raises(ValueError, match=r"does not know 'body', a 'neuralsdf'; .*'sdfgrid'.*boundary=None"):
            psdr.plan(held, integrator=psdr.PathIntegrator(boundary=form), names=[name])
    psdr.plan(held, integrator=psdr.PathIntegrator(boundary=None), names=[name])
    for method in (interior.Textbook(), interior.Radiative(), interior.LightTracing()):
        with pytest.raises(ValueError, match=r"use interior.Replay\(\)"):
            psdr.plan(held, integrator=psdr.PathIntegrator(boundary=None, interior=method), names=[name])


@pytest.mark.parametrize("form", [boundary.SignedDistance(), boundary.NeuralSignedDistance()])
def test_rays_that_move_refuse_what_may_reach_its_box(form: boundary.Method) -> None:
    held = psdr.load_dict(described())
    with pytest.raises(ValueError, match="the surface of 'body' may reach the border of its box: say more 'cells'"):
        psdr.plan(held, integrator=psdr.PathIntegrator(max_depth=2, boundary=form), names=["body.layer1.weight"])
