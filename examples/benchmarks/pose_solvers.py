"""A pose from shadows alone: Adam on a tape, as in ``pose_from_shadow.py``, against ``psdr.solve``.

    python examples/benchmarks/pose_solvers.py [--quick] [--output docs/data/photographs.jsonl]

Both start from the same pose, 40 degrees and a third of a unit off, and see the same photograph. Adam's learning rates
were tuned by hand for this scene; ``psdr.solve`` has none.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from common import ROOT, Report, arguments, psdr
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(ROOT / "examples"))

import bunny_data
import pose_from_shadow as example
import recovery

NAMES = ("turn x", "turn y", "turn z", "x", "y", "z")


def by_adam(width: int, steps: int) -> dict:
    """Return a row: the example itself."""
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        report = example.main(Path(folder), width=width, steps=steps)
    degrees, units = (
        report[f"{what}: start, found"][1] for what in ("rotation error, degrees", "translation error, units")
    )
    return row_of("Adam on a tape", steps, degrees, units, began) | {"truth within 95 % bars": "no bars"}


def by_solve(width: int) -> dict:
    """Return a row: least squares of the same photograph from the same start."""
    vertices, faces = bunny_data.read_bunny()
    local = example.SIZE * (vertices - 0.5 * (vertices.min(axis=0) + vertices.max(axis=0)))
    params = example.load(local, faces, width)
    scene, integrator = params.scene, psdr.PathIntegrator(max_depth=2)

    def placed(x: np.ndarray) -> dict[str, np.ndarray]:
        return {example.POSITIONS: Rotation.from_rotvec(x[:3]).apply(local) + x[3:]}

    pose = psdr.unknowns.Function(placed, np.concatenate(example.START), NAMES)
    pose.restore(params, np.concatenate(example.TRUTH).astype(float))
    photograph = psdr.render(scene, integrator=integrator, spp=256, seed=example.PHOTO_SEED).numpy()
    pose.restore(params, np.concatenate(example.START).astype(float))
    began = time.process_time()
    found = psdr.solve(
        scene, params, photograph, unknowns=[pose], integrator=integrator, spp=16, steps=30, progress=print
    )
    print(found, flush=True)
    errors = recovery.pose_errors((found.values[:3], found.values[3:]), example.TRUTH)
    low, high = found.interval()
    held = (low < np.concatenate(example.TRUTH)) & (np.concatenate(example.TRUTH) < high)
    return row_of("psdr.solve", len(found.steps), *errors, began) | {"truth within 95 % bars": f"{held.sum()} of 6"}


def row_of(solver: str, steps: int, degrees: float, units: float, began: float) -> dict:
    """Return what both rows have; processor time since ``began``, compiling included."""
    used = time.process_time() - began
    return {"solver": solver, "steps": steps, "degrees off": degrees, "units off": units, "processor time [s]": used}


def main() -> None:
    """Run both and report them."""
    options = arguments(__doc__).parse_args()
    width = 48 if options.quick else 96
    rows = [by_solve(width), by_adam(width, 100 if options.quick else 200)]
    Report("photographs", options.output).table(f"pose of a bunny from its shadows, {width} pixels wide", rows)


if __name__ == "__main__":
    main()
