"""Moving shapes in global illumination: this renderer, all terms, against Mitsuba 3's ``prb_projective``.

    python examples/benchmarks/boundary_global.py [--quick] [--output results.jsonl]

Two scenes: the Cornell box whose small box slides over the floor (depth 6), and the same room around a ball of 100,000
triangles that moves (depth 4). Meshes are welded, which Mitsuba needs. All sample counts are those of the column spp.
Errors are those of the derivative image, relative to its root mean square, against a long image of the *same* renderer:
Mitsuba's is wrong where the box touches the floor, so that only its noise is compared. Its default, the octree, is left
out: it takes minutes a gradient here. MB of ours is the peak of the whole process before Mitsuba is imported.
"seconds a step": of an image and the gradient of its sum, that is reverse mode, timed in turns.
"""

import resource
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from boundary_renderers import Ours, Theirs, long_image, measure
from common import ROOT, Report, arguments, import_mitsuba, in_turns, median, psdr

from scenes import bumpy_sphere, write_ply

SPP = 16
MITSUBA = "Mitsuba, none"
BOX, BALL = "small-box.vertex_positions", "ball.vertex_positions"
#: Rows and columns of the ball: some 2 * 224 * 224 triangles.
ROWS = 224
SCENES = {
    "Cornell box, a box slides": (BOX, (1.0, 0.0, 0.4), 6),
    "a ball of 100k triangles moves": (BALL, (1.0, 0.3, 0.2), 4),
}


def _mesh(name: str) -> str:
    return (
        f'<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>'
        '<boolean name="face_normals" value="true"/><ref id="white"/></shape>'
    )


def write_scenes(folder: Path) -> dict[str, Path]:
    """Write both scenes; what moves is a welded mesh instead of the file's cube."""
    text = (ROOT / "scenes" / "cornell_box.xml").read_text()
    head, _cube, rest = text.partition('    <shape type="cube" id="small-box">')
    rest = rest.partition("</shape>")[2]
    cube = trimesh.creation.box(extents=(0.6, 0.6, 0.6))
    turn = np.radians(-17.0)
    rotation = np.array([[np.cos(turn), 0.0, np.sin(turn)], [0.0, 1.0, 0.0], [-np.sin(turn), 0.0, np.cos(turn)]])
    write_ply(folder / "small-box.ply", np.asarray(cube.vertices) @ rotation.T + [0.335, -0.7, 0.38], cube.faces)
    vertices, _texcoords, faces = bumpy_sphere(ROWS, ROWS)
    ball = trimesh.Trimesh(vertices, faces)  # merges the vertices of the seam and of the poles
    ball.update_faces(ball.nondegenerate_faces())
    write_ply(folder / "ball.ply", 0.3 * np.asarray(ball.vertices) + [0.335, -0.5, 0.38], ball.faces)
    files = {}
    for scene, name in zip(SCENES, ("small-box", "ball"), strict=True):
        files[scene] = folder / f"{name}.xml"
        files[scene].write_text(head + _mesh(name) + rest)
    return files


def main() -> None:
    """Run and print the tables."""
    options = arguments(__doc__).parse_args()
    repeat = options.repeat or (3 if options.quick else 7)
    resolution, long = (64, 64) if options.quick else (128, 128)
    psdr.set_workers(options.threads)
    report = Report("moving shapes in global illumination", options.output)
    with tempfile.TemporaryDirectory() as name:
        files = write_scenes(Path(name))
        rows = {scene: [] for scene in SCENES}
        ours = {}
        for scene, (vertices, direction, depth) in SCENES.items():
            methods = {"unguided": None, "KdTree": psdr.guiding.KdTree(), "Octree": psdr.guiding.Octree()}
            ours[scene] = {
                label: Ours(files[scene], resolution, vertices, direction, guiding, depth=depth, all_terms=True)
                for label, guiding in methods.items()
            }
            reference = long_image(ours[scene]["KdTree"], long)
            for label, renderer in ours[scene].items():
                row = measure(renderer, SPP, repeat, reference, first=False)
                row["MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
                rows[scene].append({"method": label} | row)
        mi, dr = import_mitsuba(options.threads)
        for scene, (vertices, direction, depth) in SCENES.items():
            counts = {"sppc": None, "sppp": None, "sppi": None, "guiding": "none"}
            settings = {"type": "prb_projective", "max_depth": depth, **counts}
            renderer = Theirs(mi, dr, files[scene], resolution, vertices, direction, settings)
            row = measure(renderer, SPP, repeat, long_image(renderer, long, images=4), first=True)
            rows[scene].append({"method": MITSUBA} | row)
            steps = {name: partial(r.step, SPP) for name, r in (ours[scene] | {MITSUBA: renderer}).items()}
            times = in_turns(steps, repeat)
            for row in rows[scene]:
                row["seconds a step"] = median(times, row["method"])
                row["gain"] = rows[scene][-1]["error^2 x time"] / row["error^2 x time"]
            report.table(f"{scene}: {resolution}^2 pixels, depth {depth}, medians of {repeat}", rows[scene])


if __name__ == "__main__":
    main()
