"""Options of commands, from signatures and docstrings in NumPy style: those of commands, and of the library.

Docstrings, and the library's signatures, are read in the text of their modules, which are not imported, so that help
need not wait for the library. Python may keep no docstrings (-OO).
"""

import ast
import functools
import inspect
import pkgutil
import re
from collections.abc import Callable
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer
from typer.models import OptionInfo

_TYPES = {"bool": bool, "complex": float, "float": float, "int": int, "str": str}

_UNITS = {
    "millimetres": "MM",
    "mm": "MM",
    "nanometres": "NM",
    "micrometres": "UM",
    "seconds": "SECONDS",
    "degrees": "DEG",
}

_REQUIRED = inspect.Parameter.empty


@functools.cache
def _syntax(module: str) -> ast.Module:
    package, _, name = module.partition(".")
    return ast.parse(pkgutil.get_data(package, f"{name.replace('.', '/')}.py") or b"")


def _definition(module: str, name: str) -> Any:
    return next(node for node in _syntax(module).body if getattr(node, "name", "") == name)


def _docstring(module: str, name: str) -> str:
    """Return the docstring of a function or class, or of the module if the name is empty."""
    return ast.get_docstring(_definition(module, name) if name else _syntax(module)) or ""


def _texts(docstring: str) -> dict[str, tuple[str, str]]:
    """Return type and text of each parameter in a docstring."""
    section = re.search(r"(?:Parameters|Attributes)\n-+\n(.*?)(?:\n\n\w|\Z)", docstring, re.DOTALL)
    entries = re.findall(r"^(\w[\w, ]*)(?: : (.*))?\n((?:    .*\n?)+)", section[1] if section else "", re.MULTILINE)
    return {name: (kind, " ".join(text.split())) for names, kind, text in entries for name in names.split(", ")}


def help_text(module: str, name: str = "") -> str:
    """Return the help of a command, or of a group that a module is: its docstring in Rich's markup."""
    text, *sections = re.split(r"^(\w+)\n-+\n", _docstring(module, name), flags=re.MULTILINE)
    examples = dict(zip(sections[::2], sections[1::2], strict=True)).get("Examples", "")
    lines = re.findall(r"^\$ (.*(?:\n  .*)*)", examples, flags=re.MULTILINE)
    title = [f"[bold]Example{'s' * (len(lines) > 1)}:[/bold]"] if lines else []
    # Terminals are narrower than files.
    text = re.sub(r"(?<=\S)\n(?=[^\s-])", " ", text.strip())
    return "\n\n".join([text, *title, *(f"  {line}" for line in lines)])


def summary(module: str, name: str = "") -> str:
    """Return the first sentence of a command's help, or of a group's."""
    return help_text(module, name).partition("\n\n")[0]


def options_of(place: str, *names: str) -> dict[str, inspect.Parameter]:
    """Return an option for each parameter of a function or class of the package, or for those of some names.

    Type and default are those of the signature; the help is the first sentence of the docstring's text, which also says
    what to choose from, the unit, and the default in words.
    """
    module, _, name = place.partition(":")
    module = f"{__package__.partition('.')[0]}.{module}"
    texts = _texts(_docstring(module, name))
    options = {}
    for parameter, annotation, value in _signature(_definition(module, name)):
        if names and parameter not in names:
            continue
        kind, text = texts[parameter]
        typed: Any = _TYPES[re.split(r"\W", annotation)[0]]
        if choices := re.match(r"\{(.*)\}", kind):
            typed = Literal[ast.literal_eval(f"{choices[1]},")]
        text = re.sub(r":math:`[^`]*` |[`*]+", "", text)
        sentence, *_ = re.split(r"(?<=\.) (?=[A-Z])", text)
        otherwise = re.search(r" Default: .*?\.(?= |$)", text)
        default = _REQUIRED if value is None else ast.literal_eval(value)
        options[parameter] = _option(parameter, typed, default, "", sentence + (otherwise[0] if otherwise else ""), {})
    return options


