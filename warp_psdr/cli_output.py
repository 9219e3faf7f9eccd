"""What the command line prints beside its results: help, version, remarks on scenes and progress."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

#: A render reports fractions; the bar counts in these.
PROGRESS_UNITS = 100
#: What ``fit --help`` says of its file: every key of ``FitConfig``.
FIT_KEYS = """
keys of the file, whose names of files are relative to it:
  scene             Mitsuba 3 scene file
  targets           list of images (EXR, linear), one a view
  output            folder for checkpoints and results
  [parameters."NAME"]   of each unknown, by its name in 'warp-psdr plan SCENE':
    lr              its learning rate
    initial         where it starts: a number, three, or a file; default: the scene's value
and, where the default does not do:
  sensors           sensor of every target; default: sensor i for target i
  iterations        steps (200)
  views_per_step    views of a step, in shuffled order; default: all
  spp, spp_grad     samples a pixel of a step's image (16), and of its gradient (as many)
  final_spp         samples a pixel of the pictures at the end (64)
  seed              of all steps (0)
  loss              l2, l1, huber or relative_l2 (l2)
  lr_half_life      steps after which all learning rates have halved; default: they stay
  betas             Adam's decay rates ([0.9, 0.999])
  mask_updates      leave entries of zero gradient alone (false)
  checkpoint_every  steps from one checkpoint to the next (25)
  integrator        table: max_depth, rr_depth, hide_emitters, sampler, boundary = "none"
  defaults          table of values for the scene's $parameters
  allow_outside     folders in which the scene may read files beside its own
  max_collisions    tentative ones of a flight through a medium (1e7)
  device            Warp device ("cpu")
"""


class Version(argparse.Action):
    """Prints the version and ends."""

    def __call__(self, parser: argparse.ArgumentParser, *_rest: Any, **_options: Any) -> None:
        """Print it."""
        from warp_psdr import __version__

        print(f"warp-psdr {__version__}")
        parser.exit()


@contextmanager
def notes() -> Iterator[None]:
    """Print what is ignored, repaired or doubtful in a scene as a line each, instead of as Python's warnings."""
    import warnings

    from warp_psdr import SceneWarning

    show = warnings.showwarning

    def line(message: Any, category: type[Warning], *place: Any, **rest: Any) -> None:
        if issubclass(category, SceneWarning):
            print(f"note: {message}", file=sys.stderr)
        else:
            show(message, category, *place, **rest)

    with warnings.catch_warnings():
        warnings.simplefilter("always", SceneWarning)
        warnings.showwarning = line
        yield


def add_pool_options(parser: argparse.ArgumentParser) -> None:
    """Add what renders: processes of this machine, or a cluster; neither: this process."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--processes", type=int, metavar="N", help="share the work among so many processes; same bits")
    where.add_argument("--dask", metavar="ADDRESS", help="share it among the workers of a Dask scheduler; same bits")


@contextmanager
def pool(arguments: argparse.Namespace) -> Iterator[Any]:
    """The pool that the options name; None: none."""
    if arguments.dask is None and arguments.processes is None:
        yield None
        return
    from warp_psdr.distributed import Pool

    engine, processes = ("local", arguments.processes) if arguments.dask is None else (arguments.dask, None)
    with Pool(engine, processes=processes) as found:
        yield found


@contextmanager
def fractions(title: str) -> Iterator[Callable[[float], None]]:
    """Progress of a render, which reports finished fractions."""
    from warp_psdr.progress import progress

    with progress(title, PROGRESS_UNITS) as report:
        yield lambda fraction: report(int(fraction * PROGRESS_UNITS), "")
