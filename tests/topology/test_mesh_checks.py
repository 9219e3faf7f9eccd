"""Steps that ruin parameters are found, with their number and the parameter's name, and nothing good is lost."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.fit.scenes import write_fit
from warp_psdr import optim
from warp_psdr.fit import checkpoint
from warp_psdr.fit.run import CHECKPOINT, FitConfig, fit
from warp_psdr.topology.mesh_checks import MeshError, MeshWatch, normals

NAME, COLOR = "ball.vertex_positions", "ball.bsdf.reflectance.value"


def load():
    scene = psdr.load_dict({
        "type": "scene",
        "camera": {"type": "perspective", "to_world": psdr.Transform.look_at((0, 0, 4), (0, 0, 0))},
        "ball": {"type": "sphere", "resolution": 16, "bsdf": {"type": "diffuse"}},
        "sky": {"type": "constant"},
    })  # fmt: skip
    params = psdr.traverse(scene)
    params.requires_grad(NAME, COLOR)
    return params


def nan(values: np.ndarray) -> np.ndarray:
    values[7, 1] = np.nan
    return values


def flat(values: np.ndarray) -> np.ndarray:
    values[:, 2] = 0.0
    values[:, 1] = values[:, 0]
    return values


RUINS = {
    "not finite": nan,
    "collapsed": flat,
    "flipped": lambda values: values * np.float32([-1.0, 1.0, 1.0]),
}


@pytest.mark.parametrize("kind", RUINS)
def test_a_ruined_mesh_is_named_and_put_back(kind: str) -> None:
    params = load()
    watch = MeshWatch(params)
    params[NAME] = params[NAME].numpy() + np.float32([0.1, 0.0, 0.0])
    params.update()
    watch.check(11)
    good, stored = params[NAME].numpy().copy(), params.scene.values.numpy()
    with pytest.raises(MeshError, match=f"step 12.*'{NAME}'.*{kind}") as caught, watch.step(12):
        params[NAME].assign(RUINS[kind](params[NAME].numpy().copy()))
        params.update(NAME)
    (finding,) = caught.value.findings
    assert (finding.parameter, finding.step, finding.kind) == (NAME, 12, kind)
    assert finding.first == (22 if kind == "not finite" else 0)
    watch.back_off()
    np.testing.assert_array_equal(params[NAME].numpy(), good)
    np.testing.assert_array_equal(params.scene.values.numpy(), stored)
    watch.check(13)


def test_a_value_that_is_not_finite_is_named_though_the_scene_takes_it() -> None:
    params = load()
    watch = MeshWatch(params)
    params[COLOR].fill_(np.inf)
    with pytest.raises(MeshError, match=f"'{COLOR}': 1 of 1 values are not finite"):
        watch.check(0)


def test_single_triangles_may_flip() -> None:
    params = load()
    watch = MeshWatch(params)
    values = params[NAME].numpy().copy()
    shape = params.scene.description.shapes[0]
    far = shape.faces[40]
    values[far[0]] = values[far[1:]].sum(axis=0) - values[far[0]]
    params[NAME] = values
    params.update()
    watch.check(5)
    assert {f.kind for f in watch.seen} == {"flipped"}
    with pytest.raises(MeshError, match="flipped"):
        strict = MeshWatch(load(), share=0.0)
        strict._params[NAME] = values
        strict.check(5)


def test_other_errors_pass() -> None:
    watch = MeshWatch(load())
    with pytest.raises(ValueError, match="mine"), watch.step(0):
        raise ValueError("mine")


def test_normals_of_needles_are_none() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-10, 0], [0.5, 1e-8, 0]])
    assert normals(vertices, np.array([[0, 1, 2], [0, 1, 3]])).tolist() == [[0, 0, 0], [0, 0, 1]]


def test_a_share_has_to_leave_something() -> None:
    with pytest.raises(ValueError, match="share"):
        MeshWatch(load(), share=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["not finite", *(pytest.param(k, marks=pytest.mark.slow) for k in list(RUINS)[1:])])
def test_a_fit_stops_at_the_step_with_its_last_checkpoint_whole(tmp_path, monkeypatch, kind: str) -> None:
    file = write_fit(tmp_path)
    text = file.read_text()
    file.write_text(text[: text.index("[parameters")] + '[parameters."wall.vertex_positions"]\nlr = 0.001\n')
    config = FitConfig.from_file(file)
    advance = optim.Adam._advance

    def ruin(self, name: str, rate: float) -> None:
        advance(self, name, rate)
        if self.steps == 5:
            values = self._params[name].numpy().copy()
            self._params[name].assign(values * np.float32(np.nan) if kind == "not finite" else RUINS[kind](values))

    with monkeypatch.context() as patch:
        patch.setattr(optim.Adam, "_advance", ruin)
        with pytest.raises(ValueError, match=f"step 5.*'wall.vertex_positions'.*{kind}"):
            fit(config)
    arrays, _ = checkpoint.load(config.output / CHECKPOINT)
    assert len(arrays["losses"]) == 3
    assert fit(config, resume=True).completed
