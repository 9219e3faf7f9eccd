"""Opening a VTK window, on a display or off-screen, where a failure is an error and not a crash.

Without a display VTK draws in software through EGL or OSMesa, whichever the machine has. The wheels of VTK hold
neither, and VTK ends the process where both are missing, so a small subprocess tries first.
"""

from __future__ import annotations

import contextlib
import functools
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

_WINDOW_VARIABLE = "VTK_DEFAULT_OPENGL_WINDOW"  # read by VTK when it opens a window
_PROBE = (
    "from vtkmodules.vtkRenderingCore import vtkRenderWindow; import vtkmodules.vtkRenderingOpenGL2; "
    "w = vtkRenderWindow(); w.SetOffScreenRendering(1); w.SetSize(8, 8); w.Render(); print(w.GetClassName())"
)


def import_pyvista() -> Any:
    """Return pyvista.

    Raises:
        ModuleNotFoundError: It is missing, or VTK is; the message says how to install them.
    """
    try:
        import pyvista
    except ModuleNotFoundError as problem:
        text = f"psdr.view draws with pyvista and VTK ({problem}); install them: pip install pyvista"
        raise ModuleNotFoundError(text, name=problem.name) from None
    return pyvista


def open_plotter(rows: int, columns: int, window_size: tuple[int, int], *, off_screen: bool) -> Any:
    """Return an empty ``pyvista.Plotter`` of ``rows`` by ``columns`` panels, off-screen also where there is no display.

    Raises:
        RuntimeError: VTK cannot draw on this machine.
    """
    window = find_window(bool(os.environ.get("DISPLAY")), os.environ.get(_WINDOW_VARIABLE, ""))
    import pyvista

    with _environment_variable(_WINDOW_VARIABLE, window):
        return pyvista.Plotter(
            off_screen=off_screen or window in ("vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow"),
            shape=(rows, columns),
            window_size=list(window_size),
            border=False,
            lighting="none",
        )


@functools.cache
def find_window(display: bool, wanted: str = "") -> str:
    """Return the VTK window class that draws on this machine; empty: VTK's own choice.

    On Linux each candidate draws once in a subprocess (0.2 to 0.7 s): VTK crashes where it has no OpenGL.

    Args:
        display: There is an X display to try first.
        wanted: The only class to try, when not empty.

    Raises:
        RuntimeError: None draws.
    """
    if not sys.platform.startswith("linux"):
        return wanted
    candidates = ["vtkXOpenGLRenderWindow"] * display + ["vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow"]
    for name in [wanted] if wanted else candidates:
        environment = {**os.environ, _WINDOW_VARIABLE: name}
        with contextlib.suppress(subprocess.TimeoutExpired):
            tried = subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True, timeout=60)
            if tried.returncode == 0 and name in tried.stdout.decode(errors="replace"):
                return name
    raise RuntimeError(
        f"VTK cannot draw on this machine: tried {wanted or ', '.join(candidates)}. Its wheels hold no OpenGL; install "
        "a software renderer, on Debian and Ubuntu with: apt-get install libosmesa6"
    )


@contextlib.contextmanager
def _environment_variable(name: str, value: str) -> Iterator[None]:
    """Set an environment variable for a while; empty leaves it as it is."""
    before = os.environ.get(name)
    try:
        if value:
            os.environ[name] = value
        yield
    finally:
        if before is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = before
