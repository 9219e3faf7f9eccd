"""The benchmark of requests: what it draws from a scene, slopes, how it groups refusals, and its processes."""

import argparse
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr

#: A refusal as the plan says it, of two parameters.
FRAME = "the requested gradient has a boundary term ({} moves silhouettes), which boundary.PathSpace() cannot estimate "
REFUSAL = FRAME + "here: {!r} carries a texture; use a bitmap; or say PathIntegrator(boundary=None) to get the rest"
DONE = {"kind": "scene", "result": "done", "why": ""}
#: The worst of 200 slopes lies within so many standard errors of eight batches.
SIGMAS = 8.0


def options(modules, **more):
    file = psdr.scenes.cornell_box
    given = {"file": str(file), "folder": str(Path(file).parent), "label": "own/cornell_box.xml", "size": 8, "each": 2}
    return modules("request_cases").Options(values={"unknown": "1"}, **given | more)


def test_every_request_of_a_scene_is_asked_once(modules) -> None:
    cases = modules("request_cases")
    lines = [line for line in cases.records(options(modules)) if line["kind"] == "request"]
    kinds = [line["what"] for line in lines]
    assert {kind: kinds.count(kind) for kind in kinds} == {
        "number": 2, "light": 1, "vertices": 2, "pose": 2, "camera pose": 1, "lens": 2,
    }  # fmt: skip
    assert {line["result"] for line in lines} == {"taken"}
    names = [line["name"] for line in lines]
    assert len(set(names)) == len(names)
    begun, *rest, end = cases.records(options(modules, done=names[1:]))
    assert begun == {"kind": "start", "file": "own/cornell_box.xml"}
    assert [line["name"] for line in rest] == [names[0]] * 2  # begun, and answered
    assert end == {"kind": "scene", "file": "own/cornell_box.xml", "result": "done", "requests": len(names)}
    _, line = cases.records(options(modules, file="nowhere.xml"))
    assert (line["kind"], line["result"]) == ("scene", "not loaded")


def test_directions_keep_to_the_ranges_of_values(modules) -> None:
    cases, draw = modules("request_cases"), modules("request_draw")
    scene = cases.load(options(modules))
    assert [(s.film.width, s.film.height) for s in scene.description.sensors] == [(8, 8)]
    params = psdr.traverse(scene)
    params["red.reflectance.value"] = [0.0, 0.5, 1.0]
    directions = draw.Directions(scene, params, 0, np.random.default_rng(2))
    for kind, name in draw.draw(scene, "any", seed=3, each=20):
        tangent = directions.of(kind, name)
        assert tangent.shape == params[name].numpy().shape and np.isfinite(tangent).all()
        assert (tangent != 0.0).any()
    assert list(directions.of("number", "red.reflectance.value") != 0.0) == [False, True, False]
    # A pose stays one of a rigid body: its rate times its inverse is skew.
    pose = params["sensor.to_world"].numpy().astype(np.float64)
    rate = (directions.of("camera pose", "sensor.to_world") @ np.linalg.inv(pose))[:3, :3]
    np.testing.assert_allclose(rate, -rate.T, atol=1e-6 * np.abs(rate).max())


def test_slopes_are_unbiased_and_a_zero_derivative_is_wrong(modules) -> None:
    cases, rng = modules("request_cases"), np.random.default_rng(1)
    truth = rng.normal(size=50)
    found = []
    for _ in range(200):
        noise = rng.normal(size=(2, 8, 50))
        found.append(cases.slope(truth + noise[0], truth + noise[1]))
    values, errors = np.array(found).T
    assert abs(values.mean() - 1.0) < SIGMAS * values.std(ddof=1) / 200**0.5
    assert np.abs((values - 1.0) / errors).max() < SIGMAS
    assert cases.verdict(*cases.slope(0.0 * noise[0], truth + noise[1])) == "wrong"
    assert cases.verdict(1.015, 0.001) == "right" and cases.verdict(1.03, 0.001) == "wrong"
    assert cases.verdict(1.0, 0.06) == "noisy"


def test_a_kink_has_no_derivative(modules, monkeypatch) -> None:
    cases = modules("request_cases")
    scene = cases.load(options(modules))
    comparison = cases.Comparison(scene, "number", "red.reflectance.value", 0, np.ones(3))
    for image, kinked in ((abs, True), (lambda x: x + 2.0 * x**2, False)):
        monkeypatch.setattr(
            comparison, "_moved", lambda step, spp, seed, image=image: image(step) * np.arange(3.0) + 0.1 * (seed % 2)
        )
        assert comparison._kinked(4) == kinked


def test_refusals_are_grouped_without_their_names(modules) -> None:
    cause = modules("request_tables").cause
    assert {cause(REFUSAL.format(f"{name}.to_world", name)) for name in ("floor", "shape_1")} == {"… carries a texture"}
    assert cause("derivatives by a.b.to_world: 'a' and 'b' touch; give them room") == "… touch"
    assert cause("shape_0.to_world moves the bump map of 'shape_0': hold it still") == "… moves the bump map of …"
    assert cause("a projector's frame") == "a projector's frame"


