"""Rays per second of the ray queries: the wide BVH, ``wp.Mesh`` and Embree (through Mitsuba 3, if installed).

    python examples/benchmarks/ray_queries.py [--cases box36 sphere81920 ...] [--rays N] [--threads N] [--json out.json]

Every backend gets the same rays in the same order and the same number of threads. Backends take turns within a
repetition, so that a noisy machine is noisy to all; reported are medians and, for ratios, the median of the
repetitions' ratios. Ray sets: ``camera`` (scanlines, coherent), ``shadow`` (from the camera's hits to one point,
coherent), ``random`` (uniform origins in the bounding box, uniform directions) and ``bounce`` (cosine-distributed off
the surfaces of shuffled hits, incoherent). Every query finds its rays in memory as it takes them: Embree's are arrays
of components, as Dr.Jit has them; what the wide BVH traces together lies in rows, and the rest are vectors.
"""

import argparse
import concurrent.futures
import json
import statistics
import time

import numpy as np
import warp as wp

from warp_psdr.kernels.bvh.bundle import make_bundle
from warp_psdr.kernels.bvh.each import make_each
from warp_psdr.kernels.bvh.wide import Accel, RayHit, make_intersect
from warp_psdr.kernels.lanes.lanes import ROWS
from warp_psdr.scene.acceleration import Accelerator, host_width


def box36() -> tuple[np.ndarray, np.ndarray]:
    """Return a Cornell box: five walls, a light and two rotated boxes, 36 triangles."""

    def quad(a, b, c, d):
        return [[a, b, c], [a, c, d]]

    def block(center, size, angle):
        c, s = np.cos(angle), np.sin(angle)
        corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(size)
        p = (corner @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) + np.array(center)).tolist()
        sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        return [t for side in sides for t in quad(*(p[i] for i in side))]

    n, p = -1.0, 1.0
    triangles = quad([n, n, n], [p, n, n], [p, n, p], [n, n, p]) + quad([n, p, n], [n, p, p], [p, p, p], [p, p, n])
    triangles += quad([n, n, n], [n, p, n], [p, p, n], [p, n, n]) + quad([n, n, n], [n, n, p], [n, p, p], [n, p, n])
    triangles += quad([p, n, n], [p, p, n], [p, p, p], [p, n, p])
    triangles += quad([-0.25, 0.99, -0.25], [0.25, 0.99, -0.25], [0.25, 0.99, 0.25], [-0.25, 0.99, 0.25])
    triangles += block([-0.35, -0.4, -0.3], [0.3, 0.6, 0.3], 0.3) + block([0.35, -0.7, 0.3], [0.3, 0.3, 0.3], -0.3)
    vertices = np.array(triangles, dtype=np.float32).reshape(-1, 3)
    return vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)


