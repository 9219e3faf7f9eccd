"""Pools under faults: the bits of one process, while workers and clients are killed at random moments.

    python examples/benchmarks/pool_faults.py [--quick] [--repeat 20] [--engines executor dask] [--counts 1 2 4]

A run is a process that renders an image and a gradient and makes twenty steps of a fit in a pool. Its client or one of
its workers is killed at a random moment of what a run takes that nobody disturbs; a client that was killed is started
again, and resumes the fit from its checkpoint. The table counts the runs whose SHA-256 are those of one process, those
that took longer than two minutes ("hung"), and processes that outlive their client. Needs Linux, and Dask for its rows.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import ROOT, Report, arguments, psdr

from warp_psdr import image_io
from warp_psdr.distributed import Pool
from warp_psdr.fit import checkpoint, report
from warp_psdr.fit.run import CHECKPOINT, FitConfig, fit
from warp_psdr.progress import silence

ENGINES, COUNTS, KILLED = ("executor", "dask"), (1, 2, 4), ("nobody", "a worker", "the client")
RESULTS = ("image", "gradient", "fit")
NAME = "white.reflectance.value"
SIZE, SPP, STEPS = 32, 8, 20
#: Seconds that a run takes at most.
LONGEST = 120.0
FIT = f"""
scene = "{ROOT / "scenes" / "cornell_box.xml"}"
targets = ["target.exr"]
output = "out"
iterations = {STEPS}
checkpoint_every = 1
spp = {SPP}
final_spp = 1
[defaults]
resolution = {SIZE}
[parameters."{NAME}"]
lr = 0.02
initial = 0.3
"""
#: A cluster that prints its address, and kills a worker that runs for every line that it reads. By its default it would
#: close a worker for good that starts anew when one of its name was lost 15 s before.
CLUSTER = """
import os, random, signal, sys, time
import dask
from distributed import LocalCluster
dask.config.set({"distributed.deploy.lost-worker-timeout": "1h"})
if __name__ == "__main__":
    with LocalCluster(n_workers=int(sys.argv[1]), threads_per_worker=1, dashboard_address=":0", silence_logs=50) as c:
        print(c.scheduler_address, flush=True)
        for line in sys.stdin:
            ready = []
            while not ready:
                time.sleep(0.01)
                nannies = [n for n in list(c.workers.values()) if n.worker_address in c.scheduler.workers]
                ready = [n.pid for n in nannies if n.pid and n.process.status.name == n.status.name == "running"]
            os.kill(random.choice(ready), signal.SIGKILL)
            print("killed", flush=True)
"""


@dataclass
class Work:
    """What every run does; the processes of runs are copies of one that has loaded all of it."""

    config: FitConfig
    scene: psdr.Scene
    params: psdr.Parameters
    adjoint: np.ndarray

    def digests(self, pool: Pool | None, output: Path) -> dict[str, str]:
        """Return the SHA-256 of all results."""
        renders = psdr if pool is None else pool
        image = renders.render(self.scene, spp=SPP, seed=1).numpy()
        self.params.zero_grad()
        renders.render_backward(self.scene, self.params, self.adjoint, spp=SPP, seed=2)
        fit(replace(self.config, output=output), resume=True, pool=pool)
        arrays, _values = checkpoint.load(output / CHECKPOINT)
        fitted = b"".join(arrays[name].tobytes() for name in sorted(arrays))
        found = (image.tobytes(), self.params[NAME].grad.numpy().tobytes(), fitted)
        return {name: hashlib.sha256(data).hexdigest() for name, data in zip(RESULTS, found, strict=True)}


def load(folder: Path) -> Work:
    """Write the fit and load everything."""
    config_file = folder / "fit.toml"
    config_file.write_text(FIT)
    scene = psdr.load_file(ROOT / "scenes" / "cornell_box.xml", resolution=SIZE)
    image_io.write_image(folder / "target.exr", psdr.render(scene, spp=64, seed=9).numpy())
    params = psdr.traverse(scene)
    params.requires_grad(NAME)
    adjoint = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    return Work(FitConfig.from_file(config_file), scene, params, adjoint)


def started(work: Work, output: Path, engine: str, count: int, address: str) -> int:
    """Start a client as a copy of this process, in a session of its own."""
    process = os.fork()
    if process == 0:
        status = 1
        try:
            os.setsid()
            with ExitStack() as stack, silence():
                if engine == "dask":
                    from distributed import Client

                    runs: object = stack.enter_context(Client(address))
                else:
                    runs = stack.enter_context(ProcessPoolExecutor(count))
                found = work.digests(stack.enter_context(Pool(runs)), output)
            output.with_suffix(".json").write_text(json.dumps(found))
            status = 0
        finally:
            os._exit(status)
    return process


def processes(wanted: Callable[[int, int, int], bool]) -> list[int]:
    """Return the living processes of which (number, parent, session) is wanted."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, parent, _group, session = (entry / "stat").read_text().rpartition(")")[2].split()[:4]
            except OSError:  # it has ended since
                continue
            if state not in "ZX" and wanted(int(entry.name), int(parent), int(session)):
                found.append(int(entry.name))
    return found


