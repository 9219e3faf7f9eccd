"""The configuration of a fit: what is read, from where paths start, and that every mistake is named."""

import json
from pathlib import Path

import pytest

from warp_psdr.fit.config import FitConfig, Unknown

GOOD = {
    "scene": "scene.xml",
    "targets": ["a.exr", "b.exr"],
    "output": "out",
    "parameters": {"wall.reflectance.value": {"lr": 0.1}},
}

TOML = """
scene = "scene.xml"
targets = ["a.exr", "/data/b.exr"]
output = "out"
iterations = 7
views_per_step = 1
lr_half_life = 50

[parameters."wall.reflectance.data"]
lr = 1
initial = [0.5, 0.5, 0.25]

[parameters."sky.data"]
lr = 0.1
initial = "sky.exr"

[integrator]
max_depth = 4
boundary = "none"

[defaults]
resolution = 64
"""


def test_toml_is_read_and_paths_start_at_its_folder(tmp_path: Path) -> None:
    (tmp_path / "fit.toml").write_text(TOML)
    config = FitConfig.from_file(tmp_path / "fit.toml")
    assert config.scene == tmp_path / "scene.xml"
    assert config.targets == (tmp_path / "a.exr", Path("/data/b.exr"))
    assert config.output == tmp_path / "out"
    assert config.parameters == {
        "wall.reflectance.data": Unknown(lr=1.0, initial=(0.5, 0.5, 0.25)),
        "sky.data": Unknown(lr=0.1, initial=tmp_path / "sky.exr"),
    }
    assert (config.iterations, config.views_per_step, config.lr_half_life) == (7, 1, 50.0)
    assert config.integrator == {"max_depth": 4, "boundary": "none"}
    assert config.defaults == {"resolution": 64}
    assert config.views == (0, 1)


def test_json_says_the_same(tmp_path: Path) -> None:
    (tmp_path / "fit.json").write_text(json.dumps(GOOD))
    assert FitConfig.from_file(tmp_path / "fit.json") == FitConfig.from_mapping(GOOD, folder=tmp_path)


