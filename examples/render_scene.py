"""Renders the Cornell box: ``out/examples/cornell_box.exr`` holds radiance, ``cornell_box.png`` is for looking at."""

from __future__ import annotations

from pathlib import Path

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]


def main(folder: Path = ROOT / "out" / "examples", resolution: int = 256, spp: int = 64) -> None:
    scene = psdr.load_file(ROOT / "scenes" / "cornell_box.xml", resolution=resolution)
    image = psdr.render(scene, spp=spp, seed=0)
    for suffix in (".exr", ".png"):
        psdr.image_io.write_image(folder / f"cornell_box{suffix}", image)
    print(f"wrote {folder / 'cornell_box.png'}")


if __name__ == "__main__":
    main()
