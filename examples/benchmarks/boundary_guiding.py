"""What guiding gains, by scene and method: variance of the secondary boundary term at equal samples and equal time.

    python examples/benchmarks/boundary_guiding.py [--quick] [--output results.jsonl]

Derivative images of a moving mesh by the secondary term alone: its launches are made and timed by themselves. "uniform"
is the reference of the papers, edges by length and angle and directions uniform in the wedge; what only aiming can
reach, point and directional lights, gets half of the samples (``boundary.Projective(guiding=None)``). "unguided" aims
at the stripe of a light in which the edge is a silhouette.

Times are processor seconds of all threads. ``equal samples`` and ``equal time`` are the variance of uniform sampling,
the mean over the pixels of that between images of independent seeds, over the row's; for equal time, times the ratio of
the seconds of the term, whose structure is there. ``slope`` is that of the row's images on those of the k-d tree, the
noise of the latter taken out of the slope and made part of its standard error. ``gradient`` are the seconds of all
terms together at the same sample count; ``build`` and ``refresh`` are what a first gradient, and one after a small step
of the vertices, take longer, over these; what a step costs without guiding as well is left out of ``refresh``. MB is
the size of the structure.
"""

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from boundary_global import write_scenes
from boundary_renderers import Secondary
from boundary_soft_shadow import DIRECTION, SPHERE, write_scene
from common import Report, arguments, psdr

#: Seeds of a method: with equal ones the noise of two methods would be correlated, and slopes wrong.
SEEDS = 1000
FLOOR = """<shape type="rectangle" id="floor"><transform name="to_world"><scale value="4"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7"/></bsdf></shape>"""
#: The light of the soft shadow is replaced by these.
LIGHTS = {
    "hard shadow, point light": '<emitter type="point"><point name="position" x="1.2" y="-0.6" z="3.5"/>'
    '<rgb name="intensity" value="5"/></emitter>',
    "sun": '<emitter type="directional"><vector name="direction" x="-0.3" y="0.15" z="-1"/>'
    '<rgb name="irradiance" value="3"/></emitter>',
    "constant sky": '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>',
}


def write_all(folder: Path) -> dict[str, tuple[Path, str, tuple, int]]:
    """Write the scenes: name -> (file, what moves, along what, depth)."""
    soft = write_scene(folder)
    text = soft.read_text()
    head, _light, _rest = text.partition('    <shape type="rectangle" id="light">')
    scenes = {"soft shadow, area light": (soft, SPHERE, DIRECTION, 2)}
    for name, light in LIGHTS.items():
        file = folder / f"{name.split(',')[0].replace(' ', '_')}.xml"
        file.write_text(f"{head}    {light}\n</scene>\n")
        scenes[name] = (file, SPHERE, DIRECTION, 2)
    small = folder / "small_light.xml"
    wall = FLOOR.replace('"floor"', '"wall"').replace(
        '<scale value="4"/>', '<scale value="4"/><rotate x="1" angle="90"/><translate y="1.5"/>'
    )
    small.write_text(
        text.replace('<scale value="0.2"/>', '<scale value="0.05"/>').replace("</scene>", f"{wall}</scene>")
    )
    scenes["small light, a wall, depth 3"] = (small, SPHERE, DIRECTION, 3)
    cornell, _ball = write_scenes(folder).values()
    scenes["Cornell box, depth 4"] = (cornell, "small-box.vertex_positions", (1.0, 0.0, 0.4), 4)
    return scenes


def methods() -> dict:
    """Return the methods that are compared; the first one is the reference."""
    boundary, guiding = psdr.boundary, psdr.guiding
    return {
        "uniform": boundary.Projective(guiding=None),
        "unguided": boundary.PathSpace(),
        "KdTree": boundary.PathSpace(guiding=guiding.KdTree()),
        "Octree": boundary.PathSpace(guiding=guiding.Octree()),
        "Grid": boundary.PathSpace(guiding=guiding.Grid()),
        "Projective": boundary.Projective(guiding=guiding.KdTree()),
    }


