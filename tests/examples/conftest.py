"""Files of the examples and of the benchmarks, imported by their names."""

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "examples" / "benchmarks"


@pytest.fixture(scope="module")
def modules():
    """Import files of the benchmarks by their names, which packages and folders of tests may have, too; forget them."""
    files = {f.stem for f in (*BENCHMARKS.glob("*.py"), *BENCHMARKS.parent.glob("*.py"))}
    with pytest.MonkeyPatch.context() as patch:
        for name in files:
            patch.delitem(sys.modules, name, raising=False)
        patch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
        yield importlib.import_module
        for name in files & set(sys.modules):
            if str(getattr(sys.modules[name], "__file__", "")).startswith(str(BENCHMARKS.parent)):
                del sys.modules[name]
