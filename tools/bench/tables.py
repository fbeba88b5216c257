"""Tables in Markdown, and where pages show them: from ``<!-- bench: NAME -->`` to ``<!-- /bench -->``."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

Columns = Mapping[str, str]
"""Headings, and the format of each cell, such as ``"{psnr_db:.1f}"``."""

_MARKED = re.compile(r"(<!-- bench: ([\w.-]+)((?: \S+=\S+)*) -->\n)(.*?)(\n<!-- /bench -->)", re.DOTALL)


@dataclass(frozen=True)
class Pivot:
    """A table with lines and columns by formats of rows; cells of the same line and column are joined by semicolons."""

    line: str
    column: str
    cell: str
    where: Callable[[Mapping[str, Any]], bool] = lambda row: True
    """Which rows are shown."""

    def markdown(self, rows: Iterable[Mapping[str, Any]]) -> str:
        """Return the table."""
        cells: dict[str, dict[str, str]] = {}
        for row in filter(self.where, rows):
            line, column = cells.setdefault(cell(self.line, row), {}), cell(self.column, row)
            line[column] = "; ".join(filter(None, (line.get(column), cell(self.cell, row))))
        headings = list(dict.fromkeys(heading for line in cells.values() for heading in line))
        return _laid_out(
            ["", *headings], [[name, *(line.get(each, "") for each in headings)] for name, line in cells.items()]
        )


def markdown(columns: Columns, rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows as a table."""
    return _laid_out(list(columns), [[cell(form, row) for form in columns.values()] for row in rows])


def cell(form: str, row: Mapping[str, Any]) -> str:
    """Return a formatted cell, empty where the row has nothing for it."""
    try:
        return form.format(**row).strip()
    except (KeyError, TypeError):
        return ""


def _laid_out(headings: list[str], lines: list[list[str]]) -> str:
    rule = ["---"] * len(headings)
    shown = [" | ".join(headings), "|".join(rule), *(" | ".join(line) for line in lines)]
    return "\n".join(f"|{line}|" if line.startswith("---") else f"| {line} |" for line in shown)


def marked(text: str) -> list[tuple[str, list[str]]]:
    """Return the names of the cases whose tables a page shows, and the options that the marks state."""
    return [(found[2], found[3].split()) for found in _MARKED.finditer(text)]


def with_tables(text: str, table: Callable[[str, list[str]], str | None]) -> str:
    """Return a page with new tables; those for which ``table`` returns None stay as they are."""

    def replaced(found: re.Match[str]) -> str:
        new = table(found[2], found[3].split())
        return found[0] if new is None else f"{found[1]}\n{new}\n{found[5]}"

    return _MARKED.sub(replaced, text)
