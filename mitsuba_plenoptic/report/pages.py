"""Pages: one HTML file with everything in it, to be opened from anywhere, made of sections."""

import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup
from PIL import Image

from ..runtime import Facts, Shape, write_text
from .images import data_url


@dataclass(frozen=True)
class Table:
    """A table: by the title of each column, a format of its cells for the values of a record, by name or number.

    The first columns hold words, the others numbers, which are aligned on the right. The cell of a value that a record
    lacks stays empty. In groups, only the first of the rows that begin alike says how it begins.
    """

    columns: Mapping[str, str]
    records: Iterable
    caption: str = ""
    words: int = 1
    grouped: bool = False

    def rows(self) -> Iterator[tuple[bool, list[str]]]:
        """Yield the rows' cells, and whether a row is the first of a group."""
        above = None
        for record in self.records:
            first, *others = (_cell(text, record) for text in self.columns.values())
            leads = self.grouped and first != above
            yield leads, [first if leads or not self.grouped else "", *others]
            above = first


def _cell(text: str, record: Any) -> str:
    try:
        return text.format(**record) if isinstance(record, Mapping) else text.format(*record)
    except KeyError:
        return ""


@dataclass(frozen=True)
class Picture:
    """A figure's PNG with its caption."""

    content: bytes
    caption: str

    @property
    def source(self) -> str:
        """The address that holds the picture."""
        return data_url("png", self.content)

    @property
    def size(self) -> Shape:
        """Width and height in pixels."""
        return Image.open(io.BytesIO(self.content)).size


def pictures_in(folder: Path, captions: Mapping[str, str]) -> list[Picture]:
    """Return the figures in a folder by their names and captions."""
    return [Picture((folder / name).read_bytes(), caption) for name, caption in captions.items()]


Block = str | Table | Picture | list[str]


@dataclass(frozen=True)
class Section:
    """A part of a page below a heading: paragraphs, `Markup`, tables, pictures, and lists of texts."""

    title: str
    blocks: Sequence[Block]

    @property
    def name(self) -> str:
        """What links lead to, unlike the names of elements within sections."""
        return "section-" + re.sub(r"\W+", "-", self.title.lower()).strip("-")


@dataclass(frozen=True)
class Page:
    """A page of sections, below a headline and a sentence; `foot` is its last line."""

    title: str
    lead: str
    sections: Sequence[Section]
    foot: str = ""
    # A script's template, and what it reads.
    script: str = ""
    data: Facts = field(default_factory=dict)
    # Seconds after which a browser loads the page again; 0 for never.
    refresh: int = 0

    def write(self, path: str | Path) -> None:
        """Write the page as an HTML file with everything in it."""
        write_text(Path(path), template("page.html").render(page=self), ".html")


def template(name: str, folder: Path = Path(__file__).parent / "templates") -> Template:
    """Return a template from a folder, by default the folder of the reports."""
    environment = Environment(
        loader=FileSystemLoader([folder, Path(__file__).parent / "templates"]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["prose"] = prose
    return environment.get_template(name)


def prose(text: str) -> str:
    """Return a text with quotation marks and apostrophes as in books; markup stays as it is."""
    if isinstance(text, Markup):
        return text
    return re.sub(r'"(.*?)"', "“\\1”", text.replace("'", "\N{RIGHT SINGLE QUOTATION MARK}"))


def scene_name(scene: str) -> str:
    """Return the name of a scene in words, from its file or its built-in name."""
    return Path(scene).stem.replace("_", " ")
