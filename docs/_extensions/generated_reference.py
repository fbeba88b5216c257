"""Pages of the reference that are made from the sources: the plugins' parameters, and the command's options.

They have a file of their own with what stands at their top, and get the rest when Sphinx reads them.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parents[2] / "mitsuba_plenoptic"

PLUGINS = {
    "plenoptic": "plugins/sensor.py",
    "plenoptic_wave": "plugins/integrator.py",
    "plenoptic_laser": "extensions/laser/laser_integrator.py",
}
"""Files of the plugins by their names."""

_KINDS = {"plenoptic": "sensor", "plenoptic_wave": "integrator", "plenoptic_laser": "integrator"}


def plugin_docstring(name: str) -> str:
    """Return the documentation of a plugin's class, which exists only once a variant of Mitsuba is set.

    That of the sensor has a row for all parameters of the camera, which come from their table.
    """
    from mitsuba_plenoptic.camera.documentation import with_sensor_parameters

    tree = ast.parse((PACKAGE / PLUGINS[name]).read_text())
    found = [ast.get_docstring(node) or "" for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    text = next(text for text in found if ".. pluginparameters::" in text)
    return with_sensor_parameters(text) if name == "plenoptic" else text


def plugin_parameters(docstring: str) -> list[list[str]]:
    """Return the cells of each row of a docstring's table of parameters: names, type, text, and flags if it has any."""
    rows: list[list[str]] = []
    for line in docstring.split(".. pluginparameters::")[1].splitlines()[1:]:
        if line.startswith(" * - "):
            rows.append([line[5:]])
        elif line.startswith("   - "):
            rows[-1].append(line[5:])
        elif line.startswith("     "):
            rows[-1][-1] += " " + line.strip()
        elif line.strip():
            break
    return rows


def plugins(text: str) -> str:
    """Write the page of the plugins below what it says itself."""
    parts = [text, ""]
    for name in PLUGINS:
        documentation = plugin_docstring(name)
        before, _, after = documentation.partition(".. pluginparameters::")
        rest = re.sub(r"\A(?:\s*\n| \*.*\n|   .*\n)*", "", after)
        title = f"The {_KINDS[name]} ``{name}``"
        parts += [title, "-" * len(title), "", before, *_table(plugin_parameters(documentation)), "", _tabs(rest), ""]
    return "\n".join(parts)


def _table(rows: list[list[str]]) -> Iterator[str]:
    yield from (".. list-table::", "   :header-rows: 1", "   :class: options", "   :widths: 22 13 65", "")
    yield from ("   * - parameter", "     - type", "     - meaning")
    for names, kind, text, *flags in rows:
        shown = names if names.startswith("(") else ", ".join(f"``{name}``" for name in names.split(", "))
        yield f"   * - {shown}"
        yield f"     - {_plain(kind)}"
        said = [f" *{_plain(flag, emphasis='').capitalize()}.*" for flag in flags]
        yield f"     - {_plain(text)}{''.join(said)}"


def _plain(text: str, emphasis: str = "*") -> str:
    """Replace the substitutions and roles of Mitsuba's manual."""
    text = re.sub(r":paramtype:`(\w+)`", r"``\1``", text)
    return re.sub(r"\|(\w+)\|", rf"{emphasis}\1{emphasis}", text)


def _tabs(text: str) -> str:
    """Turn the tabs of Mitsuba's manual into those of sphinx-design."""
    lines, inside = [], False
    for line in text.splitlines():
        if found := re.match(r"( +)\.\. code-tab:: (\w+)", line):
            label = {"xml": "XML", "python": "Python"}[found[2]]
            lines += [f"{found[1]}.. tab-item:: {label}", "", f"{found[1]}    .. code-block:: {found[2]}"]
            inside = True
        elif line.strip() == ".. tabs::":
            lines += [line.replace("tabs", "tab-set"), ""]
        else:
            inside = inside and (not line or line.startswith(" "))
            lines.append(f"    {line}" if inside and line else line)
    return "\n".join(lines)


def commands(text: str) -> str:
    """Write the page of the command, below what it says itself, from its Typer application."""
    from mitsuba_plenoptic.cli import COMMANDS, PROGRAM, command_group, load

    parts = [text, "", *_help(command_group().help), ".. list-table::", "   :class: options", "   :widths: 22 78", ""]
    for name in COMMANDS:
        first = inspect.cleandoc(load(name).help or "").partition("\n\n")[0].replace("\n", " ")
        parts += [f"   * - `{name}`_", f"     - {_options_as_code(first)}"]
    parts.append("")
    for name in COMMANDS:
        command = load(name)
        usage = [PROGRAM, name, "[OPTIONS]", *(value_name(p) for p in command.params if is_argument(p))]
        parts += [name, "-" * len(name), "", ".. code-block:: text", "", f"   {' '.join(usage)}", ""]
        parts += [*_help(command.help), *_parameters(command), ""]
    return "\n".join(parts)


