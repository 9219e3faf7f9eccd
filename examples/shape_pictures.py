"""Pictures of ``recover_shape.py``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

import warp_psdr as psdr
from warp_psdr import plots
from warp_psdr.view import edge_fields
from warp_psdr.view.vtk_window import open_plotter

#: Pixels along a side of the pictures of the mesh and of a frame, and the views that they show.
PICTURE, FRAME, SHOWN = 160, 144, (0, 1, 5, 7)
#: Samples a pixel of the first gradient, and of the boundary samples that are drawn, of one view.
GRADIENT_SPP, DRAWN_SPP, DRAWN_VIEW = 32, 8, 0
#: Milliseconds of a frame of the animation, and of its last one.
FRAME_MS, LAST_MS = 80, 2000


def draw_result(folder: Path, truth: tuple, start: tuple, found: tuple, render: Callable) -> None:
    rows = [render(mesh, SHOWN, PICTURE) for mesh in (truth, start, found)]
    titles = [f"{what}, view {i}" for what in ("photograph", "start", "recovered") for i in SHOWN]
    plots.side_by_side(folder / "result.png", [image for row in rows for image in row], titles, columns=len(SHOWN))


def draw_curves(folder: Path, losses: list[float], distances: dict[int, float]) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    plots.loss_curve(folder / "loss.png", losses, title="loss, with the noise of the renderings", ylabel="mean square")
    figure = Figure(figsize=(7.0, 4.2), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(list(distances), list(distances.values()), marker=".")
    axes.set(yscale="log", xlabel="step", ylabel="mean distance to the true surface, world units")
    axes.grid(True, which="both", alpha=0.25)
    plots.write_picture(folder / "distance.png", lambda file: figure.savefig(file, format="png"))


def animate(path: Path, truth: tuple, meshes: list[tuple], render: Callable) -> None:
    """Write a GIF of the meshes, two views of each beside the photographs."""
    from PIL import Image

    views = SHOWN[:2]
    photographs = [plots.tonemap(image) for image in render(truth, views, FRAME)]
    frames = []
    for mesh in meshes:
        images = [plots.tonemap(image) for image in render(mesh, views, FRAME)]
        rows = [np.concatenate(row, axis=1) for row in (photographs, images)]
        pixels = np.round(255.0 * np.concatenate(rows, axis=0)).astype(np.uint8)
        frames.append(Image.fromarray(pixels).quantize(128, dither=Image.Dither.NONE))
    times = [FRAME_MS] * (len(frames) - 1) + [LAST_MS]
    plots.write_picture(
        path,
        lambda file: frames[0].save(
            file, format="GIF", save_all=True, append_images=frames[1:], duration=times, loop=0
        ),
    )


def draw_boundary(folder: Path, params, photos: list, truth, integrator, name: str) -> None:
    """Draw the first gradient on the surface, and the boundary term's samples on the edges of the true shape."""
    try:
        _draw_gradient(folder, params, photos, integrator, name)
        draw_edges(folder, truth, integrator, name)
    except RuntimeError as problem:  # no OpenGL on this machine: everything else does without
        print(f"not drawn: {problem}")


def _adjoint(params, photos: list, integrator, view: int) -> np.ndarray:
    """Derivative of a view's mean square error by its pixels."""
    image = psdr.render(params.scene, sensor=view, integrator=integrator, spp=GRADIENT_SPP).numpy()
    return (2.0 / image.size) * (image - photos[view])


def _draw_gradient(folder: Path, params, photos: list, integrator, name: str) -> None:
    params.zero_grad()
    for view in range(len(photos)):
        adjoint = _adjoint(params, photos, integrator, view)
        psdr.render_backward(
            params.scene, params, adjoint, sensor=view, integrator=integrator, spp=GRADIENT_SPP, seed=1
        )
    gradient = -params[name].grad.numpy()  # where the shape should move
    params.zero_grad()
    psdr.view(params.scene, params, fields={name: gradient}, screenshot=folder / "gradient.png").close()


def draw_edges(folder: Path, params, integrator, name: str, sensor: int = DRAWN_VIEW) -> None:
    """Draw on a shape's edges what the boundary term of a view's mean radiance is estimated from.

    Left and right in ``samples.png``: edges that the camera sees, and edges of shadows. ``density.png``: how
    densely the latter are sampled.
    """
    import pyvista
    from PIL import Image

    camera = params.scene.camera(sensor)
    adjoint = np.full((camera.crop_height, camera.crop_width, 3), 1.0 / (camera.crop_height * camera.crop_width))
    options = {"sensor": sensor, "integrator": integrator}
    samples = edge_fields.boundary_samples(params.scene, params, adjoint, spp=DRAWN_SPP, **options)
    density = edge_fields.edge_density(params.scene, params, **options)
    vertices = params[name].numpy()
    shape = next(s for s in params.scene.description.shapes if f"{s.path}.vertex_positions" == name)
    surface = pyvista.PolyData.from_regular_faces(vertices, shape.faces)
    eye = np.asarray(params.scene.description.sensors[sensor].to_world)[:3, 3]
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0)) - [0.0, 0.18, 0.0]  # room for the colour bar
    pull = "pull [W/m²/sr of the mean radiance per world unit]"
    panels = {
        "samples": {
            "edges that the camera sees": lambda p: edge_fields.draw_samples(
                p, samples.of_kind("primary"), least=0.3, size=6.0, title=pull
            ),
            "edges of shadows": lambda p: edge_fields.draw_samples(p, samples.of_kind("secondary"), title=f"{pull} "),
        },
        "density": {"edges of shadows": lambda p: edge_fields.draw_density(p, density)},
    }
    for stem, drawings in panels.items():
        plotter = open_plotter(1, len(drawings), (560 * len(drawings), 600), off_screen=True)
        for column, (title, drawing) in enumerate(drawings.items()):
            plotter.subplot(0, column)
            plotter.set_background((0.86, 0.87, 0.88))
            plotter.add_light(pyvista.Light(light_type="headlight", intensity=0.8), only_active=True)
            plotter.add_mesh(surface, color=(0.78, 0.78, 0.78), ambient=0.15)
            plotter.add_text(title, position=(0.02, 0.95), viewport=True, font_size=11, color="black")
            drawing(plotter)
            plotter.camera_position = [eye, middle, (0, 1, 0)]
            plotter.camera.view_angle = 32.0
        image = Image.fromarray(plotter.screenshot(None, return_img=True))
        plots.write_picture(folder / f"{stem}.png", lambda file, image=image: image.save(file, format="PNG"))
        plotter.close()
