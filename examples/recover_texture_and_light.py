"""Recovers what is painted on a bunny and the light around it from eight photographs.

    python examples/recover_texture_and_light.py            # a minute or two on two cores
    python examples/recover_texture_and_light.py --resume   # goes on where a run was stopped

Leaves in ``out/bunny/``: ``result.png`` (photograph, start, recovered, of a view that was given and of one that was
not), ``recovered.png`` (albedo and environment beside the truth), ``derivative.png``, ``gradients.png`` (the first
gradient of the loss on the surfaces), ``report.json``, and in ``fit/`` all that ``warp-psdr fit`` writes.
"""

from __future__ import annotations

import argparse
import json
import time

import bunny_data
import numpy as np
import warp as wp

import warp_psdr as psdr
from warp_psdr import image_io, plots
from warp_psdr.fit.report import psnr
from warp_psdr.fit.run import FitConfig, fit

ALBEDO, LIGHT = "bunny.bsdf.reflectance.data", "environment.data"
#: Samples a pixel of the images that judge the result, and the first of their seeds: of the truth, and of the recovered
#: scene. They are those of no photograph and of no step of the fit.
JUDGE_SPP, TRUTH_SEED, RECOVERED_SEED = 128, 2**32 - 2000, 2**32 - 3000
#: Texels count as seen where the first gradient reaches this share of its median size over all texels that got any.
SEEN = 0.1
#: Steps whose mean is the loss at the end.
LAST = 20
#: Views that result.png shows: one that was given, and one that was kept; their size, and samples a pixel.
SHOWN, SIZE, SHOWN_SPP = (0, bunny_data.KEPT[1]), {"width": 480, "height": 360}, 32


def seen_texels(folder, name: str) -> np.ndarray:
    """Return which texels (H, W) of a parameter the photographs say something about."""
    gradient = np.abs(np.load(folder / "fit" / "gradients" / f"{name}_start.npy")).sum(axis=-1)
    return gradient > SEEN * np.median(gradient[gradient > 0.0])


def judge(folder, truth, recovered) -> dict:
    """Compare recovered images with new images of the truth, and recovered values with true ones."""
    views = {camera: psnr(recovered[camera], truth[camera]) for camera in truth}
    albedo, light = (np.load(folder / "fit" / "parameters" / f"{name}.npy") for name in (ALBEDO, LIGHT))
    size = albedo.shape[0]
    painted = image_io.read_image(folder / "albedo_truth.exr")[..., :3]
    painted = painted.reshape(size, painted.shape[0] // size, size, -1, 3).mean(axis=(1, 3))
    seen = seen_texels(folder, ALBEDO)
    sky = image_io.read_image(folder / "environment_truth.exr")[..., :3]
    above = lambda image: image[: len(image) // 2].mean(axis=(0, 1))  # noqa: E731
    return {
        "psnr of the given views, dB": [round(views[c], 2) for c in bunny_data.GIVEN],
        "psnr of the kept views, dB": [round(views[c], 2) for c in bunny_data.KEPT],
        "albedo, share of texels seen": round(float(seen.mean()), 3),
        "albedo, median absolute error where seen": round(float(np.median(np.abs(albedo - painted)[seen])), 4),
        # Albedo and light could trade a factor; the known floor and ball keep both of these at 1.
        "albedo, median of recovered / true where seen": _rounded(np.median((albedo / painted)[seen], axis=0)),
        "light, recovered / true mean above the horizon": _rounded(above(light) / above(sky)),
    }


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(value), 3) for value in values]


def set_recovered(folder, params: psdr.Parameters) -> None:
    """Give a scene the recovered values."""
    for name in (ALBEDO, LIGHT):
        params[name] = np.load(folder / "fit" / "parameters" / f"{name}.npy")
    params.update()


def render_recovered(folder) -> tuple[psdr.Parameters, dict[int, np.ndarray]]:
    """Return the parameters of the scene with the recovered values, and its image for every camera."""
    scene = psdr.load_file(folder / bunny_data.SCENE)
    params = psdr.traverse(scene)
    set_recovered(folder, params)
    cameras = (*bunny_data.GIVEN, *bunny_data.KEPT)
    return params, bunny_data.render_views(scene, cameras, JUDGE_SPP, RECOVERED_SEED, "recovered views")