def kill_worker(client: int, cluster: subprocess.Popen | None) -> int:
    """Kill a process that runs jobs, and return how many were killed."""
    if cluster is not None:
        cluster.stdin.write("kill\n")
        cluster.stdin.flush()
        return int(bool(cluster.stdout.readline()))
    found = processes(lambda _pid, parent, _session: parent == client)
    if found:
        os.kill(random.choice(found), signal.SIGKILL)
    return min(len(found), 1)


def run(work: Work, output: Path, engine: str, count: int, killed: str, moment: float, cluster, address: str) -> dict:
    """Make a run, and return its digests, how long it took, and what outlived a client."""
    begun, kills, outlived = time.perf_counter(), 0, 0
    client = started(work, output, engine, count, address)
    if killed != "nobody":
        time.sleep(moment)
        if killed == "a worker":
            kills = kill_worker(client, cluster)
        else:
            os.kill(client, signal.SIGKILL)
            kills = int(os.waitpid(client, 0)[1] != 0)
            outlived = left(client)
            client = started(work, output, engine, count, address)
    end = time.perf_counter() + LONGEST
    while os.waitpid(client, os.WNOHANG) == (0, 0):
        time.sleep(0.01)
        if time.perf_counter() > end:
            for pid in processes(lambda _pid, _parent, session: session == client):
                os.kill(pid, signal.SIGKILL)
            os.waitpid(client, 0)
            return {"hung": True, "kills": kills, "outlived": 0}
    seconds = time.perf_counter() - begun
    file = output.with_suffix(".json")
    found = json.loads(file.read_text()) if file.exists() else {}
    return found | {"seconds": seconds, "hung": False, "kills": kills, "outlived": outlived + left(client)}


def left(client: int) -> int:
    """Return how many processes of a client outlive it, for ten seconds."""
    end, found = time.perf_counter() + 10.0, [client]
    while found and time.perf_counter() < end:
        found = processes(lambda _pid, _parent, session: session == client)
        time.sleep(0.01)
    return len(found)


def rows_of(work: Work, expected: dict, folder: Path, engine: str, count: int, repeat: int) -> list[dict]:
    """Make all runs of an engine with so many workers, and return rows of the table."""
    rows, cluster, address = [], None, ""
    if engine == "dask":
        file = folder / "cluster.py"
        file.write_text(CLUSTER)
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        cluster = subprocess.Popen(
            [sys.executable, str(file), str(count)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment,
        )  # fmt: skip
        address = cluster.stdout.readline().strip()
        run(work, folder / f"warm_{count}", engine, count, "nobody", 0.0, cluster, address)
    typical = 1.0
    for killed in KILLED:
        done = []
        for number in range(repeat):
            output = folder / f"{engine}_{count}_{killed}_{number}".replace(" ", "_")
            done.append(run(work, output, engine, count, killed, random.uniform(0.0, typical), cluster, address))
        seconds = [d["seconds"] for d in done if not d["hung"]]
        if killed == "nobody":
            typical = sorted(seconds)[len(seconds) // 2]
        equal = {f"{name} equal": sum(d.get(name) == expected[name] for d in done) for name in RESULTS}
        rows.append(
            {"engine": engine, "workers": count, "killed": killed, "runs": repeat}
            | {"kills": sum(d["kills"] for d in done), **equal}
            | {"hung": sum(d["hung"] for d in done), "outlived": sum(d["outlived"] for d in done)}
        )
        print(rows[-1], file=sys.stderr, flush=True)
    if cluster is not None:
        cluster.communicate()
    return rows


def main() -> None:
    """Make all runs and print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=ENGINES, help="what runs the jobs")
    parser.add_argument("--counts", nargs="+", type=int, default=COUNTS, help="numbers of workers")
    options = parser.parse_args()
    repeat = options.repeat or (2 if options.quick else 20)
    random.seed(0)
    psdr.set_workers(1)  # no threads: the processes of runs are forked
    report.write_start, report.write_report = (
        lambda problem: None,
        lambda problem, losses: (),
    )  # nothing but checkpoints
    table = Report("pool_faults", options.output)
    with tempfile.TemporaryDirectory() as name, silence():
        work = load(Path(name))
        expected = work.digests(None, Path(name) / "alone")
        rows = []
        for engine in options.engines:
            for count in options.counts:
                rows += rows_of(work, expected, Path(name), engine, count, repeat)
    table.table(f"Runs with the bits of one process: an image, a gradient, {STEPS} steps of a fit", rows)


if __name__ == "__main__":
    main()
