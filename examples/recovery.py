"""What the examples that recover a shape or a pose share: their command line, poses and the reports they leave."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp
from PIL import Image
from warp.optim import Adam

import warp_psdr as psdr
from warp_psdr import plots
from warp_psdr.fit.report import psnr


def run(
    main: Callable[..., dict], description: str, quick: dict, what: str = "fewer pixels, samples and steps"
) -> None:
    """Run an example from the command line and print its report.

    Args:
        main: the example; (folder, options) -> report.
        description: the docstring of its file.
        quick: its options under ``--quick``.
        what: what these do, in words.
    """
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help=what)
    options = quick if parser.parse_args().quick else {}
    with wp.ScopedLogLevel(wp.LOG_WARNING):  # no line per compiled kernel
        for name, value in main(**options).items():
            print(f"{name}: {value}")
    print(f"pictures in {main.__defaults__[0]}")


def write_film(path: Path, films: list[list[np.ndarray]], seconds: float, enlarged: int = 4) -> None:
    """Write films side by side as an animated GIF.

    Args:
        path: of the file.
        films: frames (H, W, 3) of each, linear; all have equal numbers.
        seconds: how long it runs.
        enlarged: pixels of the picture for each of the film, along an edge.
    """
    frames = [np.concatenate(images, axis=1) for images in zip(*films, strict=True)]
    exposure = -float(np.log2(np.percentile(frames[0], 99.0)))
    pictures = [np.uint8(255.0 * plots.tonemap(frame, exposure=exposure) + 0.5) for frame in frames]
    big = [Image.fromarray(picture.repeat(enlarged, 0).repeat(enlarged, 1)) for picture in pictures]
    big[0].save(path, save_all=True, append_images=big[1:], duration=1000.0 * seconds / len(big), loop=0)


def draw_films(folder: Path, films: dict[str, list[np.ndarray]], seconds: float, first: float = 0.0) -> None:
    """Draw six frames of each film, and write the first and the last film beside each other.

    Args:
        folder: gets ``result.png`` and ``film.gif``.
        films: frames (H, W, 3) by name; all have equal numbers.
        seconds: how long they run.
        first: when the first frame is, s.
    """
    frames = len(next(iter(films.values())))
    shown = np.linspace(0, frames - 1, 6).astype(int)
    titles = [f"{name}, {first + k * seconds / frames:.2f} s" for name in films for k in shown]
    plots.side_by_side(folder / "result.png", [film[k] for film in films.values() for k in shown], titles, columns=6)
    write_film(folder / "film.gif", [films[name] for name in (*films,)[:: len(films) - 1]], seconds)


def fit_film(
    film: Callable[[int, int, list[int]], list[wp.array]],
    given: list[np.ndarray],
    numbers: wp.array,
    *,
    steps: int,
    spp: int,
    rate: float,
    share: int,
    told: Callable[[int], None],
) -> None:
    """Fit numbers of a simulation to a film of it, by Adam and a few random frames a step.

    Args:
        film: (seed, samples a pixel, numbers of frames) -> their images; simulates, on the tape that is active.
        given: the film.
        numbers: what is sought, an array with a gradient.
        steps: their number; in the second half the rate falls to 3 %.
        spp: samples a pixel.
        rate: of learning.
        share: a step looks at so many of all frames, one in ``share``.
        told: called with the number of each step that has been made.
    """
    frames, rng = len(given), np.random.default_rng(0)
    optimiser = Adam([numbers], betas=(0.8, 0.95))
    for step in range(steps):
        shown = sorted(rng.choice(frames, max(frames // share, 1), replace=False).tolist())
        tape = wp.Tape()
        with tape:
            images = film(step * frames, spp, shown)
            losses = [psdr.losses.l2(image, given[k]) for k, image in zip(shown, images, strict=True)]
        for loss in losses:
            loss.grad.fill_(1.0)
        tape.backward()
        optimiser.lr = rate * 0.03 ** max(2.0 * step / steps - 1.0, 0.0)
        optimiser.step([numbers.grad])
        tape.zero()  # a simulator's own arrays have gradients, too
        told(step)


def tell_ratios(logarithms: wp.array, truth: np.ndarray) -> Callable[[int], None]:
    """Return what prints numbers over those that are sought, every fifth step."""

    def told(step: int) -> None:
        if (step + 1) % 5 == 0:
            print(f"step {step + 1}: found / sought {(np.exp(logarithms.numpy()) / truth).round(3)}", flush=True)

    return told


def number_report(folder: Path, names: tuple[str, ...], found: np.ndarray, truth: np.ndarray, began: float) -> dict:
    """Write how far off numbers are.

    Args:
        folder: gets ``report.json``.
        names: of the numbers.
        found: the numbers.
        truth: what is sought.
        began: ``time.perf_counter()`` of the beginning.

    Returns:
        The report.
    """
    report = {
        "found": dict(zip(names, found.tolist(), strict=True)),
        "errors": dict(zip(names, np.abs(found / truth - 1.0).tolist(), strict=True)),
        "seconds": round(time.perf_counter() - began, 1),
    }
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report


@wp.kernel
def place(
    # In:
    local: wp.array(dtype=wp.vec3),
    rotation: wp.array(dtype=wp.vec3),
    translation: wp.array(dtype=wp.vec3),
    # Out:
    world_out: wp.array(dtype=wp.vec3),
):
    """Turn by a rotation vector (Rodrigues' formula), then move."""
    i = wp.tid()
    w = rotation[0]
    angle = wp.sqrt(wp.dot(w, w) + 1.0e-12)
    half = wp.sin(0.5 * angle) / angle
    across = wp.cross(w, local[i])
    turned = local[i] + (wp.sin(angle) / angle) * across + (2.0 * half * half) * wp.cross(w, across)
    world_out[i] = turned + translation[0]


def pose_errors(pose: tuple[np.ndarray, np.ndarray], truth: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """Return the angle (degrees) and the distance (world units) between two poses.

    Args:
        pose: rotation vector (radians) and translation (world units).
        truth: the same of what is sought.
    """
    from scipy.spatial.transform import Rotation

    turned, sought = (Rotation.from_rotvec(np.asarray(p[0], np.float64)).as_matrix() for p in (pose, truth))
    cosine = 0.5 * (np.trace(sought.T @ turned) - 1.0)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))), float(np.linalg.norm(pose[1] - truth[1]))


