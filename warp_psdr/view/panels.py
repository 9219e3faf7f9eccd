"""Where the panels of a view stand in its window, and the labels beside each: title, colour bar, unit and range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from warp_psdr.plots import NOT_FINITE_COLOR, diverging_colormap

#: Pixels beside a panel for its colour bar, above it for its title, below it for notes.
_BAR_MARGIN, _TITLE_MARGIN, _NOTES_MARGIN = 110, 26, 44
#: Size of the labels' letters.
_FONT = 9


@dataclass(frozen=True)
class Cell:
    """Where a panel stands in the window, in pixels; y grows upwards. The margins hold its labels."""

    x: float
    y: float
    width: float  #: of the scene, without margins
    height: float
    bar: int = 0  #: margin on the right
    title: int = 0  #: margin above
    notes: int = 0  #: margin below

    def viewport(self, window: tuple[int, int], *, margins: bool) -> tuple[float, float, float, float]:
        """Return low and high corner in shares of the window, with or without the margins."""
        x, y = (self.x, self.y) if margins else (self.x, self.y + self.notes)
        width = self.width + margins * self.bar
        height = self.height + margins * (self.title + self.notes)
        return x / window[0], y / window[1], min((x + width) / window[0], 1.0), min((y + height) / window[1], 1.0)


def arrangement(count: int, size: tuple[int, int], *, labels: bool) -> tuple[list[Cell], tuple[int, int]]:
    """Place panels in rows that fill the window, so that no place stays empty.

    The number of rows is the one with the largest pictures of the usual shape, 4 to 3. Rows hold equally many panels,
    or the upper ones fewer and wider ones.

    Args:
        count: Of panels.
        size: Width and height of all panels together, in pixels.
        labels: Leave margins for titles, notes and colour bars.

    Returns:
        The cells in reading order, and the size of the window.
    """
    rows = max(range(1, count + 1), key=lambda n: (min(size[0] / -(-count // n), 4.0 / 3.0 * size[1] / n), -n))
    bar, title, notes = (_BAR_MARGIN, _TITLE_MARGIN, _NOTES_MARGIN) if labels else (0, 0, 0)
    most = -(-count // rows)
    whole = (size[0] + most * bar, size[1] + rows * (title + notes))
    height = size[1] / rows
    cells, left = [], count
    for row in range(rows):
        here = left // (rows - row)
        left -= here
        y = whole[1] - (row + 1) * (height + title + notes)
        width = whole[0] / here
        cells += [Cell(i * width, y, width - bar, height, bar, title, notes) for i in range(here)]
    return cells, whole


@dataclass(frozen=True, eq=False)
class Labels:
    """What is said beside a panel: its title, notes below, and the colours from ``-limit`` to ``limit``."""

    title: str
    notes: Sequence[str]
    limit: float
    table: Any  #: pyvista's ``LookupTable``


def color_table(limit: float) -> Any:
    """Return pyvista's table of the colours of signed values."""
    import pyvista

    colormap = diverging_colormap()
    table = pyvista.LookupTable(colormap, n_values=colormap.N, scalar_range=(-limit, limit))
    table.nan_color = NOT_FINITE_COLOR
    return table


def draw_labels(plotter: Any, cell: Cell, labels: Labels) -> None:
    """Draw a panel's colour bar on the right, its title above and notes below, in the active renderer.

    Args:
        plotter: Its active renderer fills the cell with its margins.
        cell: The panel's place.
        labels: What they say.
    """
    from vtkmodules.vtkRenderingAnnotation import vtkScalarBarActor

    width, height = cell.width + cell.bar, cell.height + cell.title + cell.notes
    bar = vtkScalarBarActor()
    bar.SetLookupTable(labels.table)
    bar.SetMaximumNumberOfColors(labels.table.n_values)
    bar.SetNumberOfLabels(5)
    bar.UnconstrainedFontSizeOn()
    bar.SetLabelFormat("{:.2g}")
    bar.SetPosition((cell.width + 10) / width, (cell.notes + 0.1 * cell.height) / height)
    bar.SetWidth((cell.bar - 15) / width)
    bar.SetHeight(0.8 * cell.height / height)
    bar.SetBarRatio(0.22)
    text = bar.GetLabelTextProperty()
    text.SetFontSize(_FONT + 4)
    text.SetColor(0.0, 0.0, 0.0)
    text.BoldOff()
    text.ShadowOff()
    text.ItalicOff()
    plotter.renderer.AddViewProp(bar)
    for label, y in ((labels.title, cell.height + cell.notes + 3), ("\n".join(labels.notes), 4)):
        plotter.add_text(label, position=(6 / width, y / height), viewport=True, font_size=_FONT, color="black")
