"""A pool of two processes against one process with two threads: speed, what a job costs beside its work, and bytes.

    python examples/benchmarks/pool.py [--parts NAME ...] [--quick] [--output results.jsonl]

"image", "colours", "pose" and "fit" compare calls, and steps of a fit: 1 means that two processes are as fast as two
threads. "job" renders 64 x 64 pixels with one sample in shares: most of the time is what a job costs beside its work.
"bytes" edits all values of a parameter and asks for a gradient. "scheduler" runs tiny jobs on more and more workers;
Dask's scheduler is a process of its own there, whose processor time a job says how many jobs a second it can serve.
"plan" computes from these what a thousand workers do; it reads the other parts from a file that ``--output`` wrote.
Dask is optional: without it, its rows are left out.
"""

import contextlib
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from pathlib import Path

import numpy as np
from common import Report, Seconds, arguments, in_turns, median, psdr, ratio

from warp_psdr import image_io, optim, workers
from warp_psdr.distributed.jobs import Done, merge
from warp_psdr.distributed.wire import pack
from warp_psdr.fit.config import FitConfig, Unknown
from warp_psdr.fit.run import Problem, load_problem
from warp_psdr.kernels.rng import mix_seed

#: Processes, and threads of the one process that they are compared with.
TWO = 2
PARTS = ("image", "colours", "pose", "fit", "job", "bytes", "scheduler", "plan")
ENGINES = ("processes", "Dask")
TEXTURE, VERTICES = "ball.bsdf.reflectance.data", "ball.vertex_positions"
#: Rows and columns of the ball's mesh, 2 * 224 * 224 triangles.
ROWS = 224
#: Titles of the tables that the plan reads.
JOB, SUMS = "A job of some hundred pixels and one sample", "Two shares of half of it are added up"
SCHEDULER = "Tiny jobs on Dask, workers share the cores"
#: Workers that are planned for, and the share of a call that its overhead may take.
PLANNED, SHARE = 1000, 0.1


