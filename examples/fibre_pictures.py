"""Pictures of ``fit_fibres.py``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warp_psdr import plots
from warp_psdr.scene.kinds.curve import Curves
from warp_psdr.view.tubes import tube_field
from warp_psdr.view.vtk_window import open_plotter

#: Pixels along a side of a panel, angle of view in degrees, and the percentile of magnitudes at which colours end.
PANEL, ANGLE, PERCENTILE = 620, 47.0, 97.0
BACKGROUND = (0.62, 0.62, 0.62)  # not white, which means zero


def draw_fields(
    path: Path, curves: Curves, points: np.ndarray, fields: dict[tuple[str, str], np.ndarray], eye: list[float]
) -> None:
    """Draw fields on fibres side by side: red where the surface moves outwards, blue where inwards.

    Args:
        path: PNG file to write.
        curves: the segments of the fibres.
        points: (N, 4) control points.
        fields: what stands above a panel, and at its colour bar -> (N, 4), by control points.
        eye: where the camera stands; it looks at the centre of the world.

    Raises:
        RuntimeError: VTK cannot draw on this machine.
    """
    import pyvista
    from PIL import Image

    plotter = open_plotter(1, len(fields), (PANEL * len(fields), PANEL + 60), off_screen=True)
    for column, ((title, unit), values) in enumerate(fields.items()):
        field = tube_field(curves, points, np.eye(4), values)[0]
        limit = plots.symmetric_limit(field.values, PERCENTILE)
        plotter.subplot(0, column)
        plotter.set_background(BACKGROUND)
        plotter.add_light(pyvista.Light(light_type="headlight", intensity=0.9), only_active=True)
        plotter.add_mesh(
            pyvista.PolyData.from_regular_faces(field.vertices, field.faces),
            scalars=field.values,
            clim=[-limit, limit],
            cmap=plots.diverging_colormap(),
            ambient=0.3,
            scalar_bar_args={
                "title": f"{unit}\n",
                "color": "black",
                "fmt": "%.1e",
                "n_labels": 3,
                "title_font_size": 15,
                "label_font_size": 15,
                "position_x": 0.1,
                "position_y": 0.01,
                "width": 0.8,
                "height": 0.11,
            },
        )
        plotter.add_text(title, position=(0.02, 0.95), viewport=True, font_size=11, color="black")
        plotter.camera_position = [eye, (0.0, -0.08, 0.0), (0.0, 1.0, 0.0)]  # room for the colour bar
        plotter.camera.view_angle = ANGLE
    image = Image.fromarray(plotter.screenshot(None, return_img=True))
    plots.write_picture(path, lambda file: image.save(file, format="PNG"))
    plotter.close()
