"""Formulas as MathML, made when the site is built: readable without a network and without scripts."""

from __future__ import annotations

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.util import logging

logger = logging.getLogger(__name__)


def _write(translator, node, block: bool) -> None:
    try:
        translator.body.append(convert(node.astext(), display="block" if block else "inline"))
    except Exception as problem:  # the converter has no class of its own for them
        logger.warning("formula %r: %s", node.astext(), problem, location=node)
    raise nodes.SkipNode


def visit_math(translator, node) -> None:
    """Write an inline formula."""
    _write(translator, node, block=False)


def visit_math_block(translator, node) -> None:
    """Write a displayed formula."""
    _write(translator, node, block=True)


def setup(app) -> dict:
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
    return {"parallel_read_safe": True}
