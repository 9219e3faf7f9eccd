"""Stand-in that finds the device code when the project runs from its repository.

An installed wheel ships the top-level folder ``kernels`` as this package. In a checkout the two folders differ, so
the repository's ``kernels`` is appended to this package's search path, and only there.
"""

from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]
if (_ROOT / "pyproject.toml").is_file() and (_ROOT / "kernels").is_dir():
    __path__.append(str(_ROOT / "kernels"))