def bumpy_sphere(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a displaced sphere of 2 * rows * columns triangles."""
    theta = np.linspace(0.0, np.pi, rows + 1)[:, None]
    phi = np.linspace(0.0, 2.0 * np.pi, columns + 1)[None, :]
    r = 1.0 + 0.1 * np.sin(7.0 * theta) * np.cos(5.0 * phi) + 0.01 * np.sin(61.0 * theta) * np.cos(48.0 * phi)
    xyz = np.stack(
        [r * np.sin(theta) * np.cos(phi), r * np.sin(theta) * np.sin(phi), r * np.cos(theta) + 0.0 * phi], -1
    )
    i = np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)[None, :]
    faces = np.stack([i, i + columns + 1, i + 1, i + 1, i + columns + 1, i + columns + 2], -1)
    return xyz.reshape(-1, 3).astype(np.float32), faces.reshape(-1, 3).astype(np.int32)


CASES = {
    "box36": box36,
    "sphere10k": lambda: bumpy_sphere(50, 100),
    "sphere81920": lambda: bumpy_sphere(160, 256),
    "sphere100k": lambda: bumpy_sphere(200, 250),
    "sphere1M": lambda: bumpy_sphere(500, 1000),
}


#: Seconds between two measurements: Dr.Jit's threads spin for a while after their work.
SETTLE = 0.05
#: Ray sets for which Embree is told that rays are coherent, and which the wide BVH traces in bundles.
COHERENT = ("camera", "shadow")
#: Rows of a group of rays in memory; those of the mark of rays that are wanted, and of the hits, behind the rays.
ROWS_OF_RAYS, WANTED, FOUND = 12, 7, 8


def make_rays(name: str, count: int, trace) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """Return origins, directions and the largest distance of each ray set; ``trace`` finds the hits to start from."""
    rng = np.random.default_rng(1)
    side = int(count**0.5)
    x, y = np.meshgrid(np.linspace(-0.55, 0.55, side), np.linspace(-0.55, 0.55, side))
    target = np.stack([x, y, np.full_like(x, -1.0)], -1).reshape(-1, 3)
    if name != "box36":
        target[:, :2] *= 0.75
    d = target / np.linalg.norm(target, axis=1, keepdims=True)
    o = np.broadcast_to(np.array([0.0, 0.0, 3.0]), d.shape)
    camera = (o.astype(np.float32), d.astype(np.float32), 1.0e18)
    t, normal, hit = trace(*camera)
    points = (o + t[:, None] * d)[hit]
    facing = normal[hit] * -np.sign((normal * d).sum(1))[hit][:, None]
    points = points + 1.0e-3 * facing
    light = np.array([0.3, 0.9, 0.6]) if name == "box36" else np.array([2.0, 2.0, 2.0])
    to_light = light - points
    order = rng.permutation(len(points))
    sphere = rng.normal(size=(len(points), 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    bounce = facing + 0.999 * sphere
    bounce /= np.linalg.norm(bounce, axis=1, keepdims=True)
    uniform = rng.normal(size=(count, 3))
    uniform /= np.linalg.norm(uniform, axis=1, keepdims=True)
    single = [
        ("camera", *camera),
        ("shadow", points, to_light, 0.999),  # as far as the light
        ("bounce", points[order], bounce[order], 1.0e18),
        ("random", rng.uniform(-1.0, 1.0, (count, 3)), uniform, 1.0e18),
    ]
    return {k: (np.ascontiguousarray(a, np.float32), np.ascontiguousarray(b, np.float32), t) for k, a, b, t in single}


class WarpQueries:
    """Closest and any hit of one backend on a pool of threads; a launch covers one tile of rays."""

    def __init__(self, vertices, faces, backend: str, width: int | None, threads: int):
        self._points = wp.array(vertices, dtype=wp.vec3, device="cpu")
        self._indices = wp.array(faces.reshape(-1), dtype=wp.int32, device="cpu")
        start = time.perf_counter()
        self.accelerator = Accelerator(self._points, self._indices, "cpu", backend, width=width)
        first = time.perf_counter()
        self.accelerator.rebuild()
        self.build_seconds = time.perf_counter() - first
        self.first_build_seconds = first - start
        start = time.perf_counter()
        self.accelerator.update()
        self.update_seconds = time.perf_counter() - start
        closest_hit, any_hit = make_intersect(backend, self.accelerator.width)

        @wp.kernel(module="unique", enable_backward=False)
        def closest_kernel(
            accel: Accel,
            origin: wp.array(dtype=wp.vec3),
            direction: wp.array(dtype=wp.vec3),
            t_max: wp.float32,
            first: wp.int32,
            hits_out: wp.array(dtype=RayHit),
        ):
            i = first + wp.tid()
            hits_out[i] = closest_hit(accel, origin[i], direction[i], t_max)

        @wp.kernel(module="unique", enable_backward=False)
        def any_kernel(
            accel: Accel,
            origin: wp.array(dtype=wp.vec3),
            direction: wp.array(dtype=wp.vec3),
            t_max: wp.float32,
            first: wp.int32,
            hits_out: wp.array(dtype=wp.bool),
        ):
            i = first + wp.tid()
            hits_out[i] = any_hit(accel, origin[i], direction[i], t_max)

        self._single = {"closest": (closest_kernel, RayHit), "any": (any_kernel, wp.bool)}
        self._in_rows = {}
        self._width = self.accelerator.width
        if backend == "wide":
            self._in_rows[True] = [_make_rows_kernel(of_all, self._width) for of_all in make_bundle(self._width)]
            if self.accelerator.data.below_root > 0:
                self._in_rows[False] = [_make_rows_kernel(_wanted(q), self._width) for q in make_each(self._width)]
        self._threads = threads
        # Not closed: idle threads, and the process ends with the benchmark.
        self._pool = concurrent.futures.ThreadPoolExecutor(threads)

    def load(self, origins, directions, t_max, coherent=False):
        """Move a ray set to Warp, where they are traced in rows, in rows; ``coherent``: the wide BVH traces bundles."""
        kernels, self._count = self._in_rows.get(coherent), len(origins)
        if kernels:
            width = self._width
            of_row = np.minimum(np.arange(-(-self._count // width) * width), self._count - 1).reshape(-1, 1, width)
            rays = np.zeros((len(of_row), ROWS_OF_RAYS, width), np.uint32)
            rays[:, :3] = origins.view(np.uint32)[of_row, np.arange(3)[:, None]]
            rays[:, 3:6] = directions.view(np.uint32)[of_row, np.arange(3)[:, None]]
            rays[:, 6] = np.float32(t_max).view(np.uint32)
            rays[:, WANTED] = 1
            self._rows = wp.array(rays.reshape(-1), dtype=wp.uint32, device="cpu")
            self._queries = {q: (k, [], self._rows) for q, k in zip(("closest", "any"), kernels, strict=True)}
        else:
            inputs = [wp.array(a, dtype=wp.vec3, device="cpu") for a in (origins, directions)]
            self._rows = None
            self._queries = {
                query: (kernel, [*inputs, t_max], wp.zeros(self._count, dtype=dtype, device="cpu"))
                for query, (kernel, dtype) in self._single.items()
            }

    def run(self, query: str) -> None:
        """Trace the loaded rays."""
        kernel, inputs, out = self._queries[query]
        launches = self._count if self._rows is None else -(-self._count // self._width)
        tile = -(-launches // (4 * self._threads))

        def launch(first):
            count = min(tile, launches - first)
            wp.launch(kernel, count, [self.accelerator.data, *inputs, first], [out], device="cpu")

        list(self._pool.map(launch, range(0, launches, tile)))

    def found(self, query: str) -> np.ndarray:
        """Return what the last run of a query found: hits with ``t`` and ``face``, or whether there are any."""
        if self._rows is None:
            return self._queries[query][2].numpy()
        rows = self._rows.numpy().reshape(-1, ROWS_OF_RAYS, self._width)[:, FOUND:].transpose(0, 2, 1)
        rows = np.ascontiguousarray(rows.reshape(-1, 4)[: self._count])
        return rows.view(RayHit.numpy_dtype())[:, 0] if query == "closest" else rows[:, 0] != 0


def _wanted(of_each):
    """Return the query ``of_each`` of ``each.py`` with the arguments of those of ``bundle.py``."""

    @wp.func
    def of_all(accel: Accel, rows: ROWS, rays: wp.int32, found: wp.int32):
        of_each(accel, rows, rays, rays + wp.static(WANTED), found)

    return of_all


def _make_rows_kernel(of_all, width: int):
    """Return the kernel that traces ``width`` rays a thread, which lie in rows, and leaves the hits there."""

    @wp.kernel(module="unique", enable_backward=False)
    def rows_kernel(accel: Accel, first: wp.int32, rows_out: ROWS):
        rays = wp.static(ROWS_OF_RAYS) * (first + wp.tid())
        of_all(accel, rows_out, rays, rays + wp.static(FOUND))

    return rows_kernel


class EmbreeQueries:
    """The same through Mitsuba's ``llvm_ad_rgb`` variant, which traces with Embree."""

    def __init__(self, vertices, faces, threads: int):
        import drjit as dr
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")
        dr.set_thread_count(threads)
        self._dr, self._mi = dr, mi
        mesh = mi.Mesh("mesh", len(vertices), len(faces))
        params = mi.traverse(mesh)
        params["vertex_positions"] = vertices.ravel()
        params["faces"] = faces.ravel().astype(np.uint32)
        params.update()
        self._scene = mi.load_dict({"type": "scene", "mesh": mesh})

    def load(self, origins, directions, t_max, coherent=False):
        """Move a ray set to Dr.Jit; ``coherent`` makes Embree trace packets."""
        mi = self._mi
        self._ray = mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(directions.T))
        self._ray.maxt = mi.Float(t_max if t_max < 1.0e17 else np.inf)
        self._dr.eval(self._ray)
        self._dr.sync_thread()
        self._coherent = coherent

    def run(self, query: str):
        """Trace the loaded rays."""
        if query == "any":
            result = self._scene.ray_test(self._ray, self._coherent, True)
        else:
            hit = self._scene.ray_intersect_preliminary(self._ray, self._coherent, True)
            result = (hit.t, hit.prim_uv, hit.prim_index)
        self._dr.eval(result)
        self._dr.sync_thread()


