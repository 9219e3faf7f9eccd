"""Layers: device code knows no host code, imports run in no circles, a name has one meaning, files stay readable."""

import ast
import functools
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
import warp as wp

from warp_psdr.kernels import modules
from warp_psdr.kernels.primitive import table
from warp_psdr.kernels.primitive.kind import Kind
from warp_psdr.scene.kinds.table import KINDS

ROOT = Path(__file__).resolve().parents[1]
#: What device code may import besides its own package.
DEVICE_IMPORTS = {"__future__", "collections", "ctypes", "dataclasses", "functools", "math", "typing", "warp"}
DEVICE_IMPORTS |= {"hashlib", "inspect", "linecache", "platform"}  # for made functions, and compiler flags
MAX_LINES = 500
#: What names a kind of shapes without triangles: on the device its record, on the host its class, its name and lists.
NAMES_OF_KINDS = {
    "kernels": {name for name, value in vars(table).items() if isinstance(value, Kind)} | {"CURVES"},
    "warp_psdr": {name for kind in KINDS for name in (kind.__name__, repr(kind.name))}
    | {"Curves", "grid_shapes", "network_shapes", "curve_shapes"},
}
#: Most files that name one beside the rooms of kinds themselves.
MOST_NAMING = {"kernels": 14, "warp_psdr": 16}
#: Host code from the ground up: what stands in a row imports from its own row and from those above it.
HOST_LAYERS = (
    {
        *("arrays", "columns", "compiler", "device", "exr_header", "files", "film", "float_images", "forks"),
        *("headers", "html"),
        *(
            "image",
            "image_io",
            "invalid",
            "kernel_cache",
            "losses",
            "plots",
            "progress",
            "quiet",
            "scenes",
            "startup",
            "workers",
        ),
    },
    {"options"},
    {"scene"},
    {"topology"},
    {"plan", "rows"},
    {"estimate"},
    {
        "accuracy",
        "boundary",
        "cameras",
        "coverage",
        "coverage_scenes",
        "guiding",
        "interior",
        "moment",
        "optim",
        "parts",
    }
    | {"sdf", "view"},
    {"render"},
    {"aov", "torch", "__init__"},
    {"certify", "distributed", "fit", "observe"},
    {"cli", "cli_certify", "cli_output", "unknowns"},
)
#: Device code that imports nothing but itself and ``invalid``, the counters of samples that are dropped.
GROUND_FLOOR = {"autodiff", "constants", "math", "rng", "sampling", "sink", "structs"}
#: Device code further up: what stands on the left imports nothing that stands on the right.
DEVICE_RULES = (
    (
        {"bsdf", "bvh", "emitter", "sensor", "shape", "texture"},
        {"path", "vertex", "scattering", "primal", "splat", "trace", "camera_rays", "lanes", "interior", "boundary"},
    ),
    (
        {"path", "vertex", "scattering"},
        {"primal", "splat", "trace", "camera_rays", "lanes", "interior", "boundary"},
    ),
    ({"primal", "splat", "trace", "camera_rays", "lanes", "interior"}, {"boundary"}),
)
#: A scene's record holds the handle of its ray structure; bundles of rays are made of the records of lanes.
DEVICE_EXCEPTIONS = {
    ("structs", "bvh.wide"),
    *((rays, "lanes.lanes") for rays in ("bvh.bundle", "bvh.each", "bvh.roots")),
}

#: Factories with a wide signature, which one that chooses among several calls like the others (``interior.replay``).
ONE_OF_SEVERAL = {"make_material_sweep"}

DEVICE_FILES = sorted((ROOT / "kernels").rglob("*.py"))
HOST_FILES = sorted((ROOT / "warp_psdr").rglob("*.py"))
ALL_FILES = sorted(path for top in ("kernels", "warp_psdr", "tests", "examples") for path in (ROOT / top).rglob("*.py"))


#: Several rules look at each file.
parsed = functools.cache(ast.parse)


def names(path: Path) -> str:
    return str(path.relative_to(ROOT))


def foreign_imports(source: str) -> Iterator[str]:
    """Modules that a device file imports and may not."""
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [f"{'.' * node.level}{node.module or ''}"]
        else:
            continue
        for module in modules:
            if module.split(".")[0] not in DEVICE_IMPORTS and not (module + ".").startswith("warp_psdr.kernels."):
                yield module


