"""What ``psdr.view`` returns: a window of VTK, a picture, a page for browsers, and what notebooks show."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from warp_psdr.files import write_atomic
from warp_psdr.view.page import Drawn, has_vtk_js, page
from warp_psdr.view.panels import Cell, Labels, draw_labels
from warp_psdr.view.vtk_window import open_plotter

#: Of the frame in a notebook, pixels; a window of other proportions is made to fit.
_FRAME_WIDTH = 960


class View:
    """Panels of a scene, drawn by pyvista; it has all methods of its ``plotter``.

    Args:
        cells: Where the panels stand in the window.
        whole: Size of the window in pixels.
        labels: Of each panel; None: it has none.
        draw: ``(plotter, number)`` draws the scene of a panel in the active renderer.
        background: Colour between the panels.
        off_screen: Draw without a window.
    """

    def __init__(
        self,
        cells: Sequence[Cell],
        whole: tuple[int, int],
        labels: Sequence[Labels | None],
        draw: Callable[[Any, int], None],
        *,
        background: tuple[float, float, float],
        off_screen: bool,
    ):
        self._cells, self._whole, self._labels, self._draw = cells, whole, labels, draw
        self._background = background
        self._off_screen = off_screen
        self.plotter = self._all(off_screen)

    def __getattr__(self, name: str) -> Any:
        # Only what a View has not itself comes here; without this guard a half-made one would ask itself for ever.
        if name == "plotter":
            raise AttributeError(name)
        return getattr(self.plotter, name)

    def html(self, path: str | os.PathLike[str]) -> None:
        """Write the view as one file that a browser shows, without a network: each panel is turned by the mouse.

        Args:
            path: The file, ``.html``, in a folder that exists.

        Raises:
            ValueError: The name ends otherwise.
            ModuleNotFoundError: trame-vtk is missing; the message says how to install it.
            OSError: The file cannot be written.
        """
        if Path(path).suffix.lower() not in (".html", ".htm"):
            raise ValueError(f"'{path}' does not end in .html; give the name of a page")
        text = self._page()
        write_atomic(path, lambda file: file.write(text.encode()))

    def png(self) -> bytes:
        """Return a picture of the view, as bytes of a PNG file."""
        from PIL import Image

        plotter = self.plotter if self._off_screen and not self.plotter._closed else self._all(True)
        stream = io.BytesIO()
        Image.fromarray(plotter.screenshot(None, return_img=True)).save(stream, format="PNG")
        if plotter is not self.plotter:
            plotter.close()
        return stream.getvalue()

    def _all(self, off_screen: bool) -> Any:
        """Return a plotter of all panels."""
        # Two renderers a panel: labels fill the cell, the scene covers all of it but the margins.
        plotter = open_plotter(1, 2 * len(self._cells), self._whole, off_screen=off_screen)
        for number, (cell, labels) in enumerate(zip(self._cells, self._labels, strict=True)):
            plotter.subplot(0, 2 * number)
            plotter.set_background(self._background)
            plotter.renderer.viewport = cell.viewport(self._whole, margins=True)
            if labels is not None:
                draw_labels(plotter, cell, labels)
            plotter.subplot(0, 2 * number + 1)
            plotter.renderer.viewport = cell.viewport(self._whole, margins=False)
            self._draw(plotter, number)
        return plotter

    def _page(self) -> str:
        """Return the page's text."""
        drawn = []
        for number, (cell, labels) in enumerate(zip(self._cells, self._labels, strict=True)):
            plotter = open_plotter(1, 1, (round(cell.width), round(cell.height)), off_screen=True)
            self._draw(plotter, number)
            drawn.append(Drawn(plotter, cell.width / cell.height, labels))
        try:
            return page(drawn)
        finally:
            for panel in drawn:
                panel.plotter.close()

    def _repr_png_(self) -> bytes:
        return self.png()

    def _repr_html_(self) -> str | None:
        """Return a frame that holds the page; None where it cannot be made, and notebooks show the picture."""
        if not has_vtk_js():
            return None
        height = round(_FRAME_WIDTH * self._whole[1] / self._whole[0])
        style = f"width:100%;max-width:{_FRAME_WIDTH}px;height:{height}px;border:none"
        return f'<iframe style="{style}" srcdoc="{escape(self._page(), quote=True)}"></iframe>'
