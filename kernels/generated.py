"""Device functions and structs that are made for a scene: one line a value of its materials, by the values' names."""

import hashlib
import linecache
from typing import Any

import warp as wp


def make_generated(source: str, **scope: Any) -> wp.Function:
    """Return the Warp function that ``source`` defines.

    Args:
        source: the text of one ``def``, flush left.
        scope: what its text names.
    """
    # Warp reads the text of a function through ``inspect``, which finds it here.
    file = f"<generated {hashlib.sha256(source.encode()).hexdigest()[:16]}>"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    scope = {"wp": wp, "__name__": __name__, **scope}
    exec(compile(source, file, "exec"), scope)
    name = source[len("def ") : source.index("(")]
    return wp.func(scope[name])


def make_struct(name: str, members: dict[str, Any]) -> type:
    """Return the Warp struct ``name`` with these members: name -> type."""
    return wp.struct(type(name, (), {"__annotations__": members, "__module__": __name__, "__qualname__": name}))
