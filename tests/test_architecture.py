"""The layers: device code knows no host code, host code leaves Warp's global state alone, files stay readable."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import warp as wp

ROOT = Path(__file__).resolve().parents[1]
#: What device code may import besides its own package.
DEVICE_IMPORTS = {"__future__", "collections", "ctypes", "dataclasses", "functools", "math", "typing", "warp"}
MAX_LINES = 500

DEVICE_FILES = sorted((ROOT / "kernels").rglob("*.py"))
HOST_FILES = sorted((ROOT / "warp_psdr").rglob("*.py"))
ALL_FILES = sorted(path for top in ("kernels", "warp_psdr", "tests", "examples") for path in (ROOT / top).rglob("*.py"))


def names(path: Path) -> str:
    return str(path.relative_to(ROOT))


def foreign_imports(source: str) -> Iterator[str]:
    """Modules that a device file imports and may not."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [f"{'.' * node.level}{node.module or ''}"]
        else:
            continue
        for module in modules:
            if module.split(".")[0] not in DEVICE_IMPORTS and not (module + ".").startswith("warp_psdr.kernels."):
                yield module


def is_constant_name(node: ast.expr) -> bool:
    if isinstance(node, ast.Tuple):
        return all(is_constant_name(element) for element in node.elts)
    return isinstance(node, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]*", node.id) is not None


def misplaced_statements(source: str) -> Iterator[str]:
    """Module-level statements of a device file other than imports, UPPER_CASE constants, records and functions."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.Import | ast.ImportFrom | ast.FunctionDef):
            continue
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            continue
        if isinstance(node, ast.Assign) and all(is_constant_name(target) for target in node.targets):
            continue
        if isinstance(node, ast.AnnAssign) and is_constant_name(node.target):
            continue
        if isinstance(node, ast.ClassDef):
            decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
            frozen = any("dataclass" in decorator and "frozen=True" in decorator for decorator in decorators)
            if "wp.struct" in decorators or frozen or [ast.unparse(base) for base in node.bases] == ["NamedTuple"]:
                continue
        yield f"line {node.lineno}: {ast.unparse(node).splitlines()[0]}"


def shadowed_constants(source: str) -> Iterator[str]:
    """Attributes of local variables that are named like a number of Warp's, such as ``e``."""
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef):
            continue
        nodes = list(ast.walk(function))
        local = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
        for node in nodes:
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in local:
                if isinstance(getattr(wp, node.value.id, None), int | float):
                    yield f"line {node.lineno}: {ast.unparse(node)}"


def global_state_changes(source: str) -> Iterator[str]:
    """Statements of a host file that set Warp's configuration or its default device."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(re.match(r"(wp|warp)\.config\b", ast.unparse(target)) for target in targets):
                yield f"line {node.lineno}: {ast.unparse(node)}"
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in ("wp.set_device", "warp.set_device") or (
                called == "setattr" and re.match(r"(wp|warp)\.config\b", ast.unparse(node.args[0]))
            ):
                yield f"line {node.lineno}: {ast.unparse(node)}"


@pytest.mark.parametrize("path", DEVICE_FILES, ids=names)
def test_device_code_imports_no_host_code(path: Path) -> None:
    assert list(foreign_imports(path.read_text())) == []


@pytest.mark.parametrize("path", DEVICE_FILES, ids=names)
def test_device_files_hold_definitions_only(path: Path) -> None:
    # A module-level number named like a loop index of device code would be hashed into the module and recompile it.
    assert list(misplaced_statements(path.read_text())) == []


@pytest.mark.parametrize("path", DEVICE_FILES, ids=names)
def test_local_records_are_not_named_like_warps_numbers(path: Path) -> None:
    # Warp 1.19 takes ``e.kind`` for the number ``wp.e`` while a function has not been built, and hashes it. So a kernel
    # would have one name where the functions it shares were compiled and another where they came from the cache, and
    # the second start would compile again (``tests/test_kernel_names.py``).
    assert list(shadowed_constants(path.read_text())) == []


@pytest.mark.parametrize("path", HOST_FILES, ids=names)
def test_host_code_leaves_warps_global_state_alone(path: Path) -> None:
    assert list(global_state_changes(path.read_text())) == []


@pytest.mark.parametrize("path", ALL_FILES, ids=names)
def test_files_are_short_enough_to_read(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= MAX_LINES, "could a stage or a method move into a file of its own?"


def test_there_are_files_to_check() -> None:
    assert len(DEVICE_FILES) > 5
    assert len(HOST_FILES) > 5


@pytest.mark.parametrize(
    ("check", "source"),
    [
        (foreign_imports, "import numpy as np"),
        (foreign_imports, "from warp_psdr.scene import description"),
        (foreign_imports, "from warp_psdr import kernels_of_ours"),
        (foreign_imports, "from . import structs"),
        (foreign_imports, "def f():\n    import os"),
        (misplaced_statements, "index = 3"),
        (misplaced_statements, "for N in range(3):\n    pass"),
        (misplaced_statements, "print('loaded')"),
        (misplaced_statements, "class Options:\n    pass"),
        (shadowed_constants, "def f(scene):\n    e = scene.emitters[0]\n    return e.kind"),
        (global_state_changes, "wp.config.quiet = True"),
        (global_state_changes, "def f():\n    warp.config.mode = 'debug'"),
        (global_state_changes, "wp.set_device('cpu')"),
        (global_state_changes, "setattr(wp.config, 'quiet', True)"),
    ],
)
def test_each_rule_finds_what_breaks_it(check, source: str) -> None:
    assert len(list(check(source))) == 1


@pytest.mark.parametrize(
    ("check", "source"),
    [
        (foreign_imports, "import math\nimport warp as wp\nfrom warp_psdr.kernels.structs import Scene"),
        (misplaced_statements, '"""Doc."""\nPI = 3.14\nA, B = 1, 2\n@wp.struct\nclass S:\n    x: wp.vec3'),
        (shadowed_constants, "def f(e, n):\n    e.kind = n.kind\n    n = 1\n    return n.kind + math.pi"),
        (global_state_changes, "device = wp.get_device()\nconfig = wp.config.version"),
    ],
)
def test_each_rule_lets_good_code_pass(check, source: str) -> None:
    assert list(check(source)) == []
