"""Pictures on cards without a text of their own are described by their card's title, for readers who hear pages."""

from __future__ import annotations

from typing import Any

from docutils import nodes


def _describe(app: Any, doctree: nodes.document) -> None:
    for image in doctree.findall(nodes.image):
        if not image.get("alt"):
            card = image.parent
            titles = [
                node.astext()
                for node in card.findall()
                if "sd-card-title" in getattr(node, "attributes", {}).get("classes", [])
            ]
            image["alt"] = titles[0] if titles else ""


def setup(app: Any) -> dict[str, Any]:
    """Describe pictures once a page is read."""
    app.connect("doctree-read", _describe)
    return {"parallel_read_safe": True, "version": "1"}
