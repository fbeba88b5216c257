"""Check a built site without a network: ``python tools/check_site.py build/docs``.

Every link within it leads to a file, and to a place in that file; nothing is loaded from elsewhere; and its search
finds what new readers ask for. What is found wrong is listed, and the exit status is 1.
"""

from __future__ import annotations

import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ASKED = {
    "wavelength": "reference/conventions",
    "accuraci": "theory/accuracy",
    "mirror": "reference/models",
    "lattic": "reference/develop/extending",
    "cite": "theory/sources",
    "airi": "theory/accuracy",
    "bokeh": "guides/ordinary",
}
"""Stems of words, as the search has them, and a page that it must offer for each."""

LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}
"""Elements that a browser loads something for."""


class Page(HTMLParser):
    """The places, the links and the loaded files of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.places: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.unnamed: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take up an element."""
        values = dict(attrs)
        self.places |= {value for name in ("id", "name") if (value := values.get(name))}
        if tag == "a" and values.get("href"):
            self.links.append(values["href"] or "")
        if tag == "img" and not values.get("alt"):
            self.unnamed.append(values.get("src") or "")
        if (name := LOADED.get(tag)) and values.get(name) and values.get("rel") != "canonical":
            self.loaded.append(values[name] or "")


def broken_links(site: Path) -> list[str]:
    """Return what is wrong with the links and the loaded files of a site."""
    pages = {path: Page(path.read_text()) for path in sorted(site.rglob("*.html"))}
    found = []
    for path, page in pages.items():
        name = path.relative_to(site)
        found += [f"{name}: {source}: a picture without a text" for source in page.unnamed]
        for link in page.links + page.loaded:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                if link in page.loaded and parts.scheme != "data":
                    found.append(f"{name}: it loads {link}")
                continue
            target = path if not parts.path else (path.parent / unquote(parts.path)).resolve()
            if not target.exists():
                found.append(f"{name}: {link}: there is no such file")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                found.append(f"{name}: {link}: there is no such place")
    return found


def missing_words(site: Path) -> list[str]:
    """Return the words that the search index does not lead to their page from."""
    text = (site / "searchindex.js").read_text()
    index = json.loads(re.fullmatch(r"Search\.setIndex\((.*)\);?\s*", text, re.DOTALL)[1])  # type: ignore[index]
    found = []
    for word, page in ASKED.items():
        places = {
            index["docnames"][place] for terms in ("terms", "titleterms") for place in _list(index[terms].get(word))
        }
        if page not in places:
            found.append(f"search: {word}: it does not find {page}")
    return found


def _list(value: object) -> list[int]:
    return value if isinstance(value, list) else [] if value is None else [value]  # type: ignore[list-item]


def main() -> int:
    """Check the site that is named."""
    site = Path(sys.argv[1]).resolve()
    found = broken_links(site) + missing_words(site)
    print(
        "\n".join(found)
        or f"{site}: {len(list(site.rglob('*.html')))} pages, all links lead somewhere, nothing is loaded"
    )
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
