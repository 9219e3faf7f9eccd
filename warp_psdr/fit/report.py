"""What a fit leaves behind: pictures, parameter files, gradient pictures and a summary.

In the output folder: ``views/`` and ``start/`` (every view at the end and at the start, EXR and PNG), ``views.png``
(target, start and recovered side by side), ``loss.png``, ``parameters/`` (NumPy files; EXR and PNG of textures and
environment maps), ``gradients/`` (at the start and at the end), ``summary.json``.
"""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr import html, image_io, plots
from warp_psdr.files import write_atomic
from warp_psdr.progress import progress

if TYPE_CHECKING:
    from warp_psdr.fit.run import FitResult, Problem

SUMMARY, VIEWS = "summary.json", "views.png"
#: Seeds of the final pictures lie beyond those of the steps, which stop below 2^31, so that nothing is fitted to them.
PICTURE_SEED = 2**31
#: Smallest mean squared error that a PSNR is computed from: 120 dB, beyond what 32-bit images can differ in.
LEAST_ERROR = 1e-12

#: Losses with their units, for plots.
LOSS_NAMES = {
    "l1": "L1 loss [W/m²/sr]",
    "l2": "L2 loss [(W/m²/sr)²]",
    "huber": "Huber loss [(W/m²/sr)²]",
    "relative_l2": "relative L2 loss (no unit)",
}


def write_start(problem: Problem) -> None:
    """Write the views and the gradients before the first step."""
    _write_views(problem, problem.config.output / "start", "start")
    gradients = problem.gradients(0)
    write_gradients(problem.config.output / "gradients", problem.scene, problem.params, gradients, "_start")


def write_report(problem: Problem, losses: np.ndarray) -> tuple[float, ...]:
    """Write all results and return the PSNR of every view in decibels."""
    output = problem.config.output
    images = _write_views(problem, output / "views", "end")
    scores = tuple(psnr(image, target) for image, target in zip(images, problem.targets, strict=True))
    starts = [image_io.read_image(output / "start" / f"view_{i}.exr") for i in range(len(images))]
    rows = {"target": problem.targets, "start": starts, "recovered": images}
    titles = [f"target, view {i}" for i in range(len(images))] + ["start"] * len(images)
    titles += [f"recovered, {score:.1f} dB" for score in scores]
    pictures = [image for row in rows.values() for image in row]
    plots.side_by_side(output / VIEWS, pictures, titles, columns=len(images))
    plots.loss_curve(output / "loss.png", losses, ylabel=LOSS_NAMES[problem.config.loss])
    write_parameters(output / "parameters", problem.values())
    gradients = problem.gradients(len(losses))
    notes = write_gradients(output / "gradients", problem.scene, problem.params, gradients, "_end")
    summary = {
        "scene": str(problem.config.scene),
        "parameters": {name: list(value.shape) for name, value in problem.values().items()},
        "iterations": len(losses),
        "loss": {"name": problem.config.loss, "first": losses[0], "last": losses[-1], "least": losses.min()},
        "psnr": [round(score, 3) for score in scores],
        "invalid_samples": problem.invalid(),
        "psnr_meaning": "decibels; sRGB-encoded, clipped to [0, 1]",
        "mean_squared_error": [
            float(np.mean((image - target) ** 2)) for image, target in zip(images, problem.targets, strict=True)
        ],
        "notes": notes,
    }
    text = json.dumps(summary, indent=2) + "\n"
    write_atomic(output / SUMMARY, lambda file: file.write(text.encode()))
    return scores


def in_one_line(result: FitResult) -> str:
    """Return a fit's outcome: steps, losses, decibels, and the samples that were dropped, if any were."""
    losses = result.losses
    parts = [f"{len(losses)} steps" if result.completed else f"stopped after {len(losses)} steps"]
    if len(losses):
        parts.append(f"loss {losses[0]:.4g} -> {losses[-1]:.4g}")
    if result.psnr:
        parts.append(f"PSNR of the views {', '.join(f'{value:.1f}' for value in result.psnr)} dB")
    dropped = sum(result.invalid.values())
    if dropped:
        parts.append(f"{dropped} samples were not finite")
    return "; ".join([*parts, f"results in {result.output}"])