def test_only_what_changes_the_bits_of_a_step_is_in_the_fingerprint() -> None:
    first = FitConfig.from_mapping(GOOD)
    same = FitConfig.from_mapping({**GOOD, "iterations": 9, "output": "elsewhere", "checkpoint_every": 1})
    assert same.fingerprint() == first.fingerprint()
    for change in (
        {"seed": 1},
        {"spp": 3},
        {"spp_grad": 3},
        {"loss": "l1"},
        {"views_per_step": 1},
        {"sensors": [1, 0]},
        {"lr_half_life": 3},
        {"mask_updates": True},
        {"betas": [0.9, 0.99]},
        {"integrator": {"max_depth": 2}},
        {"defaults": {"a": 1}},
        {"parameters": {"wall.reflectance.value": {"lr": 0.2}}},
    ):
        assert FitConfig.from_mapping({**GOOD, **change}).fingerprint() != first.fingerprint(), change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"itertions": 3}, "unknown field 'itertions'.*did you mean 'iterations'"),
        ({"iterations": 0}, "iterations: got 0, expected at least 1"),
        ({"iterations": 1.5}, "iterations: got 1.5, expected a whole number"),
        ({"iterations": True}, "iterations: got True, expected a whole number"),
        ({"spp": -1}, "spp: got -1"),
        ({"spp_grad": 0}, "spp_grad: got 0"),
        ({"final_spp": "many"}, "final_spp: got 'many'"),
        ({"checkpoint_every": 0}, "checkpoint_every: got 0"),
        ({"seed": -1}, "seed: got -1"),
        ({"seed": 2**32}, "seed: got 4294967296, expected at most"),
        ({"views_per_step": 3}, "views_per_step: got 3, expected at most the 2 views"),
        ({"views_per_step": 0}, "views_per_step: got 0"),
        ({"loss": "l3"}, "loss: got 'l3', expected one of l2, l1"),
        ({"lr_half_life": 0}, "lr_half_life: got 0, expected a positive"),
        ({"lr_half_life": float("nan")}, "lr_half_life: got nan, expected a finite"),
        ({"mask_updates": 1}, "mask_updates: got 1, expected true or false"),
        ({"betas": 0.9}, "betas: got 0.9, expected a list"),
        ({"betas": [0.9]}, r"betas: got \[0.9\], expected two numbers"),
        ({"betas": [0.9, 1.0]}, r"betas: got \[0.9, 1.0\], expected two numbers in \[0, 1\)"),
        ({"betas": ["a", 0.9]}, r"betas\[0\]: got 'a'"),
        ({"device": 0}, "device: got 0"),
        ({"scene": 3}, "scene: got 3, expected the name of a file"),
        ({"scene": ""}, "scene: got ''"),
        ({"output": None}, "output: got None"),
        ({"targets": "a.exr"}, "targets: got 'a.exr', expected a list"),
        ({"targets": []}, "targets: got none"),
        ({"targets": [1]}, r"targets\[0\]: got 1"),
        ({"sensors": [0]}, "sensors: got 1 for 2 targets"),
        ({"sensors": [0, -1]}, r"sensors\[1\]: got -1"),
        ({"parameters": {}}, "parameters: got none"),
        ({"parameters": ["a"]}, "parameters: got"),
        ({"parameters": {"a": 0.1}}, "parameters.'a': got 0.1, expected a table"),
        ({"parameters": {"a": {}}}, "parameters.'a': lr missing"),
        ({"parameters": {"a": {"lr": 0}}}, "parameters.'a'.lr: got 0, expected a positive"),
        ({"parameters": {"a": {"lr": "fast"}}}, "parameters.'a'.lr: got 'fast'"),
        ({"parameters": {"a": {"lr": 1, "start": 0}}}, "parameters.'a': unknown field 'start'"),
        ({"parameters": {"a": {"lr": 1, "initial": [1, "b"]}}}, r"parameters.'a'.initial\[1\]: got 'b'"),
        ({"parameters": {"a": {"lr": 1, "initial": float("inf")}}}, "parameters.'a'.initial: got inf"),
        ({"parameters": {"a": {"lr": 1, "initial": ""}}}, "parameters.'a'.initial: got ''"),
        ({"integrator": 4}, "integrator: got 4, expected a table"),
        ({"integrator": {"depth": 4}}, "integrator: unknown field 'depth'"),
        ({"integrator": {"max_depth": 0}}, "integrator: max_depth: got 0"),
        ({"integrator": {"boundary": "never"}}, "integrator: boundary: got 'never'"),
        ({"defaults": {"a": [1]}}, r"defaults.a: got \[1\]"),
        ({"defaults": 1}, "defaults: got 1, expected a table"),
    ],
)
def test_every_mistake_is_named(change: dict, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=f"fit config: {message}"):
        FitConfig.from_mapping({**GOOD, **change})


@pytest.mark.parametrize("field", ["scene", "targets", "output", "parameters"])
def test_what_is_missing_is_named(field: str) -> None:
    with pytest.raises(ValueError, match=f"fit config: {field} missing"):
        FitConfig.from_mapping({name: value for name, value in GOOD.items() if name != field})


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        ("none.toml", None, FileNotFoundError, "none.toml does not exist"),
        ("fit.yaml", "a: 1", ValueError, "got suffix '.yaml'"),
        ("fit.toml", "scene = ", ValueError, "malformed"),
        ("fit.json", '{"scene": ', ValueError, "malformed"),
        ("deep.json", "[" * 100_000, ValueError, "malformed"),
        ("fit.toml", b"\xff\xfe", ValueError, "malformed"),
        ("list.json", "[1, 2]", TypeError, "got list, expected a table"),
    ],
)
def test_malformed_files_are_refused(tmp_path: Path, name: str, content, error, message: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(error, match=message):
        FitConfig.from_file(tmp_path / name)
