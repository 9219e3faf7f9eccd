"""Values in scene files: numbers, texts, vectors, colours and transformations."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from warp_psdr.scene.errors import SceneError, did_you_mean, error, listing
from warp_psdr.scene.files.xml_parser import Element
from warp_psdr.scene.plugins import Node
from warp_psdr.scene.transforms import Transform

#: How much the length of a rotation's axis may differ from one without a remark: rounding in a file.
_UNIT = 1e-3


def attributes(
    element: Element, *required: str, optional: tuple[str, ...] = (), also: tuple[str, ...] = ()
) -> dict[str, str]:
    """Return an element's attributes, the required ones first and in order; ``also`` are allowed but left out.

    Raises:
        ValueError: If a required attribute is missing or an unknown one is there.
    """
    known = (*required, *optional)
    for name in element.attributes:
        if name not in known and name not in also:
            raise error(
                element.where,
                f"<{element.tag}> has no attribute '{name}'{did_you_mean(name, known)}",
                f"its attributes are: {listing(known)}",
            )
    missing = [name for name in required if not element.attributes.get(name)]
    # An empty text is a value.
    may_be_empty = element.tag in ("string", "default") and "value" in element.attributes
    if missing and not (missing == ["value"] and may_be_empty):
        raise error(element.where, f"the attribute '{missing[0]}' is missing", f'write {missing[0]}="..."')
    return {name: element.attributes[name] for name in known if name in element.attributes}


def read_property(element: Element) -> tuple[str, Any]:
    """Return the name and the value of a property element.

    Raises:
        ValueError: If its text cannot be read.
    """
    for child in element.children:
        raise error(child.where, f"an element inside <{element.tag}>", "properties hold no elements; move it out")
    if element.tag in ("vector", "point"):
        values = attributes(element, "name", optional=("x", "y", "z", "value"))
        if "value" not in values and not all(axis in values for axis in "xyz"):
            raise error(element.where, "a component is missing", 'write x="..." y="..." z="..." or value="x y z"')
        return values["name"], _vector(element, 0.0)
    if element.tag == "spectrum" and "filename" in element.attributes:
        values = attributes(element, "name", "filename")
        content = {"type": "spectrum", "filename": values["filename"]}
        return values["name"], Node(content, element.where, "texture")
    name, text = attributes(element, "name", "value").values()
    return name, PROPERTY_TAGS[element.tag](text, element)


def read_transform(element: Element, note: Callable[[str], None]) -> np.ndarray:
    """Return the 4x4 matrix of a ``<transform>``: its steps are applied in the order of the file.

    Args:
        element: The element.
        note: Called with remarks for the user.

    Raises:
        ValueError: If a step is unknown or its numbers do not make a transformation.
    """
    total = Transform()
    for step in element.children:
        if step.tag not in _STEPS:
            raise error(
                step.where,
                f"<{step.tag}> is no step of a <transform>{did_you_mean(step.tag, _STEPS)}",
                f"steps are: {listing(_STEPS)}",
            )
        try:
            total = _STEPS[step.tag](step) @ total
            if step.tag == "rotate" and abs(np.linalg.norm(_vector(step, 0.0)) - 1.0) > _UNIT:
                note(
                    f"{step.where}: the axis is no unit vector, so the matrix scales and is no rotation, as in Mitsuba"
                )
        except SceneError as problem:
            text = str(problem)
            raise problem if text.startswith(step.where) else SceneError(f"{step.where}: {text}") from None
    return total.matrix


def _float(text: str, element: Element) -> float:
    try:
        return float(text)
    except ValueError:
        raise error(element.where, f"'{text}' is no number", "write a number such as 0.5") from None


def _integer(text: str, element: Element) -> int:
    try:
        return int(text)
    except ValueError:
        raise error(element.where, f"'{text}' is no whole number", "write one such as 16, or use <float>") from None


def _boolean(text: str, element: Element) -> bool:
    value = {"true": True, "false": False}.get(text.strip().lower())
    if value is None:
        raise error(element.where, f"'{text}' is no truth value", 'write "true" or "false"')
    return value


def _color(text: str, element: Element) -> Node:
    # Checked by the reader of colours, which knows whether the colour is emitted.
    return Node({"type": element.tag, "value": text}, element.where, "texture")


def _numbers(text: str, element: Element, counts: tuple[int, ...]) -> list[float]:
    numbers = [_float(token, element) for token in re.split(r"[\s,]+", text.strip()) if token]
    if len(numbers) not in counts:
        wanted = " or ".join(str(count) for count in counts)
        raise error(element.where, f"got {len(numbers)} numbers in '{text}'", f"write {wanted}")
    return numbers


def _vector(element: Element, default: float) -> list[float]:
    """Return x, y, z of an element: of its attributes x, y, z or of its value, one number or three."""
    given = element.attributes
    if "value" in given:
        if any(axis in given for axis in "xyz"):
            raise error(element.where, "got 'value' besides x, y or z", "write one or the other")
        numbers = _numbers(given["value"], element, (1, 3))
        return numbers * 3 if len(numbers) == 1 else numbers
    return [_float(given[axis], element) if axis in given else default for axis in "xyz"]


def _translate(step: Element) -> Transform:
    attributes(step, optional=("x", "y", "z", "value"))
    return Transform.translate(_vector(step, 0.0))


def _scale(step: Element) -> Transform:
    attributes(step, optional=("x", "y", "z", "value"))
    return Transform.scale(_vector(step, 1.0))


def _rotate(step: Element) -> Transform:
    values = attributes(step, "angle", optional=("x", "y", "z", "value"))
    return Transform.rotate(_vector(step, 0.0), _float(values["angle"], step))


def _look_at(step: Element) -> Transform:
    values = attributes(step, "origin", "target", optional=("up",))
    origin, target = (_numbers(values[name], step, (3,)) for name in ("origin", "target"))
    up = _numbers(values["up"], step, (3,)) if values.get("up") else [0.0, 0.0, 0.0]
    if not any(up):
        # Any direction that is not the viewing direction.
        up = np.eye(3)[int(np.argmin(np.abs(np.subtract(target, origin))))].tolist()
    return Transform.look_at(origin, target, up)


def _matrix(step: Element) -> Transform:
    numbers = _numbers(attributes(step, "value")["value"], step, (9, 16))
    size = 3 if len(numbers) == 9 else 4
    return Transform(np.reshape(numbers, (size, size)))


#: Readers of the property elements.
PROPERTY_TAGS: dict[str, Callable[[str, Element], Any]] = {
    "float": _float,
    "integer": _integer,
    "boolean": _boolean,
    "string": lambda text, _: text,
    "vector": _float,
    "point": _float,
    "rgb": _color,
    "spectrum": _color,
}
_STEPS: dict[str, Callable[[Element], Transform]] = {
    "translate": _translate,
    "scale": _scale,
    "rotate": _rotate,
    "lookat": _look_at,
    "matrix": _matrix,
}
