"""A fit that is killed, interrupted, or runs out of disk loses nothing but the steps since its last checkpoint."""

import contextlib
import errno
import io
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr
import warp_psdr.fit.run as fit_module
from tests.fit.scenes import TEXTURE, write_fit
from warp_psdr import image_io, plots
from warp_psdr.files import held
from warp_psdr.fit import checkpoint
from warp_psdr.fit.run import CHECKPOINT, FitConfig, fit

ROOT = Path(__file__).resolve().parents[2]
#: Scenes that are noted to be at the edge of what floats hold are what is tested.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")
#: Seconds after which a process that hangs is ended: a safety net.
PATIENCE = 900.0
#: The unknown vertices of the wall, its silhouette in view: with the boundary term.
SHAPE = '[parameters."wall.vertex_positions"]\nlr = 0.01\n'
#: A process that cannot write where permissions forbid it, even as root (prctl(2), capabilities(7)).
READ_ONLY = """
import ctypes, os, struct, sys
if os.geteuid() == 0:  # give up every capability, the one that overrides permissions among them
    head, none = struct.pack("=Ii", 0x20080522, 0), struct.pack("=6I", 0, 0, 0, 0, 0, 0)
    assert ctypes.CDLL(None, use_errno=True).capset(head, none) == 0, os.strerror(ctypes.get_errno())
from warp_psdr.cli import main
sys.exit(main(["fit", sys.argv[1], "--resume"]))
"""


@pytest.fixture(autouse=True)
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no plots, which take longer than these fits."""
    for name in ("side_by_side", "loss_curve", "derivative_image"):
        monkeypatch.setattr(plots, name, lambda *arguments, **options: None)


@pytest.fixture
def config(tmp_path: Path) -> FitConfig:
    return FitConfig.from_file(write_fit(tmp_path))


def write_shape_fit(folder: Path) -> Path:
    """Write a fit of vertices instead of the texture."""
    file = write_fit(folder)
    text = file.read_text()
    file.write_text(text[: text.index("[parameters")] + SHAPE)
    scene = folder / "scene.xml"
    scene.write_text(scene.read_text().replace('value="36"', 'value="60"'))
    return file


def write_far_fit(folder: Path) -> Path:
    """Write a fit of vertices far away from the world's origin, that moves them by single steps of float32 there."""
    file = write_shape_fit(folder)
    scene = folder / "scene.xml"
    text = scene.read_text().replace("0.0, 0, 3", "3000, 5000, 3").replace("0.4, 0, 3", "3000.4, 5000, 3")
    text = text.replace('target="0, 0, 0"', 'target="3000, 5000, 0"')
    move = '<transform name="to_world"><rotate z="1" angle="10"/><translate x="3000" y="5000"/></transform>'
    scene.write_text(text.replace('id="wall">', f'id="wall">{move}'))
    file.write_text(file.read_text().replace("lr = 0.01", "lr = 0.0003"))
    return file


def test_checkpoints_hold_the_devices_positions(tmp_path: Path) -> None:
    """A vertex that moved away and came back is where float32 puts it, not where it was loaded."""
    config = FitConfig.from_file(write_far_fit(tmp_path))
    name = "wall.vertex_positions"
    problem, resumed = fit_module.load_problem(config), fit_module.load_problem(config)
    start = problem.params[name].numpy().copy()
    for values in (np.nextafter(start, np.float32(np.inf)), start):
        problem.params[name] = values
        problem.params.update()
    np.testing.assert_array_equal(problem.params[name].numpy(), resumed.params[name].numpy())
    moved = problem.stored(name).numpy()
    assert not np.array_equal(moved, resumed.stored(name).numpy())
    fit_module._save(tmp_path / "c.npz", problem, psdr.optim.Adam(problem.params, 1.0), {}, [])
    fit_module._restore(tmp_path / "c.npz", resumed, psdr.optim.Adam(resumed.params, 1.0), {})
    np.testing.assert_array_equal(resumed.stored(name).numpy(), moved)
    np.testing.assert_array_equal(resumed.params[name].numpy(), start)


@pytest.mark.slow
def test_far_from_the_origin_a_resumed_run_has_the_same_bits(tmp_path: Path) -> None:
    config = FitConfig.from_file(write_far_fit(tmp_path))
    for steps in (2, 3, 5):
        fit(config, iterations=steps, resume=True)
    same_results(config)


