"""Films a pulse of light on its way through the Cornell box, and how every frame changes as the small box moves.

A frame is a time gate: it shows the light that has gone some way, from the lamp by way of the walls to the camera.
Below each frame is its derivative by the position of the small box, in forward mode: shadows and silhouettes move, and
light comes earlier or later, so that it leaves one frame (blue) and enters the next (red).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
#: Optical path length of the first frame and from frame to frame, world units; the camera is 3.9 from the middle.
START, WIDTH, FRAMES = 3.3, 0.5, 12
#: Frames in the picture.
SHOWN = (2, 4, 5, 6, 8)
#: What moves, and how: it slides along the floor.
BOX = "small-box.vertex_positions"
MOTION = np.float32([1.0, 0.0, 0.0])


def film(resolution: int) -> dict[str, object]:
    """Return a film of frames, each as long as the lamp's pulse."""
    return {
        "type": "transient_hdr_film",
        "width": resolution,
        "height": resolution,
        "rfilter": {"type": "box"},
        "temporal_bins": FRAMES,
        "bin_width_opl": WIDTH,
        "start_opl": START,
    }


def main(folder: Path = ROOT / "out" / "examples", resolution: int = 128, spp: int = 256) -> None:
    description = psdr.cornell_box()
    description["sensor"]["film"] = film(resolution)
    scene = psdr.load_dict(description)
    params = psdr.traverse(scene)
    integrator = psdr.PathIntegrator(max_depth=4)
    frames = psdr.render(scene, integrator=integrator, spp=spp).numpy()
    direction = {BOX: np.zeros_like(params[BOX].numpy()) + MOTION}
    derivatives = psdr.render_forward(scene, params, direction, integrator=integrator, spp=spp).numpy()
    folder.mkdir(parents=True, exist_ok=True)
    titles = [f"{START + WIDTH * b:.1f} to {START + WIDTH * (b + 1):.1f}" for b in SHOWN]
    psdr.plots.side_by_side(
        folder / "transient.png",
        [frames[:, :, b] for b in SHOWN],
        titles,
        columns=len(SHOWN),
        exposure=1.5,
        title="light by the way that it has gone, and its derivative as the small box slides to the right",
        differences={f"derivative, {title}": derivatives[:, :, b] for b, title in zip(SHOWN, titles, strict=True)},
        percentile=98.0,
    )
    print(f"wrote {folder / 'transient.png'}")
    shares = frames.sum(axis=(0, 1, 3)) / frames.sum()
    print("share of the light in each frame:", " ".join(f"{100.0 * share:.1f} %" for share in shares))


if __name__ == "__main__":
    main()