def test_tables_count_each_request_once(modules) -> None:
    about = {"kind": "request", "file": "a/x.xml", "what": "pose"}
    compared = {"result": "right", "slope": 1.0, "error": 0.01, "wide": 1.0, "batches": 6}
    compared |= {"cold": 5.0, "second": 2.0, "warm": 0.1, "image": 0.05}
    rows = [
        about | {"name": "p.to_world"} | compared,
        about | {"name": "p.to_world", "result": "taken"},
        about | {"name": "q.to_world", "result": "refused", "why": REFUSAL.format("q.to_world", "q")},
        about
        | {"file": "b/y.xml", "name": "r.to_world", "result": "refused", "why": REFUSAL.format("r.to_world", "r")},
        about | {"file": "b/y.xml", "what": "light", "name": "l.radiance.value", "result": "crashed", "why": "hangs"},
        DONE | {"file": "a/x.xml"},
        DONE | {"file": "b/y.xml"},
        DONE | {"file": "b/z.xml", "result": "not loaded"},
    ]
    module = modules("request_tables")
    found = module.tables(rows)
    light, pose, both = found[module.BY_KIND]
    assert (pose["by"], pose["scenes"], pose["scenes without any"]) == ("pose", 2, 1)
    assert (pose["requests"], pose["taken"], pose["refused"], pose["taken, %"]) == (3, 1, 2, 33.3)
    assert (light["crashed"], both["requests"], both["taken, %"]) == (1, 4, 25.0)
    (cause,) = found[module.BY_CAUSE]
    assert cause == {
        "cause": "… carries a texture", "requests": 2, "scenes": 2, "by": "pose 2", "as in": "a/x.xml"
    }  # fmt: skip
    assert [(r["files"], r["loaded"], r["taken, %"]) for r in found[module.BY_REPOSITORY]] == [(1, 1, 50), (2, 1, 0)]
    assert [r["slope"] for r in found[module.SLOPES]] == [1.0]
    assert found[module.SLOPES_BY_KIND][0]["right"] == 1
    assert [r["parameter"] for r in found[module.CRASHES]] == ["l.radiance.value"]


def test_a_program_that_hangs_or_crashes_is_told(modules) -> None:
    lines_of = modules("requests").lines_of
    say = "import json, os, sys, time; print(json.dumps(json.load(sys.stdin)), flush=True); "

    def run(code: str, patience: float = 600.0) -> list[dict]:
        return list(lines_of([sys.executable, "-c", say + code], {"kind": "start"}, patience, dict(os.environ)))

    start = {"kind": "start"}
    assert run("") == [start, {"kind": "end", "how": ""}]
    assert run("os.abort()") == [start, {"kind": "end", "how": "exit status -6"}]
    assert run("time.sleep(600)", patience=2.0)[-1] == {"kind": "end", "how": "hangs"}


def test_a_study_goes_on_behind_a_crash_and_is_resumed(modules, tmp_path: Path, monkeypatch) -> None:
    requests = modules("requests")
    worker = tmp_path / "worker.py"
    # The first scene crashes at its second parameter, the second scene while it is loaded.
    worker.write_text(
        "import json, os, sys\n"
        "def say(**line):\n    print(json.dumps(line), flush=True)\n"
        "for given in json.load(sys.stdin):\n"
        "    file = given['label']\n"
        "    say(kind='start', file=file)\n"
        "    if file == 'b': os._exit(3)\n"
        "    for name in sorted({'p', 'q', 'r'} - set(given['done'])):\n"
        "        say(kind='start', file=file, what='pose', name=name)\n"
        "        if name == 'q': os._exit(4)\n"
        "        say(kind='request', file=file, what='pose', name=name, result='taken')\n"
        "    say(kind='scene', file=file, result='done')\n"
    )
    monkeypatch.setattr(requests, "WORKER", worker)
    given = {"records": tmp_path / "records.jsonl", "minutes": 10.0, "slopes": False, "seed": 0, "each": 3, "size": 8}
    given |= {"budget": 1.0, "most": None, "define": [], "patience": 600.0, "jobs": 1}
    scenes = [("a", Path("a"), Path(".")), ("b", Path("b"), Path("."))]
    study = requests.Study(argparse.Namespace(**given))
    study.run(scenes)
    found = study.answers(scenes)
    answers = [(row["kind"], row["file"], row.get("name"), row["result"]) for row in found]
    assert answers == [
        ("request", "a", "p", "taken"),
        ("request", "a", "q", "crashed"),
        ("request", "a", "r", "taken"),
        ("scene", "a", None, "done"),
        ("scene", "b", None, "crashed"),
    ]
    worker.unlink()
    again = requests.Study(argparse.Namespace(**given))
    again.run(scenes)  # there is no worker
    assert again.answers(scenes) == found and again.answers(scenes[:1]) == found[:4]
    assert again.known(scenes) == scenes[:1]
    with pytest.raises(RuntimeError, match="exit status"):
        requests.Study(argparse.Namespace(**given | {"seed": 1})).run(scenes)


def test_scenes_are_found_and_tables_written(modules, tmp_path: Path) -> None:
    requests = modules("requests")
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "a.xml").write_text("<?xml version='1.0'?><scene version='3.0.0'/>")
    (tmp_path / "b.xml").write_text("<others/>")
    (found,) = requests.scene_files([tmp_path])
    assert found == (f"{tmp_path.name}/more/a.xml", tmp_path / "more" / "a.xml", tmp_path)
    scenes = [(f"{folder}/{n}.xml", Path(), Path()) for folder, count in (("a", 5), ("b", 1)) for n in range(count)]
    drawn = [label.partition("/")[0] for label, _, _ in requests.sample(scenes, 3, seed=1)]
    assert drawn == ["a", "b", "a"]
    requests.write(tmp_path / "out.jsonl", {"a table": [{"x": 1}]}, {"cpu": "some"})
    (line,) = (tmp_path / "out.jsonl").read_text().splitlines()
    assert json.loads(line) == {"benchmark": "requests.py", "table": "a table", "x": 1, "machine": {"cpu": "some"}}