def test_samples_that_were_dropped_are_counted_over_all_parts_of_a_run(config: FitConfig, monkeypatch) -> None:
    step = fit_module._step

    def dropping(problem, adam, number: int) -> float:
        problem.scene.invalid.add("interior", 10, 1)
        return step(problem, adam, number)

    monkeypatch.setattr(fit_module, "_step", dropping)
    fit(config, iterations=3)
    same_results(config)
    assert fit(config, resume=True).invalid["interior"] == 8


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files of a folder."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def same_results(config: FitConfig) -> None:
    """Check that resuming ends where a run that was never stopped does."""
    resumed = fit(config, resume=True)
    whole = fit(replace(config, output=config.output.parent / "whole"))
    np.testing.assert_array_equal(resumed.losses, whole.losses)
    assert contents(resumed.output) == contents(whole.output)


def kill(file: Path, kills: int, seed: int) -> dict:
    """Kill runs of a fit and check that every one that came to its end is the same, byte for byte."""
    command = [sys.executable, "-m", "tests.stability.killed", str(file), str(kills), str(seed)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["kills"] >= kills and report["runs"] >= 1
    output = FitConfig.from_file(file).output
    expected = contents(output / "loading")
    assert CHECKPOINT in expected and "summary.json" in expected
    for i in range(report["runs"]):
        assert contents(output / f"run_{i}") == expected
    return report


@pytest.mark.slow
def test_killed_a_few_times(tmp_path: Path) -> None:
    kill(write_fit(tmp_path), 3, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize(("write", "seed"), [(write_fit, 2), (write_fit, 3), (write_shape_fit, 4)])
def test_killed_at_random_moments(write, seed: int, tmp_path: Path) -> None:
    report = kill(write(tmp_path), 60, seed)
    # Most of them had something to lose.
    assert report["resumable"] > 20


@contextlib.contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Let no file grow beyond ``size`` bytes: writing fails as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_full_disk_leaves_the_last_checkpoint(config: FitConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    save = checkpoint.save

    def full(path, arrays, values) -> None:
        with files_of_at_most(500) if len(arrays["losses"]) == 6 else contextlib.nullcontext():
            save(path, arrays, values)

    monkeypatch.setattr(checkpoint, "save", full)
    with pytest.raises(OSError, match=r"File too large; it was not written, .*untouched.*checkpoint\.npz") as caught:
        fit(config)
    assert caught.value.errno == errno.EFBIG
    assert len(checkpoint.load(config.output / CHECKPOINT)[0]["losses"]) == 3
    assert not list(config.output.rglob(".*"))
    monkeypatch.setattr(checkpoint, "save", save)
    same_results(config)


@pytest.mark.parametrize("stage", ["start", "end"])
def test_full_disk_while_results_are_written(config: FitConfig, stage: str) -> None:
    if stage == "end":
        fit(config)
        (config.output / "summary.json").unlink()
    with files_of_at_most(300), pytest.raises(OSError, match="it was not written, and a former one is untouched"):
        fit(config, resume=True)
    assert not list(config.output.rglob(".*"))
    same_results(config)


@pytest.mark.parametrize("suffix", [".exr", ".png", ".jpg", ".npz"])
def test_no_file_is_shortened_in_silence(suffix: str, tmp_path: Path) -> None:
    image = np.random.default_rng(0).random((40, 40, 3)).astype(np.float32)
    file = tmp_path / f"a{suffix}"

    def write() -> None:
        if suffix == ".npz":
            checkpoint.save(file, {"image": image}, {})
        else:
            image_io.write_image(file, image)

    write()
    whole = file.read_bytes()
    for missing in (1, 100, len(whole) // 2, len(whole)):
        with files_of_at_most(len(whole) - missing), pytest.raises(OSError, match="it was not written"):
            write()
        assert file.read_bytes() == whole
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.slow
def test_read_only_folder_is_named_before_the_work(config: FitConfig) -> None:
    fit(config, iterations=3)
    before = contents(config.output)
    config.output.chmod(0o500)
    try:
        command = [sys.executable, "-c", READ_ONLY, str(config.scene.parent / "fit.toml")]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)
    finally:
        config.output.chmod(0o700)
    assert done.returncode == 2
    assert "Permission denied" in done.stderr and str(config.output) in done.stderr, done.stderr
    assert "loss" not in done.stderr  # no step was made
    assert contents(config.output) == before
    same_results(config)


@pytest.mark.parametrize("call", ["write", "fsync", "replace"])
def test_second_interrupt_within_a_checkpoint_leaves_the_last_one(config: FitConfig, call: str, monkeypatch) -> None:
    """The first one asks for an end at the next whole step; the second acts at once, even while a file is written."""
    save = checkpoint.save

    def interrupt() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    def interrupted(path, arrays, values) -> None:
        if len(arrays["losses"]) != 6:
            save(path, arrays, values)
            return
        with monkeypatch.context() as patch:
            if call == "write":
                patch.setattr(np.lib.format, "write_array", lambda *arguments, **options: interrupt())
            else:
                patch.setattr(os, call, lambda *arguments: interrupt())
            save(path, arrays, values)

    monkeypatch.setattr(checkpoint, "save", interrupted)
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            fit(config)
    finally:
        signal.signal(signal.SIGINT, inherited)
    assert len(checkpoint.load(config.output / CHECKPOINT)[0]["losses"]) == 3
    assert not list(config.output.rglob(".*"))
    monkeypatch.setattr(checkpoint, "save", save)
    same_results(config)


def test_two_runs_do_not_write_to_one_folder(config: FitConfig) -> None:
    config.output.mkdir()
    with held(config.output), pytest.raises(ValueError, match="is being written to by another run"):
        fit(config)
    code = (
        "import os, signal, sys\n"
        "from warp_psdr.files import held\n"
        "with held(sys.argv[1]):\n"
        "    print('held', flush=True); signal.pause()\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(config.output)], cwd=ROOT, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with pytest.raises(ValueError, match="is being written to by another run"):
            fit(config)
        other.kill()
    assert fit(config, iterations=1).completed


def crafted(arrays: dict, changes: dict) -> dict:
    return {name: changes.get(name, value) for name, value in arrays.items()}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"losses": np.float64(1.0)}, r"the losses have shape \(\)"),
        ({"losses": np.ones((3, 1))}, r"the losses have shape \(3, 1\)"),
        ({"losses": np.full(3, np.nan)}, "not finite"),
        ({"losses": np.ones(2)}, "holds 2 losses of 3 steps"),
        ({f"parameter/{TEXTURE}": np.full((4, 4, 3), np.nan)}, "48 numbers are NaN or infinite"),
        ({f"parameter/{TEXTURE}": np.ones(5)}, r"got shape \(5,\)"),
        ({"adam/steps": np.int64(-3)}, "steps is"),
        ({f"adam/{TEXTURE}/m": np.full(48, np.inf, np.float32)}, "expected finite float32"),
    ],
)
def test_checkpoints_that_say_strange_things_are_refused(config: FitConfig, change: dict, message: str) -> None:
    fit(config, iterations=3)
    path = config.output / CHECKPOINT
    arrays, values = checkpoint.load(path)
    checkpoint.save(path, crafted(arrays, change), values)
    with pytest.raises(ValueError, match=rf"checkpoint\.npz.*{message}.*--overwrite"):
        fit(config, resume=True)


def test_checkpoint_of_overlapping_entries_is_refused(tmp_path: Path) -> None:
    """A central directory may name the same bytes a thousand times."""
    path = tmp_path / "c.npz"
    checkpoint.save(path, {"a": np.zeros(1000)}, {})
    data = path.read_bytes()
    start = data.index(b"PK\x01\x02")
    end = data.index(b"PK\x05\x06")
    directory, count = data[start:end], data[start:end].count(b"PK\x01\x02")
    stream = io.BytesIO()
    stream.write(data[:start] + 100 * directory)
    total = 100 * count
    stream.write(b"PK\x05\x06\0\0\0\0" + 2 * total.to_bytes(2, "little"))
    stream.write((100 * len(directory)).to_bytes(4, "little") + start.to_bytes(4, "little") + b"\0\0")
    path.write_bytes(stream.getvalue())
    with pytest.raises(ValueError, match="overlap"):
        checkpoint.load(path)