def cameras(origins: list[list[float]], fov: float, resolution: int) -> dict:
    """Return square cameras ``camera_0``, ... of a scene, at the origins, that look at the centre of the world."""
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "box"}}
    return {
        f"camera_{i}": {
            "type": "perspective",
            "fov": fov,
            "to_world": psdr.Transform.look_at(origin, [0, 0, 0], [0, 1, 0]),
            "film": film,
        }
        for i, origin in enumerate(origins)
    }


def photographs(
    scene: psdr.Scene, count: int, integrator: psdr.PathIntegrator, spp: int, seed: int
) -> list[np.ndarray]:
    """Return what the first cameras see, (H, W, 3) each, with a seed of its own."""
    return [psdr.render(scene, sensor=i, integrator=integrator, spp=spp, seed=seed + i).numpy() for i in range(count)]


def shown_views(given: int) -> tuple[int, ...]:
    """Return the views that ``result.png`` shows: two that were given, and the first two that were kept."""
    return (0, 3, given, given + 1)


def draw_views(
    scene: psdr.Scene, given: int, integrator: psdr.PathIntegrator, spp: int, seed: int
) -> dict[int, np.ndarray]:
    """Return the views that ``result.png`` shows, of a scene with more pixels than the fit compares."""
    render = lambda i: psdr.render(scene, sensor=i, integrator=integrator, spp=spp, seed=seed + i)  # noqa: E731
    return {i: render(i).numpy() for i in shown_views(given)}


def view_report(
    folder: Path, photos: list, before: list, found: list, given: int, drawn: tuple[dict, dict, dict] | None = None
) -> dict:
    """Draw four photographs beside the start and what was recovered, and compare all of them.

    Args:
        folder: gets ``result.png``.
        photos: photographs (H, W, 3), those first that were given, then two or more that were kept.
        before: the same views at the start.
        found: the same of what was recovered.
        given: how many were given.
        drawn: what is drawn of each, from ``draw_views``; default: the images themselves.

    Returns:
        Lines of a report.
    """
    shown = shown_views(given)
    rows = [images[i] for images in (drawn or (photos, before, found)) for i in shown]
    titles = [f"photograph {i}" + (", not given" if i >= given else "") for i in shown] + ["start"] * len(shown)
    titles += [f"recovered, {psnr(found[i], photos[i]):.1f} dB" for i in shown]
    plots.side_by_side(folder / "result.png", rows, titles, columns=len(shown))
    kept = range(given, len(photos))
    return {
        "psnr of the given views, dB": [round(psnr(found[i], photos[i]), 2) for i in range(given)],
        "psnr of the kept views, dB": [round(psnr(found[i], photos[i]), 2) for i in kept],
        "psnr of the kept views at the start, dB": [round(psnr(before[i], photos[i]), 2) for i in kept],
    }


def pose_report(folder: Path, history: list[tuple[float, float]], began: float) -> dict:
    """Draw the errors of a pose over the steps and write the report.

    Args:
        folder: gets ``error.png`` and ``report.json``.
        history: (angle in degrees, distance in world units), at the start and after each step.
        began: ``time.perf_counter()`` of the beginning.

    Returns:
        The report.
    """
    angles, distances = np.array(history).T
    curves = {"rotation, degrees": angles, "translation, hundredths of a unit": 100.0 * distances}
    plots.loss_curve(folder / "error.png", curves, title="error of the pose", ylabel="degrees, or units / 100")
    report = {
        "rotation error, degrees: start, found": [round(float(angles[i]), 4) for i in (0, -1)],
        "translation error, units: start, found": [round(float(distances[i]), 5) for i in (0, -1)],
        "steps": len(history) - 1,
        "seconds": round(time.perf_counter() - began),
    }
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report
