"""Device functions and structs that are generated for a scene or a record, one line for each value."""

import functools
import hashlib
import inspect
import linecache
from collections.abc import Mapping
from typing import Any, get_args, get_origin

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.math import where3


def make_generated(source: str, **scope: Any) -> wp.Function:
    """Return the Warp function that ``source`` defines.

    Args:
        source: the text of one ``def``, flush left.
        scope: what its text names. Names that stand for one function are said in a comment: Warp takes from the
            cache by the text and by the functions in the order of their first calls, not by who is called where.
    """
    first: dict[wp.Function, str] = {}
    called = [(name, first.setdefault(f, name)) for name, f in scope.items() if isinstance(f, wp.Function)]
    same = ", ".join(f"{name} is {one}" for name, one in called if name != one)
    if same:
        head, rest = source.split("\n", 1)
        source = f"{head}  # {same}\n{rest}"
    # Warp reads the text of a function through ``inspect``, which finds it here.
    file = f"<generated {hashlib.sha256(source.encode()).hexdigest()[:16]}>"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    scope = {"wp": wp, "__name__": __name__, **scope}
    exec(compile(source, file, "exec"), scope)
    name = source[len("def ") : source.index("(")]
    return wp.func(scope[name])


@functools.cache
def make_select(record: type) -> wp.Function:
    """Return ``select(condition, a, b) -> record``: ``a`` if the condition holds, else ``b``, member by member.

    No branch in a loop over lanes. Members are numbers and ``vec3``; tables, which are constants, are left out.
    """
    name = f"where_{record.key.rpartition('.')[2].lower()}"
    lines = [f"def {name}(condition: wp.bool, a: record, b: record) -> record:", "    r = record()"]
    for member, var in record.vars.items():
        if var.type is not wp.uint64:
            where = "where3" if var.type is wp.vec3 else "wp.where"
            lines.append(f"    r.{member} = {where}(condition, a.{member}, b.{member})")
    return make_generated("\n".join([*lines, "    return r", ""]), record=record, where3=where3)


def make_struct(name: str, members: dict[str, Any]) -> type:
    """Return the Warp struct ``name`` with these members: name -> type."""
    return wp.struct(type(name, (), {"__annotations__": members, "__module__": __name__, "__qualname__": name}))


def make_switch(
    name: str,
    test: str,
    functions: Mapping[int, wp.Function],
    otherwise: wp.Function | None = None,
    anchored: bool = False,
) -> wp.Function | None:
    """Return the function ``name``, which calls the one of several whose number a value has; all take the same.

    Args:
        name: of the function.
        test: the value, an expression of the functions' arguments.
        functions: number -> function.
        otherwise: what is called for other numbers. None: there are none, the last function is called without a test,
            and a single function is returned as it is.
        anchored: some of the functions call ``wp.grad`` (``autodiff.py``).

    Returns:
        The function; ``otherwise`` if there is nothing to choose from.
    """
    links = list(functions.items())
    if otherwise is None and links:
        otherwise = links.pop()[1]
    if otherwise is None or not links:
        return otherwise
    signature = inspect.signature(otherwise.func)
    result = signature.return_annotation
    scope: dict[str, Any] = {f"t{i}": p.annotation for i, p in enumerate(signature.parameters.values())}
    scope |= {f"f{i}": function for i, (_number, function) in enumerate(links)}
    scope |= {"rest": otherwise, "result": result, "anchor": anchor}
    parameters = ", ".join(f"{p}: t{i}" for i, p in enumerate(signature.parameters))
    arguments = ", ".join(signature.parameters)
    values = ", ".join(f"r{i}" for i in range(len(get_args(result)))) if get_origin(result) is tuple else ""

    def call(function: str) -> list[str]:
        if result is inspect.Signature.empty:
            return [f"{function}({arguments})", "return"]
        if values:
            return [f"{values} = {function}({arguments})", f"return {values}"]
        return [f"return {function}({arguments})"]

    lines = [f"def {name}({parameters}){'' if result is inspect.Signature.empty else ' -> result'}:"]
    if anchored:
        lines.append("    _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py")
    for i, (number, _function) in enumerate(links):
        lines += [f"    if {test} == {number}:", *(f"        {line}" for line in call(f"f{i}"))]
    lines += [f"    {line}" for line in call("rest")]
    return make_generated("\n".join([*lines, ""]), **scope)
