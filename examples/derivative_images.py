"""Draws how every pixel of the Cornell box changes with one wall's albedo, with the light, and with both at once.

Forward mode: one render per derivative, the same cost whatever the number of pixels. Red pixels grow brighter, blue
ones darker; the pictures say where their colours end.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
#: Direction in parameter space -> title. A direction has the parameter's shape; several parameters may move together.
DIRECTIONS: dict[str, tuple[dict[str, object], str]] = {
    "wall": ({"red.reflectance.value": [1.0, 0.0, 0.0]}, "more red in the red wall"),
    "light": ({"light.emitter.radiance.value": np.ones(3)}, "a brighter light"),
    "trade": (
        {"light.emitter.radiance.value": [1.8, 1.4, 0.7], "white.reflectance.value": [-0.09, -0.07, -0.07]},
        "10 % more light and 10 % less white paint",
    ),
}

#: The parameters move along a direction t: values are per unit of t.
UNIT = "d radiance / dt [W/m²/sr]"


def main(folder: Path = ROOT / "out" / "examples", resolution: int = 256, spp: int = 64) -> None:
    scene = psdr.load_file(ROOT / "scenes" / "cornell_box.xml", resolution=resolution)
    params = psdr.traverse(scene)
    folder.mkdir(parents=True, exist_ok=True)
    for stem, (tangents, title) in DIRECTIONS.items():
        derivative = psdr.render_forward(scene, params, tangents, spp=spp, seed=0).numpy()
        psdr.image_io.write_image(folder / f"derivative_{stem}.exr", derivative)
        psdr.plots.derivative_image(
            folder / f"derivative_{stem}.png", derivative, percentile=98.0, title=title, unit=UNIT
        )
        print(f"wrote {folder / f'derivative_{stem}.png'}")


if __name__ == "__main__":
    main()