def main() -> None:
    """Run the cases and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--rays", type=int, default=1_000_000)
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--width", type=int, default=None, help="SIMD lanes; default: the host's")
    parser.add_argument("--no-embree", action="store_true")
    parser.add_argument("--json", help="write the results to this file")
    arguments = parser.parse_args()
    rows = []
    for case in arguments.cases:
        vertices, faces = CASES[case]()
        width = arguments.width or host_width()
        wide = WarpQueries(vertices, faces, "wide", width, arguments.threads)
        queries = {"wide": wide, "wp.Mesh": WarpQueries(vertices, faces, "warp", None, arguments.threads)}
        if not arguments.no_embree:
            try:
                queries["embree"] = EmbreeQueries(vertices, faces, arguments.threads)
            except ImportError:
                print("mitsuba is not installed: no comparison with Embree")
        print(
            f"{case}: {len(faces)} triangles, width {width}, build {wide.build_seconds:.3f} s, "
            f"refit {wide.update_seconds:.4f} s, {wide.accelerator.nbytes / len(faces):.0f} bytes a triangle; "
            f"wp.Mesh build {queries['wp.Mesh'].build_seconds:.3f} s"
        )

        def trace(o, d, t_max, wide=wide, vertices=vertices, faces=faces):
            wide.load(o, d, t_max)
            wide.run("closest")
            hits = wide.found("closest")
            corner = vertices[faces[np.maximum(hits["face"], 0)]]
            normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1.0e-30)
            return hits["t"], normal, hits["face"] >= 0

        for rays, (o, d, t_max) in make_rays(case, arguments.rays, trace).items():
            for q in queries.values():
                q.load(o, d, t_max, rays in COHERENT)
            for query in ("closest", "any"):
                seconds = {k: [] for k in queries}
                for repetition in range(arguments.repeat + 1):
                    for k, q in queries.items():
                        time.sleep(SETTLE)
                        start = time.perf_counter()
                        q.run(query)
                        if repetition:
                            seconds[k].append(time.perf_counter() - start)
                row = {"case": case, "rays": rays, "query": query}
                row |= {k: len(o) / statistics.median(s) / 1.0e6 for k, s in seconds.items()}
                for k in list(queries)[1:]:
                    row[f"wide/{k}"] = statistics.median(
                        a / b for a, b in zip(seconds[k], seconds["wide"], strict=True)
                    )
                rows.append(row)
                found = wide.found(query)
                hits = float((found["face"] >= 0 if query == "closest" else found).mean())
                text = "  ".join(f"{k} {v:6.2f}" for k, v in row.items() if isinstance(v, float))
                print(f"  {rays:7s} {query:8s} {text}  (hits {hits:.0%}; M rays/s)", flush=True)
    if arguments.json:
        with open(arguments.json, "w", encoding="utf-8") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
