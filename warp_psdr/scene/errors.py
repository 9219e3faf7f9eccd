"""Messages for scenes that cannot be used: where, what was found, what is expected, and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SceneError(ValueError):
    """A scene file or dictionary that cannot be turned into a scene."""


def error(where: str, problem: str, remedy: str) -> SceneError:
    """Return the exception for ``problem`` at ``where``; ``remedy`` says what is expected or what to do."""
    return SceneError(f"{where}: {problem}; {remedy}")


def missing_file(where: str, path: object, remedy: str) -> FileNotFoundError:
    """Return the exception for a file that does not exist."""
    return FileNotFoundError(f"{where}: no such file: '{path}'; {remedy}")


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """Return `` (did you mean 'x'?)`` for the choice nearest to ``name``, or an empty string."""
    close = difflib.get_close_matches(name, list(choices), n=1, cutoff=0.6)
    return f" (did you mean '{close[0]}'?)" if close else ""


def listing(choices: Iterable[str]) -> str:
    """Return the choices as a comma-separated list."""
    return ", ".join(choices)
