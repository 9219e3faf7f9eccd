"""Stand-in that finds the device code when the project runs from its repository.

An installed wheel ships the top-level folder ``kernels`` as this package. In a checkout the two folders differ, so
the repository's ``kernels`` is appended to this package's search path, and only there. ``extend_path`` changes nothing
when Python runs this; editors that read it with jedi take it as the sign that the package's modules lie in a folder
of the same name elsewhere, and so find ``warp_psdr.kernels.path`` in ``kernels/path.py``.
"""

from pathlib import Path
from pkgutil import extend_path

__path__ = extend_path(__path__, __name__)

_ROOT = Path(__file__).resolve().parents[2]
if (_ROOT / "pyproject.toml").is_file() and (_ROOT / "kernels").is_dir():
    __path__.append(str(_ROOT / "kernels"))