def shown(result: FitResult) -> str:
    """Return what a notebook shows of a fit."""
    rows = [
        (name, " x ".join(map(str, value.shape)), f"{value.min():.4g}", f"{value.mean():.4g}", f"{value.max():.4g}")
        for name, value in result.parameters.items()
    ]
    text = html.preformatted(in_one_line(result)) + html.table(("parameter", "shape", "least", "mean", "most"), rows)
    picture = result.output / VIEWS
    if result.completed and picture.is_file():
        data = base64.b64encode(picture.read_bytes()).decode()
        text += f'<img alt="target, start and recovered" src="data:image/png;base64,{data}"/>'
    return text


def psnr(image: np.ndarray, target: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio of two linear images as they are displayed: sRGB, peak 1; decibels."""
    error = float(np.mean((plots.tonemap(image) - plots.tonemap(target)) ** 2))
    return -10.0 * math.log10(max(error, LEAST_ERROR))


def write_parameters(folder: Path, values: Mapping[str, np.ndarray]) -> None:
    """Write every value as ``.npy`` and, where it is a picture, as EXR and as an enlarged PNG with its scale."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, stem in file_stems(values).items():
        value = values[name]
        _write_array(folder / f"{stem}.npy", value)
        if is_picture(value):
            image_io.write_image(folder / f"{stem}.exr", value)
            quantity = "value of the parameter"
            plots.side_by_side(folder / f"{stem}.png", [value], [name], quantity=quantity)


def write_gradients(
    folder: Path, scene: Any, params: Any, gradients: Mapping[str, np.ndarray], suffix: str = ""
) -> list[str]:
    """Write gradients as ``.npy`` and as pictures, and return notes on what could not be drawn.

    Textures and environment maps are drawn flat with a symmetric colour map; vertex fields on their meshes.
    """
    from warp_psdr.view.viewer import NotDrawableError, view

    folder.mkdir(parents=True, exist_ok=True)
    notes = []
    for name, stem in file_stems(gradients).items():
        gradient = gradients[name]
        path = folder / f"{stem}{suffix}"
        _write_array(Path(f"{path}.npy"), gradient)
        if is_picture(gradient):
            title = f"gradient of the loss: {name}"
            plots.derivative_image(f"{path}.png", gradient, title=title, unit=plots.LOSS_GRADIENT)
        elif ".vertex_" in name:
            try:
                view(scene, params, fields={name: gradient}, screenshot=f"{path}.png").close()
            except (RuntimeError, NotDrawableError) as error:  # no OpenGL here, or a field without a look on a surface
                notes.append(f"{path.name}.png not drawn: {error}")
    return notes


def write_picture(stem: Path, image: np.ndarray) -> None:
    """Write a linear image as ``<stem>.exr`` and, tone-mapped, as ``<stem>.png``."""
    image_io.write_image(f"{stem}.exr", image)
    image_io.write_image(f"{stem}.png", image)


def is_picture(value: np.ndarray) -> bool:
    """Whether an array is a texture or an environment map."""
    return value.ndim == 3 and value.shape[-1] in (1, 3)


def file_stems(names: Iterable[str]) -> dict[str, str]:
    """Return a different and harmless file name for every parameter name."""
    stems: dict[str, str] = {}
    for name in names:
        stem = re.sub(r"[^\w.-]+", "_", name).lstrip(".") or "parameter"
        while stem in stems.values():
            stem += "_"
        stems[name] = stem
    return stems


def _write_array(path: Path, array: np.ndarray) -> None:
    write_atomic(path, lambda file: np.save(file, array, allow_pickle=False))


def _write_views(problem: Problem, folder: Path, when: str) -> list[Any]:
    folder.mkdir(parents=True, exist_ok=True)
    images = []
    with progress(f"views, {when}", len(problem.targets)) as report:
        for view in range(len(problem.targets)):
            images.append(problem.render(view, PICTURE_SEED + view))
            write_picture(folder / f"view_{view}", images[-1])
            report(view + 1, "")
    return images
