"""Settings of the documentation: ``sphinx-build -W --keep-going docs docs/_build``."""

import os
import sys
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "_ext")]

project = "warp_psdr"
author = "The warp_psdr authors"
copyright = author
html_title = "warp_psdr"
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
exclude_patterns = ["_build", "_ext", "_static", "data"]
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinxcontrib.bibtex",
    "citation_keys",
    "generated",
    "mathml",
    "side_by_side",
]
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
bibtex_bibfiles = ["references.bib"]
bibtex_default_style = "citation_keys"
bibtex_reference_style = "label"
suppress_warnings = ["ref.python"]  # three families have a class Method each
autodoc_typehints = "none"  # the docstrings say shapes and units, which types do not
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

# Notebooks are kept without outputs and run at every build; a cell that fails ends the build.
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
nb_execution_mode = "force"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"  # that kernels are compiled
if find_spec("torch") is None:
    nb_execution_excludepatterns = ["notebooks/recover_texture.ipynb"]