def run(renderer: Secondary, spp: int, images: int, reuse: int, seed: int) -> tuple[dict, np.ndarray]:
    """Measure one method on one scene with seeds from ``seed`` on; return its row and its images."""
    renderer.image(1, 0)  # compile
    renderer.gradient(1, 0)
    renderer.forget()
    first = _timed(renderer.gradient, spp, seed)[0]
    gradient = statistics.median(_timed(renderer.gradient, spp, seed + 1 + i)[0] for i in range(reuse))
    timed = [_timed(renderer.image, spp, seed + 100 + i) for i in range(images)]
    memory = renderer.memory
    moved = []
    for step in range(1, reuse + 1):
        renderer.move(step)
        moved.append(_timed(renderer.gradient, spp, seed + 200 + step)[0])
    found = np.stack([image for _seconds, image in timed])
    row = {
        "variance": float(found.var(axis=0, ddof=1).mean()),
        "seconds": statistics.median(seconds for seconds, _image in timed),
        "gradient": gradient,
        "build": first - gradient,
        "refresh": statistics.median(moved) - gradient,
        "MB": memory,
    }
    return row, found


def _timed(image: Callable, spp: int, seed: int) -> tuple[float, np.ndarray]:
    start = time.process_time()
    found = image(spp, seed)
    return time.process_time() - start, found


def main() -> None:
    """Run and print the tables."""
    options = arguments(__doc__).parse_args()
    resolution, spp, images = (32, 16, 8) if options.quick else (64, 64, 16)
    reuse = options.repeat or (3 if options.quick else 7)
    psdr.set_workers(options.threads)
    report = Report("guiding", options.output)
    with tempfile.TemporaryDirectory() as name:
        for scene, (file, vertices, direction, depth) in write_all(Path(name)).items():
            rows, results = [], {}
            for number, (label, method) in enumerate(methods().items()):
                renderer = Secondary(file, resolution, vertices, direction, method, depth)
                row, results[label] = run(renderer, spp, images, reuse, SEEDS * number)
                rows.append({"method": label} | row)
            rows = compare(rows, results)
            report.table(f"{scene}: {resolution}^2 pixels, {spp} spp, {images} images", rows)


def compare(rows: list[dict], results: dict[str, np.ndarray]) -> list[dict]:
    """Relate rows to the first one and to what a step costs unguided, and images to those of the k-d tree."""
    reference, unguided = rows[:2]
    tree = results["KdTree"]
    first, second = tree[: len(tree) // 2], tree[len(tree) // 2 :]
    # Independent halves: the square of a mean would have its noise in it.
    square = (first.mean(axis=0) * second.mean(axis=0)).sum()

    def slopes_of(images: np.ndarray, reference: np.ndarray) -> np.ndarray:
        return (images * reference.mean(axis=0)).sum(axis=(1, 2, 3)) / square

    own = np.concatenate([slopes_of(first, second), slopes_of(second, first)])
    compared = []
    for row in rows:
        samples = reference["variance"] / max(row["variance"], 1e-300)
        slopes = own if row["method"] == "KdTree" else slopes_of(results[row["method"]], tree)
        compared.append(
            {
                "method": row["method"],
                "equal samples": samples,
                "equal time": samples * reference["seconds"] / row["seconds"],
                "slope": float(slopes.mean()),
                "its error": float(np.hypot(slopes.std(ddof=1), own.std(ddof=1)) / len(slopes) ** 0.5),
                "seconds": row["seconds"],
                "gradient": row["gradient"],
                "build": max(row["build"], 0.0) / row["gradient"],
                "refresh": max(row["refresh"] - unguided["refresh"], 0.0) / row["gradient"],
                "MB": row["MB"],
            }
        )
    return compared


if __name__ == "__main__":
    main()
