"""The command line: ``warp-psdr render | gradient | accuracy | certify | plan | compile | fit | view``.

Everything but argparse is loaded by the command that needs it, so that ``--help`` answers at once. A user's mistake
ends in one line on standard error and exit status 2.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from warp_psdr.cli_certify import add_certify_options, run_certify
from warp_psdr.cli_output import FIT_KEYS, Version, add_pool_options, fractions, notes, pool

__all__ = ["main"]

#: Exit statuses: a user's mistake (as argparse's own), and a run ended by Ctrl-C (128 + SIGINT, as shells report it).
EXIT_ERROR, EXIT_INTERRUPTED = 2, 130
LOSSES = ("l2", "l1", "huber", "relative_l2")
DEFAULT_LOSS = "l2"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status.

    Args:
        argv: Arguments without the program's name; those of the process unless given.
    """
    arguments = _parser().parse_args(argv)
    try:
        import warp as wp

        with wp.ScopedLogLevel(wp.LOG_WARNING), notes():  # no line per compiled kernel between the results
            return arguments.run(arguments)
    except KeyboardInterrupt:
        print("warp-psdr: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:
        if arguments.debug:
            raise
        # A KeyError's text is its argument's repr; the message is the argument.
        message = " ".join(str(error.args[0] if isinstance(error, KeyError) and error.args else error).split())
        expected = isinstance(error, (ValueError, TypeError, KeyError, OSError, RuntimeError))
        hint = "" if expected else f" ({type(error).__name__}; --debug shows where)"
        print(f"warp-psdr: error: {message or type(error).__name__}{hint}", file=sys.stderr)
        return EXIT_ERROR


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="warp-psdr", description="Physics-based differentiable rendering.")
    parser.add_argument("--version", action=Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run: Callable[[argparse.Namespace], int], text: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text)
        added.set_defaults(run=run)
        added.add_argument("--debug", action="store_true", help="show the whole traceback of an error")
        return added

    render = command("render", _render, "Render an image of a scene.")
    _scene_options(render)
    _sampling_options(render)
    add_pool_options(render)
    render.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        help="image to write: linear as .exr, .hdr, .pfm; sRGB as .png, .jpg, .bmp",
    )

    gradient = command(
        "gradient",
        _gradient,
        "Differentiate: the image with respect to parameters (a derivative image), or, with --target, a loss with "
        "respect to parameters (its gradient).",
    )
    _scene_options(gradient)
    _sampling_options(gradient)
    add_pool_options(gradient)
    gradient.add_argument(
        "--param",
        action="append",
        required=True,
        metavar="NAME",
        help="its name, or a pattern such as '*.value'; repeatable",
    )
    _direction_options(gradient, "reverse mode: compare with this image")
    gradient.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder to write to")

    accuracy = command(
        "accuracy",
        _accuracy,
        "Say what accuracy costs: of the image; with --param of a derivative image, with --target of a gradient.",
    )
    _scene_options(accuracy)
    accuracy.add_argument(
        "--param", action="append", default=[], metavar="NAME", help="as for gradient; none: accuracy of the image"
    )
    _direction_options(accuracy, "gradient of the loss against this image")
    accuracy.add_argument("--seconds", type=float, default=4.0, help="what the pilot may take (default 4)")
    accuracy.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="cpu: processor time of all threads")
    accuracy.add_argument("--target-error", type=float, metavar="ERROR", help="say what this relative error costs")
    accuracy.add_argument("--seed", type=int, default=0, help="of the pilot (default 0)")
    accuracy.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the error against the time")
    accuracy.add_argument("--json", type=Path, metavar="FILE.json", help="write the report")

    certify = command(
        "certify",
        _certify,
        "Examine gradients: are they right? Exit status 0: within the tolerance, 3: a bias was found, 4: undecided "
        "within the budget, 2: it cannot be examined.",
    )
    _scene_options(certify)
    add_certify_options(certify)

    plan = command(
        "plan", _plan, "Print what would be compiled and estimated, and why; without --param, all parameters, too."
    )
    _scene_options(plan)
    plan.add_argument(
        "--param",
        action="append",
        default=[],
        metavar="NAME",
        help="its name, or a pattern such as '*.value'; repeatable",
    )

    compile = command(
        "compile",
        _compile,
        "Compile the kernels of an image, and with --param of its gradient, for later runs to find.",
    )
    _scene_options(compile)
    compile.add_argument("--param", action="append", default=[], metavar="NAME", help="as for gradient; repeatable")

    fit = command("fit", _fit, "Recover parameters of a scene from target images.")
    fit.add_argument("config", type=Path, help="TOML or JSON file of the keys below")
    fit.epilog, fit.formatter_class = FIT_KEYS, argparse.RawDescriptionHelpFormatter
    start = fit.add_mutually_exclusive_group()
    start.add_argument("--resume", action="store_true", help="continue from the last checkpoint, if there is one")
    start.add_argument("--overwrite", action="store_true", help="start again although there is a checkpoint")
    fit.add_argument("--iterations", type=int, help="replaces that of the file")
    _worker_option(fit)
    add_pool_options(fit)

    view = command("view", _view, "Show a scene in 3D, with gradients on its surfaces.")
    _scene_options(view)
    view.add_argument(
        "--field", action="append", default=[], metavar="NAME=FILE.npy", help="gradient of a parameter; repeatable"
    )
    view.add_argument("--outside", action="store_true", help="look from outside instead of through the sensor")
    view.add_argument("--screenshot", type=Path, metavar="FILE.png", help="write a picture instead of a window")
    view.add_argument("--html", type=Path, metavar="FILE.html", help="write a page for browsers instead of a window")
    return parser