def package_modules(top: str) -> dict[str, Path]:
    """Dotted name within the package -> file, for host code ("warp_psdr") or device code ("kernels")."""
    found = {}
    for path in sorted((ROOT / top).rglob("*.py")):
        parts = path.relative_to(ROOT / top).with_suffix("").parts
        if top == "warp_psdr" and parts[0] == "kernels":
            continue
        found[".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)] = path
    return found


def is_for_type_checkers(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def own_imports(source: str, name: str, modules: Iterable[str], package: str) -> set[str]:
    """Modules of the package that one of them imports, at module level or within functions, but for type checkers."""
    found: set[str] = set()
    pending: list[ast.AST] = [parsed(source)]
    while pending:
        node = pending.pop()
        pending += [child for child in ast.iter_child_nodes(node) if not is_for_type_checkers(child)]
        if isinstance(node, ast.Import):
            named = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = [package, *name.split(".")][: -node.level] if node.level else []
            if node.level and f"{name}.__init__" in modules:
                above = [package, *name.split(".")]
            base = ".".join([*above, *([node.module] if node.module else [])])
            named = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        for full in named:
            if full == package:
                found.add("__init__")
            within = full.removeprefix(package + ".")
            if within != full:
                parent = within.rpartition(".")[0] or "__init__"
                found.add(within if within in modules else parent)
    return (found & set(modules)) - {name}


@functools.cache
def import_graph(top: str) -> dict[str, set[str]]:
    modules = package_modules(top)
    package = "warp_psdr" if top == "warp_psdr" else "warp_psdr.kernels"
    return {name: own_imports(path.read_text(), name, modules, package) for name, path in modules.items()}


def circle(graph: dict[str, set[str]]) -> list[str]:
    """A circle of imports, the first module again at its end; empty: there is none."""
    done: set[str] = set()

    def walk(name: str, way: list[str]) -> list[str]:
        if name in way:
            return [*way[way.index(name) :], name]
        if name not in done:
            for other in sorted(graph[name]):
                if found := walk(other, [*way, name]):
                    return found
            done.add(name)
        return []

    for name in graph:
        if found := walk(name, []):
            return found
    return []


def upward_imports(graph: dict[str, set[str]]) -> Iterator[str]:
    """Imports of host code from a row of ``HOST_LAYERS`` below its own."""
    row = {name: i for i, names in enumerate(HOST_LAYERS) for name in names}
    for name, imported in graph.items():
        for other in sorted(imported):
            a, b = row.get(name.split(".")[0]), row.get(other.split(".")[0])
            if a is not None and b is not None and b > a:
                yield f"{name} imports {other}"


def broken_rules(graph: dict[str, set[str]]) -> Iterator[str]:
    """Imports of device code that ``GROUND_FLOOR`` and ``DEVICE_RULES`` forbid."""
    for name, imported in graph.items():
        folder = name.split(".")[0]
        for other in sorted(imported):
            above = other.split(".")[0]
            forbidden = folder in GROUND_FLOOR and above not in GROUND_FLOOR | {"invalid"}
            forbidden |= any(folder in left and above in right for left, right in DEVICE_RULES)
            if forbidden and (name, other) not in DEVICE_EXCEPTIONS:
                yield f"{name} imports {other}"


def device_names(source: str) -> Iterator[str]:
    """Records, functions and factories of device code at module level."""
    for node in parsed(source).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
            yield node.name


def told_apart(source: str) -> Iterator[str]:
    """What a file reads by name, compares with or keys a table by."""
    for node in ast.walk(parsed(source)):
        texts = [node.left, *node.comparators] if isinstance(node, ast.Compare) else getattr(node, "keys", [])
        yield from (
            repr(text.value) for text in texts if isinstance(text, ast.Constant) and isinstance(text.value, str)
        )
        if isinstance(node, ast.Name | ast.Attribute):
            yield node.id if isinstance(node, ast.Name) else node.attr


def shared_modules(source: str) -> Iterator[str]:
    """Names of the modules that a device file's own kernels share with others."""
    for node in parsed(source).body:
        for decorator in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
            for keyword in decorator.keywords if isinstance(decorator, ast.Call) else ():
                if keyword.arg == "module" and isinstance(keyword.value, ast.Name):
                    yield keyword.value.id


def is_constant_name(node: ast.expr) -> bool:
    if isinstance(node, ast.Tuple):
        return all(is_constant_name(element) for element in node.elts)
    return isinstance(node, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]*", node.id) is not None


def misplaced_statements(source: str) -> Iterator[str]:
    """Module-level statements of a device file other than imports, UPPER_CASE constants, records and functions."""
    for node in parsed(source).body:
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
    for function in ast.walk(parsed(source)):
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
    for node in ast.walk(parsed(source)):
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


def wide_signatures(source: str) -> Iterator[str]:
    """Factories that take a whole ``PathConfig``, hand it to nobody and read at most two of its members."""
    for function in parsed(source).body:
        if not isinstance(function, ast.FunctionDef) or function.name in ONE_OF_SEVERAL:
            continue
        for arg in function.args.args:
            if arg.annotation is None or ast.unparse(arg.annotation) != "PathConfig":
                continue
            nodes = list(ast.walk(function))
            uses = sum(isinstance(node, ast.Name) and node.id == arg.arg for node in nodes)
            reads = [n.attr for n in nodes if isinstance(n, ast.Attribute) and ast.unparse(n.value) == arg.arg]
            if len(reads) == uses and len(set(reads)) <= 2:
                yield f"line {function.lineno}: {function.name} reads {', '.join(sorted(set(reads)))}"


def broken_by(check: Callable[[str], Iterable[str]], files: list[Path]) -> dict[str, list[str]]:
    """What a rule finds in files, by the names of those that break it."""
    found = {names(path): list(check(path.read_text())) for path in files}
    return {name: lines for name, lines in found.items() if lines}


def test_device_code_imports_no_host_code() -> None:
    assert broken_by(foreign_imports, DEVICE_FILES) == {}


def test_device_files_hold_definitions_only() -> None:
    # A module-level number named like a loop index of device code would be hashed into the module and recompile it.
    assert broken_by(misplaced_statements, DEVICE_FILES) == {}


def test_local_records_are_not_named_like_warps_numbers() -> None:
    # Warp 1.19 takes ``e.kind`` for the number ``wp.e`` while a function has not been built, and hashes it. So a kernel
    # would have one name where the functions it shares were compiled and another where they came from the cache, and
    # the second start would compile again (``tests/test_kernel_names.py``).
    assert broken_by(shadowed_constants, DEVICE_FILES) == {}


def test_signatures_say_what_factories_read() -> None:
    # Could the factory take the groups or the values instead?
    assert broken_by(wide_signatures, DEVICE_FILES) == {}


def test_host_code_leaves_warps_global_state_alone() -> None:
    assert broken_by(global_state_changes, HOST_FILES) == {}


def test_files_are_short_enough_to_read() -> None:
    # Could a stage or a method move into a file of its own?
    assert broken_by(lambda source: source.splitlines()[MAX_LINES:][:1], ALL_FILES) == {}


@pytest.mark.parametrize("top", ["warp_psdr", "kernels"])
def test_few_files_name_a_kind_of_shapes(top: str) -> None:
    # A new kind would change all of them (``docs/contributing/walks.md``).
    rooms = ROOT / "kernels/primitive", ROOT / "warp_psdr/scene/kinds", ROOT / "warp_psdr/topology/kinds"
    files = [path for path in (ROOT / top).rglob("*.py") if path.parent not in rooms]
    naming = [names(path) for path in files if NAMES_OF_KINDS[top] & set(told_apart(path.read_text()))]
    assert 0 < len(naming) <= MOST_NAMING[top], naming


def test_what_is_written_once_stays_short() -> None:
    # Terms of silhouettes are three kernels and what families of shapes tell them; a plan compares words.
    silhouettes = [f for f in DEVICE_FILES if f.parent.name == "silhouette"]
    once = [f for f in silhouettes if f.stem in ("primary", "secondary", "foreground")]
    touches = [f for f in silhouettes if f.stem.endswith("_touch")]
    assert len(once) == 3 and sum(len(f.read_text().splitlines()) for f in once) <= 540
    assert touches and max(len(f.read_text().splitlines()) for f in touches) <= 250
    plan = list((ROOT / "warp_psdr/plan").glob("*.py"))
    assert len(plan) > 9 and sum(len(f.read_text().splitlines()) for f in plan) <= 2700
    assert len(list((ROOT / "warp_psdr/estimate/boundary/terms").glob("*.py"))) <= 29


def test_dispatch_is_generated() -> None:
    assert [names(path) for path in DEVICE_FILES if "def _either_" in path.read_text()] == []


@pytest.mark.parametrize("top", ["warp_psdr", "kernels"])
def test_imports_run_in_no_circle(top: str) -> None:
    # Imports within functions count: one that is there to break a circle hides it.
    assert circle(import_graph(top)) == []


def test_host_code_imports_from_its_own_layer_and_those_below() -> None:
    assert list(upward_imports(import_graph("warp_psdr"))) == []


def test_device_code_keeps_its_layers() -> None:
    assert list(broken_rules(import_graph("kernels"))) == []


def test_one_name_has_one_meaning_in_device_code() -> None:
    places: dict[str, list[str]] = {}
    for path in DEVICE_FILES:
        for name in device_names(path.read_text()):
            places.setdefault(name, []).append(names(path))
    assert len(places) > 100
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


@pytest.mark.parametrize(
    ("name", "source", "expected"),
    [
        ("a.b", "from warp_psdr.c import d", {"c.d"}),
        ("a.b", "from warp_psdr.c.d import function", {"c.d"}),
        ("a.b", "def f():\n    from warp_psdr import e", {"e"}),
        ("a.b", "from .x import function", {"a.x"}),
        ("a", "from .x import function", {"a.x"}),
        ("a.b", "import warp_psdr as psdr", {"__init__"}),
        ("a.b", "from warp_psdr import plan", {"__init__"}),
        ("a.b", "if TYPE_CHECKING:\n    from warp_psdr.c import d\nimport os", set()),
    ],
)
def test_imports_are_found(name: str, source: str, expected: set[str]) -> None:
    modules = {"__init__", "a", "a.__init__", "a.b", "a.x", "c", "c.d", "e"}
    assert own_imports(source, name, modules, "warp_psdr") == expected


def test_circles_and_broken_layers_are_found() -> None:
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert list(upward_imports({"scene.scene": {"plan.plan", "options.guiding"}})) == ["scene.scene imports plan.plan"]
    assert list(broken_rules({"rng": {"vertex"}, "emitter.area": {"path"}, "interior.sweep": {"vertex"}})) == [
        "rng imports vertex",
        "emitter.area imports path",
    ]
    assert list(device_names("@wp.struct\nclass A:\n    x: wp.vec3\n@wp.func\ndef f(): ...\ndef make(): ...")) == [
        "A",
        "f",
        "make",
    ]


def test_functions_are_not_hidden_by_folders_of_their_name() -> None:
    code = "import warp_psdr, warp_psdr.accuracy.report, warp_psdr.plan.boundary, warp_psdr.view.fields\n"
    code += "found = [warp_psdr.accuracy, warp_psdr.plan, warp_psdr.render, warp_psdr.view]\n"
    code += "assert all(map(callable, found)), found"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


@pytest.mark.parametrize(
    ("code", "column", "file"),
    [
        ("from warp_psdr.kernels import path", 31, "kernels/path.py"),
        ("from warp_psdr.kernels.path import make_path_step", 40, "kernels/path.py"),
        ("from warp_psdr.kernels.boundary.path_space import primary", 52, "kernels/boundary/path_space/primary.py"),
        ("from warp_psdr.scene.scene import Scene", 36, "warp_psdr/scene/scene.py"),
    ],
)
def test_editors_go_to_the_definition(code: str, column: int, file: str) -> None:
    jedi = pytest.importorskip("jedi")
    script = jedi.Script(code, path=ROOT / "script.py", project=jedi.Project(ROOT))
    found = script.goto(1, column, follow_imports=True)
    assert [Path(name.module_path).resolve() for name in found] == [ROOT / file]


def test_who_compiles_a_shared_module_knows_its_files() -> None:
    """A kernel that is imported later would compile the module anew."""
    found: dict[str, set[str]] = {}
    for path in DEVICE_FILES:
        file = ".".join(path.relative_to(ROOT / "kernels").with_suffix("").parts)
        for name in shared_modules(path.read_text()):
            found.setdefault(getattr(modules, name), set()).add(file)
    assert found == {name: set(files) for name, files in modules.FILES.items()}


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
        (wide_signatures, "def make_f(config: PathConfig):\n    return make_g(config.surfaces, config.rays.width)"),
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
        (wide_signatures, "def make_f(config: PathConfig):\n    return make_g(config, config.sampler)"),
        (wide_signatures, "def make_f(c: PathConfig):\n    return make_g(c.surfaces, c.lights, c.rays)"),
        (global_state_changes, "device = wp.get_device()\nconfig = wp.config.version"),
    ],
)
def test_each_rule_lets_good_code_pass(check, source: str) -> None:
    assert list(check(source)) == []