def _signature(node: Any) -> list[tuple[str, str, ast.expr | None]]:
    """Return name, annotation and default of the parameters of a function, a dataclass, or a class's constructor."""
    if isinstance(node, ast.ClassDef):
        constructors = [item for item in node.body if getattr(item, "name", "") == "__init__"]
        if not constructors:
            fields = [item for item in node.body if isinstance(item, ast.AnnAssign)]
            return [(ast.unparse(item.target), ast.unparse(item.annotation), item.value) for item in fields]
        node = constructors[0]
    arguments = [item for item in (*node.args.args, *node.args.kwonlyargs) if item.annotation]
    defaults = [*node.args.defaults, *node.args.kw_defaults]
    values = [None] * (len(arguments) - len(defaults)) + defaults
    return [(item.arg, ast.unparse(item.annotation), value) for item, value in zip(arguments, values, strict=True)]


def documented(function: Callable, module: str) -> dict[str, dict[str, inspect.Parameter]]:
    """Return the options of a command, and its arguments, which may stand without a name, by parameters that take them.

    The docstring, or else that of the module or of `options`, states what stands for a value, in place of a type, and
    the text, whose last sentence may be the default in words. `Annotated` may add a callback, the panel of the help, or
    options by name, of which the parameter takes a dictionary; options of Typer stay.
    """
    texts: dict[str, tuple[str, str]] = {}
    for source in ((f"{__package__}.options", ""), (module, ""), (module, function.__name__)):
        texts |= _texts(_docstring(*source))

    def described(name: str, kind: Any, default: Any, make: Any) -> inspect.Parameter:
        typed, added = _taken_apart(kind)
        if any(isinstance(item, OptionInfo) for item in added):
            optional: Any = typed | None if default is None else typed
            annotation = Annotated[optional, added[-1]]
            return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
        keywords = {"rich_help_panel" if isinstance(item, str) else "callback": item for item in added}
        metavar, text = texts.get(name, ("", ""))
        return _option(name, typed, default, metavar, text, keywords, make)

    options = {}
    for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
        *_, last = _taken_apart(parameter.annotation)[1] or [None]
        if isinstance(last, dict):
            options[name] = {
                option: kind
                if isinstance(kind, inspect.Parameter)
                else described(option, kind, False if kind is bool else None, typer.Option)
                for option, kind in last.items()
            }
        else:
            make = typer.Option if parameter.kind is inspect.Parameter.KEYWORD_ONLY else typer.Argument
            options[name] = {name: described(name, parameter.annotation, parameter.default, make)}
    return options


def _taken_apart(annotation: Any) -> tuple[Any, list]:
    """Return a type that may be None without that, and what `Annotated` adds to it or to the items of a list."""
    inner = [item for item in get_args(annotation) if item is not type(None)]
    origin = get_origin(annotation)
    if origin not in (Annotated, Union, UnionType, list):
        return annotation, []
    typed, added = _taken_apart(inner[0])
    if origin is Annotated:
        added = [*added, *inner[1:]]
    return list.__class_getitem__(typed) if origin is list else typed, added


def _option(
    name: str, typed: Any, default: Any, metavar: str, text: str, keywords: dict[str, Any], make: Any = typer.Option
) -> inspect.Parameter:
    """Return an option, or an argument, from what is known of it; the last sentence of its text may be its default."""
    sentences, _, otherwise = text.rstrip(".").partition(". Default: ")
    unit = re.search(rf"\b({'|'.join(_UNITS)})\b", sentences, re.IGNORECASE)
    if not metavar and {int, float} & {typed, *get_args(typed)}:
        metavar = _UNITS[unit[1].lower()] if unit else "N"
    if otherwise and default not in (None, _REQUIRED):
        otherwise = f"{default}, {otherwise}"
    stated = {"metavar": metavar or None, "show_default": otherwise or True, "help": sentences and f"{sentences}."}
    names = ["-o", "--output"] if name == "output" else [f"--{name.replace('_', '-')}"] if typed is bool else []
    accepted: Any = typed | None if default is None else typed
    annotation = Annotated[accepted, make(*names, **stated | keywords)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