def _scene_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", type=Path, help="Mitsuba 3 scene file")
    parser.add_argument(
        "-D", dest="defaults", action="append", default=[], metavar="NAME=VALUE", help="value of a $parameter"
    )
    parser.add_argument(
        "--allow-outside",
        type=Path,
        action="append",
        default=[],
        metavar="FOLDER",
        help="the scene may read files in or below it, beside its own folder; repeatable",
    )
    parser.add_argument(
        "--max-collisions", type=float, default=1e7, help="tentative ones of a flight through a medium (default 1e7)"
    )
    parser.add_argument("--sensor", type=_sensor, default=0, help="number or id of the camera (default 0)")
    parser.add_argument("--max-depth", type=int, help="longest path; -1: no limit (default: the scene's)")
    parser.add_argument("--device", default="cpu", help="Warp device (default cpu)")
    _worker_option(parser)


def _direction_options(parser: argparse.ArgumentParser, target: str) -> None:
    """Add what ``--param`` is differentiated along, or against; ``target``: help of ``--target``."""
    direction = parser.add_mutually_exclusive_group()
    direction.add_argument("--tangent", type=Path, metavar="FILE.npy", help="direction in which one parameter changes")
    direction.add_argument(
        "--translate", type=float, nargs=3, metavar=("X", "Y", "Z"), help="move all vertices or positions this way"
    )
    direction.add_argument("--target", type=Path, metavar="IMAGE", help=target)
    parser.add_argument("--loss", choices=LOSSES, help=f"with --target (default {DEFAULT_LOSS})")
    parser.add_argument(
        "--boundary", choices=("auto", "none"), default="auto", help="none: leave the boundary term out"
    )


