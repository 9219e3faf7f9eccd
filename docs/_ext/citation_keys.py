"""A bibliography whose labels are the keys that the survey, the code and the papers' readers use: [ZMY*20]."""

from __future__ import annotations

from pybtex.plugin import register_plugin
from pybtex.style.formatting.plain import Style
from pybtex.style.labels import BaseLabelStyle


class KeyLabels(BaseLabelStyle):
    """Labels that are the entries' keys."""

    def format_labels(self, sorted_entries):
        """Yield each entry's key."""
        return [entry.key for entry in sorted_entries]


class KeyStyle(Style):
    """Plain entries, labelled by their keys."""

    default_label_style = KeyLabels


register_plugin("pybtex.style.formatting", "citation_keys", KeyStyle)


def setup(app) -> dict:
    """Register nothing with Sphinx; the style is pybtex's."""
    return {"parallel_read_safe": True}
