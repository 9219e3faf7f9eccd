"""Messages for scenes that cannot be used: where, what was found, what is expected, and the remedy."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable


class SceneError(ValueError):
    """A scene file or dictionary that cannot be turned into a scene."""


class LimitError(SceneError):
    """A scene that is larger than is read; loading ends at once, while other problems are collected."""


class OutsideError(SceneError):
    """A file that lies where a scene may not read."""


class ReportedError(SceneError):
    """Something that cannot be built because of a problem that is reported already."""


#: Letters of a part of a message, and of a name that others are compared with, which takes quadratic time.
_LETTERS_MAX, _NAME_MAX = 1000, 100


def error(where: str, problem: str, remedy: str) -> SceneError:
    """Return the exception for ``problem`` at ``where``; ``remedy`` says what is expected or what to do."""
    return SceneError(": ".join((_short(where), "; ".join((_short(problem), _short(remedy))))))


def limit(where: str, problem: str, remedy: str) -> LimitError:
    """Return the exception for a scene that is larger than is read; see ``error``."""
    return LimitError(str(error(where, problem, remedy)))


def _short(text: str) -> str:
    """Leave out the middle of a text that nobody reads to its end."""
    return text if len(text) <= _LETTERS_MAX else f"{text[: _LETTERS_MAX // 2]} ... {text[-_LETTERS_MAX // 2 :]}"


def missing_file(where: str, path: object, remedy: str) -> FileNotFoundError:
    """Return the exception for a file that does not exist."""
    return FileNotFoundError(f"{where}: no such file: '{path}'; {remedy}")


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """Return `` (did you mean 'x'?)`` for the choice nearest to ``name``, or an empty string."""
    known = [choice for choice in itertools.islice(choices, _LETTERS_MAX) if len(choice) <= _NAME_MAX]
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6) if len(name) <= _NAME_MAX else []
    return f" (did you mean '{close[0]}'?)" if close else ""


def listing(choices: Iterable[str]) -> str:
    """Return the choices as a comma-separated list."""
    return ", ".join(choices)
