"""Views as a page that a browser shows from one file: vtk.js, which comes with trame-vtk, draws each panel.

Titles, notes and colour bars are the page's own, in HTML: what vtk.js makes of VTK's has neither range nor title.
"""

from __future__ import annotations

import base64
import io
import json
import zipfile
from dataclasses import dataclass
from html import escape
from importlib import resources
from typing import Any

from warp_psdr.plots import diverging_colormap
from warp_psdr.view.panels import Labels

#: Stops of a colour bar, and its labelled values.
_STOPS, _TICKS = 33, 5
#: Pixels: least height of a panel, title, notes and margins above and below it, its colour bar.
_LEAST, _AROUND, _BAR = 300, 110, 86

_STYLE = """
html, body { margin: 0; background: #dbdee0; color: #111; font: 14px/1.35 sans-serif; }
main { display: flex; flex-wrap: wrap; gap: 12px; padding: 12px; box-sizing: border-box; min-height: 100vh; }
figure { margin: 0; display: flex; flex-direction: column; }
figcaption { font-weight: 600; padding: 0 0 4px; overflow-wrap: anywhere; }
.row { display: flex; }
.scene { position: relative; flex: 1 1 auto; overflow: hidden; }
.bar { position: relative; flex: 0 0 76px; margin: 12px 0 12px 10px; }
.bar i { position: absolute; inset: 0 auto 0 0; width: 16px; }
.bar span { position: absolute; left: 22px; transform: translateY(-50%); white-space: nowrap; }
.notes { padding-top: 4px; white-space: pre-line; }
"""
_SCRIPT = """
let shown = false;
function loadDataSet() {
  if (shown) return;
  shown = true;
  document.querySelectorAll(".scene").forEach(
    (container, i) => OfflineLocalView.load(container, { base64Str: panels[i] }));
}
"""


@dataclass(eq=False)
class Drawn:
    """A panel: its scene in a plotter, width over height, and what stands beside it."""

    plotter: Any
    aspect: float
    labels: Labels | None


def has_vtk_js() -> bool:
    """Return whether pages can be made."""
    try:
        import trame_vtk.tools  # noqa: F401
    except ModuleNotFoundError:
        return False
    return True


def page(panels: list[Drawn]) -> str:
    """Return the text of a page.

    Raises:
        ModuleNotFoundError: trame-vtk is missing.
    """
    try:
        import trame_vtk.tools
    except ModuleNotFoundError as problem:
        text = f"pages are drawn by vtk.js, which comes with trame-vtk ({problem}); pip install 'warp-psdr[html]'"
        raise ModuleNotFoundError(text, name=problem.name) from None
    viewer = resources.files(trame_vtk.tools).joinpath("static_viewer.html").read_text(encoding="utf-8")
    # The module that is vtk.js, which calls ``loadDataSet`` when it is there.
    start = viewer.index('<script type="module">')
    module = viewer[start : viewer.index("</script>", start) + len("</script>")]
    data = json.dumps([base64.b64encode(_archive(panel.plotter)).decode() for panel in panels])
    figures = "\n".join(map(_figure, panels))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"/><title>warp_psdr: view</title>'
        f"<style>{_STYLE}</style></head>\n<body><main>\n{figures}\n</main>\n"
        f"<script>window.global = window; const panels = {data};{_SCRIPT}</script>\n{module}\n</body></html>\n"
    )


def _figure(panel: Drawn) -> str:
    labels = panel.labels
    scene = f'<div class="scene" style="aspect-ratio: {panel.aspect:.4f}"></div>'
    # Panels of one height in a row, as wide as the page and no higher than the window.
    size = f"flex: {panel.aspect:.4f} 1 {_LEAST * panel.aspect:.0f}px; "
    size += f"max-width: calc((100vh - {_AROUND}px) * {panel.aspect:.4f} + {_BAR}px)"
    if labels is None:
        return f'<figure style="{size}"><div class="row">{scene}</div></figure>'
    colors = diverging_colormap()
    stops = ", ".join(_css(colors(i / (_STOPS - 1))) for i in range(_STOPS))
    shares = [i / (_TICKS - 1) for i in range(_TICKS)]
    ticks = "".join(
        f'<span style="bottom: {100 * share:g}%; transform: translateY(50%)">'
        f"{labels.limit * (2 * share - 1):.2g}</span>"
        for share in shares
    )
    notes = escape("\n".join(labels.notes))
    return (
        f'<figure style="{size}"><figcaption>{escape(labels.title)}</figcaption><div class="row">{scene}'
        f'<div class="bar"><i style="background: linear-gradient(to top, {stops})"></i>{ticks}</div></div>'
        f'<div class="notes">{notes}</div></figure>'
    )


def _css(color: tuple[float, ...]) -> str:
    return "#" + "".join(f"{round(255 * value):02x}" for value in color[:3])


def _add_projection(tree: dict[str, Any], camera: Any) -> None:
    """Add the camera's angle or scale to its place in the tree, which trame leaves out."""
    if tree.get("type") in ("vtkCamera", "vtkOpenGLCamera"):
        tree["properties"] |= {
            "viewAngle": camera.GetViewAngle(),
            "parallelProjection": bool(camera.GetParallelProjection()),
            "parallelScale": camera.GetParallelScale(),
        }
    for nested in tree.get("dependencies", []):
        _add_projection(nested, camera)


def _archive(plotter: Any) -> bytes:
    """Return what vtk.js reads of a plotter: its tree and arrays, as trame's standalone export has them."""
    from trame_vtk.modules.vtk import serializers

    serializers.initialize_serializers()
    context = serializers.SynchronizationContext()
    context.set_ignore_last_dependencies(True)
    window = plotter.render_window
    tree = serializers.serialize(None, window, serializers.reference_id(window), context, 1)
    camera = plotter.renderer.GetActiveCamera()
    _add_projection(tree, camera)
    tree["extra"] = {
        "vtkRefId": serializers.reference_id(window),
        "centerOfRotation": camera.GetFocalPoint(),
        "camera": serializers.reference_id(camera),
    }
    arrays = {
        entry["hash"]: {**entry, "content": context.get_cached_data_array(entry["hash"], False)}
        for entry in serializers.extract_array_hash(tree)
    }
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("index.json", json.dumps({"hashes": arrays, "scene": tree}))
    return stream.getvalue()
