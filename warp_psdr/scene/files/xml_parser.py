"""Parse XML into elements that know their line, without entities or other external content."""

from __future__ import annotations

import io
import xml.sax.handler
from dataclasses import dataclass, field
from typing import Any
from xml.sax import SAXException, SAXParseException

from warp_psdr.scene.errors import SceneError, error, limit

#: Deeper nesting than any scene needs; protects the recursive reading.
_MAX_DEPTH = 64


@dataclass(eq=False)
class Element:
    """One XML element."""

    tag: str
    attributes: dict[str, str]
    where: str  #: 'scene.xml:12 <shape type="cube">'
    children: list[Element] = field(default_factory=list)


def parse(data: bytes, label: str, most: int) -> tuple[Element, int]:
    """Return the root element, and how many elements there are.

    Args:
        data: The file's bytes.
        label: Its name, for messages.
        most: How many there may be.

    Raises:
        ValueError: If the XML is malformed, declares entities, is nested too deeply or has too many elements.
    """
    from defusedxml import DefusedXmlException
    from defusedxml import sax as defused_sax

    handler = _Handler(label, most)
    try:
        defused_sax.parse(io.BytesIO(data), handler, forbid_dtd=False, forbid_entities=True, forbid_external=True)
    except SceneError:
        raise
    except DefusedXmlException:
        problem_text = "the file declares entities or external content"
        raise error(f"{label}:{handler.line}", problem_text, "remove them") from None
    except SAXParseException as problem:
        place = f"{label}:{problem.getLineNumber()} (column {(problem.getColumnNumber() or 0) + 1})"
        remedy = "close every element and quote every attribute"
        raise error(place, f"malformed XML ({problem.getMessage()})", remedy) from None
    except (SAXException, LookupError, ValueError) as problem:
        raise error(label, f"malformed XML ({problem})", "save the file as UTF-8 XML") from None
    if handler.root is None:
        raise error(label, "the file holds no element", 'write <scene version="3.0.0">...</scene>')
    return handler.root, handler.count


class _Handler(xml.sax.handler.ContentHandler):
    """Builds the tree of elements."""

    def __init__(self, label: str, most: int):
        super().__init__()
        self.label = label
        self.most = most
        self.count = 0
        self.root: Element | None = None
        self._open: list[Element] = []
        self._locator: Any = None

    @property
    def line(self) -> int:
        """Line that is being parsed, from 1."""
        return int(self._locator.getLineNumber()) if self._locator is not None else 1

    def setDocumentLocator(self, locator: Any) -> None:
        """Keep the parser's position."""
        self._locator = locator

    def startElement(self, name: str, attrs: Any) -> None:
        """Open an element."""
        attributes = dict(attrs.items())
        shown = "".join(f' {key}="{attributes[key]}"' for key in ("type", "id", "name") if key in attributes)
        element = Element(name, attributes, f"{self.label}:{self.line} <{name}{shown}>")
        if len(self._open) >= _MAX_DEPTH:
            raise limit(element.where, f"elements are nested more than {_MAX_DEPTH} deep", "flatten the scene")
        self.count += 1
        if self.count > self.most:
            raise limit(element.where, "the scene has too many elements", "put geometry into meshes")
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def endElement(self, name: str) -> None:
        """Close an element."""
        self._open.pop()
