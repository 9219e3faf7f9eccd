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
#: Samples a pixel of the first gradient, and of the boundary samples that are drawn.
GRADIENT_SPP, DRAWN_SPP = 32, 2
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


def draw_boundary(folder: Path, params, photos: list, integrator, name: str, *, first: bool) -> None:
    """Draw the gradient on the surface (``first``), or the boundary samples and the density of the edges."""
    try:
        (_draw_gradient if first else _draw_edges)(folder, params, photos, integrator, name)
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


def _draw_edges(folder: Path, params, photos: list, integrator, name: str) -> None:
    import pyvista
    from PIL import Image

    adjoint = _adjoint(params, photos, integrator, 0)
    samples = edge_fields.boundary_samples(params.scene, params, adjoint, integrator=integrator, spp=DRAWN_SPP)
    density = edge_fields.edge_density(params.scene, params, integrator=integrator)
    vertices = params[name].numpy()
    shape = next(s for s in params.scene.description.shapes if f"{s.path}.vertex_positions" == name)
    surface = pyvista.PolyData.from_regular_faces(vertices, shape.faces)
    camera = params.scene.description.sensors[0].to_world
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    for stem in ("samples", "density"):
        plotter = open_plotter(1, 1, (720, 720), off_screen=True)
        plotter.set_background((0.86, 0.87, 0.88))
        plotter.add_mesh(surface, color=(0.72, 0.72, 0.72), show_edges=stem == "samples", edge_opacity=0.2)
        if stem == "samples":
            edge_fields.draw_samples(plotter, samples)
        else:
            edge_fields.draw_density(plotter, density)
        plotter.camera_position = [np.asarray(camera)[:3, 3], middle, (0, 1, 0)]
        image = Image.fromarray(plotter.screenshot(None, return_img=True))
        plots.write_picture(folder / f"{stem}.png", lambda file, image=image: image.save(file, format="PNG"))
        plotter.close()