def noise_of(folder, config: FitConfig) -> float:
    """Return the loss that a step has at the truth: the noise of the photographs and of its own images."""
    truth, losses = bunny_data.load_truth(folder), []
    for camera, file in zip(bunny_data.GIVEN, config.targets, strict=True):
        image = psdr.render(truth, sensor=camera, spp=config.spp, seed=TRUTH_SEED + camera)
        losses.append(float(getattr(psdr.losses, config.loss)(image, image_io.read_image(file)[..., :3])))
    return float(np.mean(losses))


def draw_result(folder, truth, recovered) -> None:
    """Write ``result.png``: a row a view, at more pixels than the fit compared."""
    scene = psdr.load_file(folder / bunny_data.SCENE, **SIZE)
    params = psdr.traverse(scene)
    render = lambda i: psdr.render(scene, sensor=i, spp=SHOWN_SPP, seed=RECOVERED_SEED + i).numpy()  # noqa: E731
    start = {i: render(i) for i in SHOWN}
    set_recovered(folder, params)
    photographs = bunny_data.photographs(folder, SHOWN, SHOWN_SPP, TRUTH_SEED, **SIZE)
    rows, titles = [], []
    for i in SHOWN:
        given = "not given" if i in bunny_data.KEPT else "given"
        rows += [photographs[i], start[i], render(i)]
        titles += [f"photograph {i}, {given}", "start", f"recovered, {psnr(recovered[i], truth[i]):.1f} dB"]
    plots.side_by_side(folder / "result.png", rows, titles, columns=3)


def draw(folder, params, truth, recovered) -> None:
    """Write the pictures."""
    draw_result(folder, truth, recovered)
    files = ["albedo_truth.exr", "albedo_start.exr", f"fit/parameters/{ALBEDO}.exr"]
    files += ["environment_truth.exr", "environment_start.exr", f"fit/parameters/{LIGHT}.exr"]
    titles = [f"{what}, {which}" for what in ("albedo", "light") for which in ("truth", "start", "recovered")]
    plots.side_by_side(
        folder / "recovered.png",
        [image_io.read_image(folder / f) for f in files],
        titles,
        columns=3,
        quantity="albedo, or radiance [W/m²/sr] of the light",
        unseen=[None, None, ~seen_texels(folder, ALBEDO), None, None, ~seen_texels(folder, LIGHT)],
        unseen_label="hatched: texels that no photograph shows, or hardly",
    )

    scene, name = params.scene, "floor.bsdf.reflectance.value"
    derivative = psdr.render_forward(scene, params, {name: 1.0}, spp=JUDGE_SPP).numpy()
    title, unit = "derivative of view 0 by the floor's albedo", "radiance [W/m²/sr] per unit of albedo"
    plots.derivative_image(folder / "derivative.png", derivative, title=title, unit=unit)

    gradients = {name: np.load(folder / "fit" / "gradients" / f"{name}_start.npy") for name in (ALBEDO, LIGHT)}
    try:
        psdr.view(scene, params, fields=gradients, screenshot=folder / "gradients.png", window_size=(1260, 320)).close()
    except RuntimeError as problem:  # no OpenGL on this machine: everything else does without
        print(f"gradients.png was not drawn: {problem}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--resume", action="store_true", help="continue a run that was stopped")
    parser.add_argument("--iterations", type=int, help="replaces that of bunny.toml")
    arguments = parser.parse_args()
    folder, began = bunny_data.FOLDER, time.perf_counter()
    if not (arguments.resume and (folder / f"view_{bunny_data.GIVEN[-1]}.exr").exists()):
        bunny_data.write_data()
    config = FitConfig.from_file(bunny_data.ROOT / "examples" / "bunny.toml")
    result = fit(config, resume=arguments.resume, overwrite=not arguments.resume, iterations=arguments.iterations)
    if not result.completed:
        raise SystemExit("stopped; --resume goes on from here")
    last = float(np.mean(result.losses[-LAST:]))
    print(f"loss {last:.4f} at the end; at the truth it is {noise_of(folder, config):.4f}: the noise of the images")
    cameras = (*bunny_data.GIVEN, *bunny_data.KEPT)
    truth = bunny_data.photographs(folder, cameras, JUDGE_SPP, TRUTH_SEED, "new photographs")
    params, recovered = render_recovered(folder)
    report = {**judge(folder, truth, recovered), "steps": len(result.losses)}
    draw(folder, params, truth, recovered)
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    for name, value in report.items():
        print(f"{name}: {value}")
    print(f"{time.perf_counter() - began:.0f} s; pictures in {folder}")


if __name__ == "__main__":
    with wp.ScopedLogLevel(wp.LOG_WARNING):  # no line per compiled kernel
        main()