def _help(text: str | None) -> Iterator[str]:
    """Turn a help text in Rich's markup, with indented lines of examples, into reStructuredText."""
    for block in re.split(r"\n\s*\n(?=\S)", inspect.cleandoc(text or "")):
        plain = re.sub(r"\[bold\](--[\w-]+)\[/bold\]", r"\1", block)
        plain = re.sub(r"\[/?bold\]", "**", plain)
        examples = [line.strip() for line in plain.splitlines() if line.startswith("  ") and line.strip()]
        words = " ".join(line for line in plain.splitlines() if line and not line.startswith("  "))
        if words:
            yield from (_options_as_code(words), "")
        if examples:
            yield from (".. code-block:: console", "", *(f"   $ {example}" for example in examples), "")


def is_argument(parameter: Any) -> bool:
    """Whether a parameter is an argument, which is written without a name."""
    return not parameter.opts[0].startswith("-")


def value_name(parameter: Any) -> str:
    """Return what stands for a parameter's value."""
    return parameter.metavar or "|".join(parameter.type_descriptor.choices or [parameter.name.upper()])


def written(parameter: Any) -> str:
    """Return how an argument or option is written."""
    if is_argument(parameter):
        return value_name(parameter)
    names = ", ".join([*parameter.opts, *parameter.secondary_opts])
    return names if parameter.is_flag else f"{names} {value_name(parameter)}"


def _parameters(command: Any) -> Iterator[str]:
    if not command.params:
        return
    yield from (
        ".. list-table::",
        "   :header-rows: 1",
        "   :class: options",
        "   :widths: 30 70",
        "",
        "   * - option",
        "     - meaning",
    )
    for parameter in command.params:
        default = f" Default: {_default(parameter)}." if _default(parameter) else ""
        needed = " Required." if parameter.required and not is_argument(parameter) else ""
        yield f"   * - ``{written(parameter)}``"
        yield f"     - {_escaped(parameter.help + default)}{needed}"


def _default(parameter: Any) -> str:
    shown = parameter.show_default
    if isinstance(shown, str):
        return shown
    if parameter.required or is_argument(parameter) or parameter.is_flag or parameter.default in (None, (), []):
        return ""
    return str(getattr(parameter.default, "value", parameter.default))


def _escaped(text: str) -> str:
    plain = re.sub(r"\[/?bold\]", "**", text).replace("\\", "\\\\").replace("`", "'").replace("|", "\\|")
    return _options_as_code(" ".join(plain.split()))


def _options_as_code(text: str) -> str:
    """Mark the options in a text as code, where no dash is made of their hyphens."""
    return re.sub(r"(?<!\w)(--[\w-]+)", r"``\1``", text)


def guards(text: str) -> str:
    """Fill in the table of the guards."""
    from mitsuba_plenoptic.optics import guards as module

    found = [value for value in vars(module).values() if isinstance(value, module.Guard)]
    rows = [
        f"| `{guard.name}` | what fraction {guard.fault} | {_bound(guard.warn)} | {_bound(guard.refuse)} |"
        for guard in found
    ]
    return text.replace("GUARDS", "\n".join(rows))


def support(text: str) -> str:
    """Fill in the table of support, one row for each entry."""
    from mitsuba_plenoptic.camera import PARAMETERS
    from mitsuba_plenoptic.camera.support import support_of

    rows = ["| parameter | use | |", "|---|---|---|"]
    for name in PARAMETERS:
        for entry in support_of(name):
            instead = f"; use {entry.instead}" if entry.instead else ""
            where = f" {entry.where.words}" if entry.where else ""
            uses = ", ".join(use.words for use in entry.uses)
            rows.append(f"| `{name}`{where} | {uses} | {entry.verdict}: {entry.words}{instead} |")
    return text.replace("SUPPORT", "\n".join(rows) + "\n")


def _bound(fraction: float) -> str:
    return "never" if fraction >= 1 else f"{100 * fraction:g} %"


PAGES: dict[str, tuple[Callable[[str], str], tuple[str, ...]]] = {
    "reference/plugins": (plugins, (*PLUGINS.values(), "camera/parameters.py")),
    "reference/models": (support, ("camera/support.py", "camera/entry.py")),
    "theory/guards": (guards, ("optics/guards.py",)),
    "reference/command": (commands, tuple(f"cli/{path.name}" for path in sorted((PACKAGE / "cli").glob("*.py")))),
}
"""Pages by name: what writes them, given their own text, and the files that they are made from."""


def _fill(app: Any, name: str, source: list[str]) -> None:
    if name in PAGES:
        write, files = PAGES[name]
        source[0] = write(source[0])
        for file in files:
            app.env.note_dependency(str(PACKAGE / file))


def setup(app: Any) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("source-read", _fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