@contextlib.contextmanager
def dask(processes: int):
    """Yield a client of a cluster on this machine, of one thread a worker; None: Dask is not installed."""
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        yield None
        return
    with (
        LocalCluster(n_workers=processes, threads_per_worker=1, dashboard_address=":0") as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextlib.contextmanager
def pools(processes: int, engines: list[str]):
    """Yield pools by the names of what runs them."""
    found = {}
    with contextlib.ExitStack() as stack:
        if "processes" in engines:
            found["processes"] = stack.enter_context(psdr.distributed.Pool("local", processes=processes, threads=1))
        if "Dask" in engines and (client := stack.enter_context(dask(processes))) is not None:
            found["Dask"] = psdr.distributed.Pool(client, threads=1)
        yield found


def ball(texels: int, resolution: int, cameras: int, rows: int = 32) -> dict:
    """Return a ball with a texture over a floor, under a sky and a lamp, seen by a ring of cameras."""
    T = psdr.Transform
    v, u = np.meshgrid(np.linspace(0.0, 1.0, rows + 1), np.linspace(0.0, 1.0, rows + 1), indexing="ij")
    theta, phi = np.pi * (0.001 + 0.998 * v), 2.0 * np.pi * u
    xyz = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), -np.sin(theta) * np.sin(phi)], -1).reshape(-1, 3)
    i = (np.arange(rows)[:, None] * (rows + 1) + np.arange(rows)[None, :]).reshape(-1)
    quads = np.stack([i, i + rows + 1, i + rows + 2, i + 1], 1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    bitmap = np.random.default_rng(1).uniform(0.1, 0.9, (texels, texels, 3)).astype(np.float32)
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sky": {"type": "constant", "radiance": 0.3},
        "lamp": {
            "type": "rectangle",
            "to_world": T.look_at(origin=[2, 4, 2], target=[0, 0, 0], up=[0, 1, 0]),
            "emitter": {"type": "area", "radiance": 8.0},
        },
        "floor": {"type": "rectangle", "to_world": T.translate([0, -1.1, 0]) @ T.rotate([1, 0, 0], -90) @ T.scale(4)},
        "ball": {
            "type": "mesh",
            "vertices": xyz.astype(np.float32),
            "faces": faces.astype(np.int32),
            "texcoords": np.stack([u, v], -1).reshape(-1, 2).astype(np.float32),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "raw": True}},
        },
    }
    for n in range(cameras):
        angle = 2.0 * np.pi * n / cameras
        origin = [3.0 * np.sin(angle), 1.0, 3.0 * np.cos(angle)]
        scene[f"camera{n}"] = {
            "type": "perspective",
            "fov": 45,
            "to_world": T.look_at(origin=origin, target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": resolution, "height": resolution},
        }
    return scene


def spread(times: dict, numerator: str, denominator: str) -> str:
    """Return the smallest and the largest ratio of two times over the repetitions."""
    ratios = [a / b for a, b in zip(times[numerator]["wall"], times[denominator]["wall"], strict=True)]
    return f"{min(ratios):.2f} to {max(ratios):.2f}"


def processor_seconds() -> float:
    """Return the processor time of this process and of those that it has started."""
    try:
        import psutil
    except ImportError:  # it comes with Dask
        return time.process_time()
    me, total = psutil.Process(), 0.0
    for process in (me, *me.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            times = process.cpu_times()
            total += times.user + times.system
    return total


def timed(function) -> Seconds:
    """Call a function; the processor time is that of all processes."""
    wall, cpu = time.perf_counter(), processor_seconds()
    function()
    return Seconds(time.perf_counter() - wall, processor_seconds() - cpu)


def compared(what: str, functions: dict, repeat: int) -> list[dict]:
    """Return a row for each pool: its speed over that of threads, as medians of ratios of neighbouring times."""
    times = in_turns({n: lambda i, f=f: timed(lambda: f(i)) for n, f in functions.items()}, repeat)
    return [
        {
            "what": what,
            "two processes": name,
            "threads, seconds": median(times, "threads"),
            "processes, seconds": median(times, name),
            "speed, over threads": ratio(times, "threads", name),
            "from, to": spread(times, "threads", name),
            "processor time, over threads": ratio(times, name, "threads", "cpu"),
        }
        for name in functions
        if name != "threads"
    ]


#: Samples of a pixel of an image, of a gradient of colours and of one of a pose, and what is sought.
CALLS = {
    "image": ("image", 1024, ()),
    "colours": ("gradient by reflectances", 1024, ("*.reflectance.value",)),
    "pose": ("gradient by a pose, boundary term included", 64, ("small-box.to_world",)),
}


def call(report: Report, part: str, options: Namespace) -> None:
    """An image or a gradient of the Cornell box."""
    what, spp, names = CALLS[part]
    resolution, spp = (64, max(spp // 16, 8)) if options.quick else (256, spp)
    scene = psdr.load_file(psdr.scenes.cornell_box, resolution=resolution)
    psdr.guiding.set_automatic(scene, False)  # a pool does not guide
    params = psdr.traverse(scene)
    params.requires_grad(*names)
    # A method, so that no pilot runs in the middle of a measurement.
    integrator = psdr.PathIntegrator(interior=psdr.interior.Replay())
    adjoint = np.full((resolution, resolution, 3), 1.0 / (3 * resolution**2), np.float32)

    def run(pool, repetition: int) -> None:
        given = {"integrator": integrator, "spp": spp if repetition else 16, "seed": repetition}
        if names:
            (psdr.render_backward if pool is None else pool.render_backward)(scene, params, adjoint, **given)
        else:
            (psdr.render if pool is None else pool.render)(scene, **given).numpy()

    with pools(TWO, options.engines) as by_name:
        functions = {n: lambda i, p=p: run(p, i) for n, p in ({"threads": None} | by_name).items()}
        rows = compared(f"{what}, {spp:,} samples", functions, options.repeat)
    report.table(f"Two processes of one thread over one of two, Cornell box, {resolution}² pixels", rows)


def fit(report: Report, options: Namespace) -> None:
    """Steps of a fit of a texture, whose views are jobs."""
    resolution, texels, spp, views, steps = (48, 16, 4, 8, 1) if options.quick else (128, 64, 16, 8, 4)
    with tempfile.TemporaryDirectory() as name, pools(TWO, options.engines) as by_name:
        problems = {n: problem(Path(name), texels, resolution, views, spp) for n in ("threads", *by_name)}
        for n, pool in by_name.items():
            problems[n].pool = pool
        optimizers = {n: optim.Adam(p.params, {TEXTURE: 0.02}) for n, p in problems.items()}

        def step(n: str, repetition: int) -> None:
            for i in range(steps):
                seeds = [mix_seed(steps * repetition + i, view) for view in range(views)]
                problems[n].backward_all([(view, seeds[view], 1.0 / views) for view in range(views)])
                optimizers[n].step()

        what = f"{steps} steps" if steps > 1 else "a step"
        rows = compared(what, {n: lambda i, n=n: step(n, i) for n in problems}, options.repeat)
        same = {n: np.array_equal(p.params[TEXTURE].numpy(), problems["threads"].params[TEXTURE].numpy())
                for n, p in problems.items()}  # fmt: skip
        rows = [row | {"equal bits": same[row["two processes"]]} for row in rows]
    title = f"A fit of a texture, {views} views of {resolution}² pixels, {spp} samples"
    report.table(title, rows)


def problem(folder: Path, texels: int, resolution: int, views: int, spp: int) -> Problem:
    """Return a fit that looks for the texture of the ball, loaded, with its targets."""
    described = ball(texels, resolution, views)
    file, targets = folder / "scene.xml", [folder / f"target{n}.exr" for n in range(views)]
    if not file.is_file():
        write_xml(file, described)
        scene = psdr.load_file(file)
        for n, target in enumerate(targets):
            image_io.write_image(target, psdr.render(scene, sensor=n, spp=spp, seed=1000 + n).numpy())
    config = FitConfig(
        scene=file, targets=tuple(targets), parameters={TEXTURE: Unknown(lr=0.02, initial=0.5)}, output=folder / "out",
        iterations=1, spp=spp,
    )  # fmt: skip
    return load_problem(config)


def write_xml(file: Path, described: dict) -> None:
    """Write the ball's scene with its mesh and its texture."""
    from scenes import write_ply

    mesh = described["ball"]
    write_ply(file.parent / "ball.ply", mesh["vertices"], mesh["faces"], texcoords=mesh["texcoords"])
    image_io.write_image(file.parent / "texture.exr", mesh["bsdf"]["reflectance"]["bitmap"])

    def matrix(transform) -> str:
        return " ".join(f"{x:.9g}" for x in np.asarray(transform.matrix).reshape(-1))

    def posed(transform) -> str:
        return f'<transform name="to_world"><matrix value="{matrix(transform)}"/></transform>'

    cameras = [value for value in described.values() if isinstance(value, dict) and value["type"] == "perspective"]
    size = cameras[0]["film"]["width"]
    film = f'<film type="hdrfilm"><integer name="width" value="{size}"/><integer name="height" value="{size}"/></film>'
    sensors = "".join(
        f'<sensor type="perspective"><float name="fov" value="45"/>{posed(camera["to_world"])}{film}</sensor>'
        for camera in cameras
    )
    lamp = f'{posed(described["lamp"]["to_world"])}<emitter type="area"><rgb name="radiance" value="8"/></emitter>'
    texture = (
        '<texture type="bitmap" name="reflectance"><string name="filename" value="texture.exr"/>'
        '<boolean name="raw" value="true"/></texture>'
    )
    file.write_text(
        f"""<scene version="3.0.0">
        <integrator type="path"><integer name="max_depth" value="4"/></integrator>{sensors}
        <emitter type="constant"><rgb name="radiance" value="0.3"/></emitter>
        <shape type="rectangle" id="lamp">{lamp}</shape>
        <shape type="rectangle" id="floor">{posed(described["floor"]["to_world"])}</shape>
        <shape type="ply" id="ball"><string name="filename" value="ball.ply"/><bsdf type="diffuse">{texture}</bsdf>
        </shape></scene>"""
    )


def job(report: Report, options: Namespace) -> None:
    """What a job costs beside its work."""
    scene, calls, rows = psdr.load_file(psdr.scenes.cornell_box, resolution=64), 5 if options.quick else 20, []
    for processes in (1, TWO):
        with pools(processes, options.engines) as by_name:
            for name, pool in by_name.items():
                pool.render(scene, spp=1)
                costs, works = [], []
                for _ in range(options.repeat):
                    before, began = pool.report, time.perf_counter()
                    for seed in range(calls):
                        pool.render(scene, spp=1, seed=seed)
                    wall, after = time.perf_counter() - began, pool.report
                    jobs, work = after.jobs - before.jobs, after.seconds - before.seconds
                    costs.append(1e3 * (wall - work / processes) / jobs)
                    works.append(1e3 * work / jobs)
                row = {"jobs run by": name, "processes": processes, "jobs a call": jobs // calls}
                row |= {"work, ms": statistics.median(works), "beside it, ms": statistics.median(costs)}
                rows.append(row | {"from, to": f"{min(costs):.2g} to {max(costs):.2g}"})
    report.table(JOB, rows)


def wire(report: Report, options: Namespace) -> None:
    """Bytes of a step: what changed, and a gradient."""
    resolution, rows = 64, []
    sizes = (64, 256) if options.quick else (64, 256, 1024)
    cases = [(f"texture of {n}²", TEXTURE, n, 32) for n in sizes]
    cases.append((f"vertices of {2 * ROWS**2:,} triangles", VERTICES, 8, ROWS))
    generator = np.random.default_rng(2)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=None, interior=psdr.interior.Replay())
    with pools(TWO, options.engines) as by_name:
        for what, parameter, texels, mesh in cases:
            for name, pool in by_name.items():
                scene = psdr.load_dict(ball(texels, resolution, 1, mesh))
                params = psdr.traverse(scene)
                params.requires_grad(parameter)

                def gradient(pool=pool, scene=scene, params=params):
                    adjoint = generator.uniform(0.0, 1.0, (resolution, resolution, 3)).astype(np.float32)
                    pool.render_backward(scene, params, adjoint, integrator=integrator, spp=4)
                    return adjoint.nbytes

                gradient()
                value = params[parameter].numpy().copy()
                params[parameter] = 0.5 * value + generator.uniform(0.0, 0.01, value.shape).astype(np.float32)
                params.update()
                before = pool.report
                new = value.nbytes + gradient()
                after = pool.report
                sent = (after.sent - before.sent) / (TWO if name == "processes" else 1)
                row = {"changed": what, "jobs run by": name, "values and adjoint, MB": new / 1e6}
                row |= {"sent to a process, MB": sent / 1e6, "sent over new": sent / new}
                received, jobs = after.received - before.received, after.jobs - before.jobs
                rows.append(row | {"gradient, MB": value.nbytes / 1e6, "shares": jobs, "received, MB": received / 1e6})
    report.table("Bytes of a step", rows)
    rows = []
    for size in (256, 1024):
        film = np.ones((size, size, 4))
        half = [np.where(np.arange(size)[:, None, None] % 2 == i, film, 0.0) for i in range(2)]
        rows.append(merged(f"image of {size}²", *half, options.repeat))
    for texels in (64, 1024):
        gradient = np.ones(3 * texels**2)
        rows.append(merged(f"gradient by a texture of {texels}²", gradient, gradient, options.repeat))
    report.table(SUMS, rows)


def merged(what: str, one: np.ndarray, other: np.ndarray, repeat: int) -> dict:
    """Return how long two results take to be added up, and the sum's size."""
    shares = [Done({"sum": pack(part)}) for part in (one, other)]
    times = in_turns({"merge": lambda _: merge(*shares)}, repeat)
    return {"sum": what, "share, MB": shares[0].nbytes / 1e6, "sum, MB": merge(*shares).nbytes / 1e6,
            "ms": 1e3 * median(times, "merge")}  # fmt: skip


@contextlib.contextmanager
def cluster(count: int):
    """Yield a client, and the process of its scheduler, which runs beside so many workers of one thread."""
    import psutil
    from distributed import Client

    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        file = Path(name) / "scheduler.json"
        log = stack.enter_context(open(Path(name) / "log", "w", encoding="utf-8"))
        about = ["--scheduler-file", str(file)]
        quiet = {"stdout": log, "stderr": log}

        def start(module: str, *options: str) -> subprocess.Popen:
            process = subprocess.Popen([sys.executable, "-m", module, *about, *options], **quiet)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process

        scheduler = start("distributed.cli.dask_scheduler", "--port", "0", "--dashboard-address", ":0")
        while not file.is_file():
            time.sleep(0.1)
        client = stack.enter_context(Client(scheduler_file=str(file)))
        start("distributed.cli.dask_worker", "--nworkers", str(count), "--nthreads", "1", "--no-dashboard")
        client.wait_for_workers(count, timeout=150)
        yield client, psutil.Process(scheduler.pid)


def scheduler(report: Report, options: Namespace) -> None:
    """Jobs a second, and the processor time that the scheduler takes for each."""
    cameras, rows = 16 if options.quick else 64, []
    scene = psdr.load_dict(ball(4, 8, cameras, 4))
    psdr.render(scene, spp=1)  # kernels
    for count in options.workers or ((2, 8) if options.quick else (2, 8, 32)):
        with cluster(count) as (client, process):
            pool = psdr.distributed.Pool(client, threads=1)

            def used(process=process) -> float:
                times = process.cpu_times()
                return times.user + times.system

            sensors = list(range(cameras))
            pool.render(scene, spp=1, sensor=sensors)
            found = []
            for seed in range(options.repeat):
                jobs, mine, theirs, began = pool.report.jobs, time.process_time(), used(), time.perf_counter()
                pool.render(scene, spp=1, sensor=sensors, seed=seed)
                wall, jobs = time.perf_counter() - began, pool.report.jobs - jobs
                found.append((jobs / wall, 1e3 * (used() - theirs) / jobs, 1e3 * (time.process_time() - mine) / jobs))
            speed, theirs, mine = (statistics.median(column) for column in zip(*found, strict=True))
            row = {"workers": count, "jobs a call": jobs, "jobs a second": speed}
            tasks = 2.0 - cameras / jobs  # a tree of n jobs has n - 1 additions
            row |= {"tasks a job": tasks, "scheduler, processor ms a task": theirs / tasks}
            row |= {"caller, processor ms a task": mine / tasks}
            rows.append(row | {"tasks a second, at most": 1e3 * tasks / max(theirs, mine)})
    report.table(SCHEDULER, rows)


def measured(file: Path) -> dict[str, list[dict]]:
    """Return the rows of a file by their tables."""
    found: dict[str, list[dict]] = {}
    for line in file.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        found.setdefault(row["table"], []).append(row)
    return found


def plan(report: Report, file: Path) -> None:
    """What a thousand workers do, by the other parts' numbers."""
    found = measured(file)
    speed = found[SCHEDULER][-1]["tasks a second, at most"]
    sums = {row["sum"]: row for row in found[SUMS]}
    # What a tiny call takes beside its work.
    latency = max(row["beside it, ms"] * row["jobs a call"] for row in found[JOB] if row["jobs run by"] == "Dask") / 1e3
    rows = []
    for what, result, numbers, cameras, views in (
        ("image of 1024², one camera", "image of 1024²", 3 * 1024**2, 1, False),
        ("image of 1024², 16 cameras", "image of 1024²", 3 * 1024**2, 16, False),
        ("gradient by 64² texels, one camera", "gradient by a texture of 64²", 3 * 64**2, 1, False),
        ("gradient by 1024² texels, one camera", "gradient by a texture of 1024²", 3 * 1024**2, 1, False),
        ("step of a fit by 64² texels, 8 views", "gradient by a texture of 64²", 3 * 64**2, 8, True),
        ("step of a fit by 64² texels, 1,000 views", "gradient by a texture of 64²", 3 * 64**2, 1000, True),
        ("step of a fit by 1024² texels, 1,000 views", "gradient by a texture of 1024²", 3 * 1024**2, 1000, True),
    ):
        shards = workers.SHARDS if result.startswith("image") else workers.shard_count(numbers)
        each = 1 if views else min(shards, workers.below(max(2 * math.ceil(4 * PLANNED / cameras) - 1, 1)))
        jobs, depth = cameras * each, int(math.log2(each))
        overhead = (2 * jobs - cameras) / speed + latency + depth * sums[result]["ms"] / 1e3
        busy = min(jobs, PLANNED)
        rows.append(
            {
                "call": what,
                "shares a camera": each,
                "jobs": jobs,
                "workers busy": busy,
                "levels": depth,
                # A view's gradient is single precision, a share's double.
                "to the caller, MB": cameras * sums[result]["sum, MB"] * (0.5 if views else 1.0),
                "overhead, seconds": overhead,
                "pays from, core-seconds": overhead / SHARE * busy,
            }
        )
    report.table(f"{PLANNED:,} workers on Dask, planned; an overhead of {SHARE:.0%} pays", rows)


def main() -> None:
    """Measure and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--workers", type=int, nargs="+", help="of the scheduler; default: 2 8 32, quick: 2 8")
    parser.add_argument("--measured", type=Path, help="file that the plan reads; default: that of --output")
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=ENGINES)
    options = parser.parse_args()
    options.repeat = options.repeat or (3 if options.quick else 5)
    psdr.set_workers(options.threads)
    report = Report("pool", options.output)
    for name in CALLS:
        if name in options.parts:
            call(report, name, options)
    for name, measure in (("fit", fit), ("job", job), ("bytes", wire), ("scheduler", scheduler)):
        if name in options.parts:
            measure(report, options)
    source = options.measured or options.output
    if "plan" in options.parts and source is not None:
        plan(report, source)


if __name__ == "__main__":
    main()