def _sampling_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--spp", type=int, help="samples a pixel (default: the scene's)")
    parser.add_argument("--seed", type=int, default=0, help="equal seeds give equal bits (default 0)")


def _worker_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--workers", type=int, help="threads (default: all cores)")


def _render(arguments: argparse.Namespace) -> int:
    import warp_psdr as psdr
    from warp_psdr import image_io

    _prepare(arguments.output, *image_io.SUFFIXES)
    scene, integrator = _load(arguments)
    with pool(arguments) as processes, fractions("render") as progress:
        image = (
            (processes or psdr)
            .render(
                scene,
                sensor=arguments.sensor,
                integrator=integrator,
                spp=arguments.spp,
                seed=arguments.seed,
                progress=progress,
            )
            .numpy()
        )
    image_io.write_image(arguments.output, image)
    print(f"wrote {arguments.output}")
    return 0


def _gradient(arguments: argparse.Namespace) -> int:
    import warp_psdr as psdr

    scene, integrator = _load(arguments)
    params = psdr.traverse(scene)
    params.requires_grad(*arguments.param)
    options = {"sensor": arguments.sensor, "integrator": integrator, "spp": arguments.spp, "seed": arguments.seed}
    _check_loss(arguments)
    arguments.output.mkdir(parents=True, exist_ok=True)
    with pool(arguments) as processes:
        differentiate = _reverse if arguments.target else _forward
        written = differentiate(arguments, processes or psdr, scene, params, options)
    for text in written:
        print(text)
    return 0


def _forward(arguments: argparse.Namespace, by: Any, scene: Any, params: Any, options: dict[str, Any]) -> list[str]:
    """Write the derivative of the image along the tangents, rendered by this process or a pool."""
    from warp_psdr import image_io, plots

    tangents = _tangents(arguments, params)
    with fractions("derivative") as progress:
        image = by.render_forward(scene, params, tangents, progress=progress, **options).numpy()
    exr, png = arguments.output / "derivative.exr", arguments.output / "derivative.png"
    image_io.write_image(exr, image)
    title = "derivative of the image: " + ", ".join(params.requested)
    plots.derivative_image(png, image, title=title, unit=plots.RADIANCE_DERIVATIVE)
    return [f"wrote {exr}", f"wrote {png}"]


def _reverse(arguments: argparse.Namespace, by: Any, scene: Any, params: Any, options: dict[str, Any]) -> list[str]:
    """Write the gradient of a loss against the target, rendered by this process or a pool."""
    from warp_psdr.fit.report import write_gradients

    loss, adjoint = _loss(arguments, by, scene, params, options)
    with fractions("gradient") as progress:
        by.render_backward(scene, params, adjoint, progress=progress, **options)
    gradients = {name: params[name].grad.numpy() for name in params.requested}
    notes = write_gradients(arguments.output, scene, params, gradients)
    return [f"{arguments.loss or DEFAULT_LOSS} loss {loss:.6g}", *notes, f"wrote gradients to {arguments.output}"]


def _check_loss(arguments: argparse.Namespace) -> None:
    if arguments.loss and arguments.target is None:
        raise ValueError("--loss compares with an image; give it by --target")


def _loss(
    arguments: argparse.Namespace, by: Any, scene: Any, params: Any, options: dict[str, Any]
) -> tuple[float, Any]:
    """Return the loss against the target, and its derivative with respect to the image."""
    import warp as wp

    from warp_psdr import losses
    from warp_psdr.fit.run import read_target

    camera = scene.camera(arguments.sensor)
    target = read_target(arguments.target, (camera.crop_height, camera.crop_width))
    with fractions("image") as progress:
        image = by.render(scene, params, progress=progress, **options)
    image.requires_grad = True
    with wp.Tape() as tape:
        loss = getattr(losses, arguments.loss or DEFAULT_LOSS)(image, target)
    tape.backward(loss)
    return float(loss.numpy()[0]), image.grad


def _accuracy(arguments: argparse.Namespace) -> int:
    import warp_psdr as psdr

    for path, suffix in ((arguments.plot, ".png"), (arguments.json, ".json")):
        if path is not None:
            _prepare(path, suffix)
    if arguments.target_error is not None and not arguments.target_error > 0.0:
        raise ValueError(f"--target-error: got {arguments.target_error}, expected a positive number")
    scene, integrator = _load(arguments)
    params = psdr.traverse(scene)
    options: dict[str, Any] = {"sensor": arguments.sensor, "integrator": integrator, "seed": arguments.seed}
    adjoint = tangents = None
    if not arguments.param and (arguments.target or arguments.tangent or arguments.translate):
        raise ValueError("--target, --tangent and --translate say how --param is differentiated; give a --param")
    _check_loss(arguments)
    if arguments.param:
        params.requires_grad(*arguments.param)
        if arguments.target is not None:
            _value, adjoint = _loss(arguments, psdr, scene, params, options)
        else:
            tangents = _tangents(arguments, params)
    options |= {"seconds": arguments.seconds, "clock": arguments.clock}
    with fractions("accuracy") as progress:
        report = psdr.accuracy(scene, params, adjoint, tangents=tangents, progress=progress, **options)
    print(report)
    if arguments.target_error is not None:
        low, high = report.seconds_interval(arguments.target_error)
        seconds = report.seconds_to(arguments.target_error)
        print(f"relative error {arguments.target_error:g}: {seconds:.3g} s (95 %: {low:.3g} to {high:.3g} s)")
    if arguments.plot is not None:
        report.plot(arguments.plot)
        print(f"wrote {arguments.plot}")
    if arguments.json is not None:
        report.save(arguments.json)
        print(f"wrote {arguments.json}")
    return 0


def _certify(arguments: argparse.Namespace) -> int:
    for path, suffixes in ((arguments.json, (".json",)), (arguments.html, (".html", ".htm"))):
        if path is not None:
            _prepare(path, *suffixes)
    return run_certify(arguments, *_load(arguments))


def _plan(arguments: argparse.Namespace) -> int:
    import warp_psdr as psdr

    scene, integrator = _load(arguments)
    params = psdr.traverse(scene)
    params.requires_grad(*arguments.param)
    print(psdr.plan(scene, params, integrator=integrator, sensor=arguments.sensor))
    if not arguments.param:
        print(params)
    return 0


def _compile(arguments: argparse.Namespace) -> int:
    import warp_psdr as psdr

    scene, integrator = _load(arguments)
    params = psdr.traverse(scene)
    params.requires_grad(*arguments.param)
    print(psdr.compile(scene, params, integrator=integrator, sensor=arguments.sensor))
    return 0


def _fit(arguments: argparse.Namespace) -> int:
    import warp_psdr as psdr
    from warp_psdr.fit.run import FitConfig, fit

    config = FitConfig.from_file(arguments.config)
    psdr.set_workers(arguments.workers)
    how = {"resume": arguments.resume, "overwrite": arguments.overwrite, "iterations": arguments.iterations}
    with pool(arguments) as processes:
        result = fit(config, pool=processes, **how)
    if not result.completed:
        print(f"stopped after step {len(result.losses)}; --resume continues from {result.output}")
        return EXIT_INTERRUPTED
    decibels = ", ".join(f"{value:.1f}" for value in result.psnr)
    print(f"loss {result.losses[-1]:.4g} after {len(result.losses)} steps; PSNR of the views: {decibels} dB")
    print(f"results in {result.output}")
    return 0


def _view(arguments: argparse.Namespace) -> int:
    import warp_psdr as psdr
    from warp_psdr.arrays import read_array
    from warp_psdr.view.viewer import view

    fields = {}
    for text in arguments.field:
        name, separator, file = text.rpartition("=")
        if not separator:
            raise ValueError(f"--field: got {text!r}, expected NAME=FILE.npy")
        fields[name] = read_array(file)
    if arguments.screenshot is not None:
        _prepare(arguments.screenshot, ".png")
    if arguments.html is not None:
        _prepare(arguments.html, ".html", ".htm")
    scene, _ = _load(arguments)
    drawn = view(
        scene,
        psdr.traverse(scene),
        fields=fields or None,
        screenshot=arguments.screenshot,
        camera=None if arguments.outside else arguments.sensor,
    )
    if arguments.html is not None:
        drawn.html(arguments.html)
    written = [path for path in (arguments.screenshot, arguments.html) if path is not None]
    for path in written:
        print(f"wrote {path}")
    if not written:
        drawn.show()
    drawn.close()
    return 0


def _load(arguments: argparse.Namespace) -> tuple[Any, Any]:
    """Return the scene and the integrator: the scene file's, changed by the options."""
    from dataclasses import replace

    import warp_psdr as psdr
    from warp_psdr.plan.integrator import from_description
    from warp_psdr.plan.transient import require_steady

    psdr.set_workers(arguments.workers)
    defaults = {}
    for text in arguments.defaults:
        name, separator, value = text.partition("=")
        if not separator:
            raise ValueError(f"-D: got {text!r}, expected NAME=VALUE")
        defaults[name] = value
    allowed = {"allow_outside": arguments.allow_outside, "max_collisions": arguments.max_collisions}
    scene = psdr.load_file(arguments.scene, device=arguments.device, **allowed, **defaults)
    arguments.sensor = scene.description.sensor_number(arguments.sensor)
    if getattr(arguments, "run", None) is not _plan:
        require_steady(scene, arguments.sensor, "the command line")
    changes: dict[str, Any] = {}
    if arguments.max_depth is not None:
        changes["max_depth"] = arguments.max_depth
    if getattr(arguments, "boundary", "auto") == "none":
        changes["boundary"] = None
    return scene, replace(from_description(scene.description.integrator), **changes)


def _tangents(arguments: argparse.Namespace, params: Any) -> dict[str, Any]:
    """Return the directions in which the requested parameters change."""
    if arguments.tangent is not None and len(params.requested) > 1:
        raise ValueError(f"--tangent belongs to one parameter, got {', '.join(params.requested)}; give one --param")
    return {name: _tangent(arguments, params[name].numpy().shape) for name in params.requested}


def _tangent(arguments: argparse.Namespace, shape: tuple[int, ...]) -> Any:
    """Return the direction in which a parameter of ``shape`` changes: all entries by one unless told otherwise."""
    import numpy as np

    from warp_psdr.arrays import read_array

    if arguments.tangent is not None:
        return read_array(arguments.tangent)
    if arguments.translate is None:
        return np.ones(shape, dtype=np.float32)
    if shape == (4, 4):  # a pose: its last column
        tangent = np.zeros(shape, dtype=np.float32)
        tangent[:3, 3] = arguments.translate
        return tangent
    if shape[-1] != 3:
        raise ValueError(f"--translate moves positions and poses, got a parameter of shape {shape}; use --tangent")
    return np.broadcast_to(np.float32(arguments.translate), shape)


def _sensor(text: str) -> int | str:
    """Return the number of a sensor, or its id."""
    try:
        return int(text)
    except ValueError:
        return text


def _prepare(path: Path, *suffixes: str) -> None:
    """Check the place of a file that will be written: what is wrong with it is said before there is work to lose."""
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: got suffix {path.suffix!r}, expected {' or '.join(suffixes)}")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder, expected a file")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: there is no folder {str(path.parent)!r}; make it first")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"{path}: its folder cannot be written to")


if __name__ == "__main__":
    sys.exit(main())
