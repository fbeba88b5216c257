"""The command ``mitsuba-plenoptic``: reads options, calls the library, prints.

Commands import the library in their bodies, so that help, completion and refused options need not wait for it.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import importlib.util
import logging
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import InputError, at_shell, did_you_mean, relation
from ..extension import entries, missing
from ..runtime.progress import INTERRUPTED, plain_lines

PROGRAM = "mitsuba-plenoptic"

_logger = logging.getLogger(__package__.partition(".")[0])

# In the order of the help: each command is a function of its name in this module, or a `Typer` of several commands.
COMMANDS = {
    name: f"{__package__}.{module}"
    for name, module in {
        "example": "example",
        "render": "render_command",
        **dict.fromkeys(("reconstruct", "sheet"), "reconstruct"),
        **dict.fromkeys(("views", "epi", "stack", "depth"), "light_field"),
        "expose": "render_command",
        "convert": "light_field",
        "compare": "compare",
        **dict.fromkeys(("info", "doctor"), "info"),
    }.items()
} | {name: f"{package}.{module}" for package, name, module in entries("commands")}

# Options that are not called as the arguments of the library that they are for.
_OPTIONS = {"views": "--view-count", "names": "--parameter", "parameters": "-D", "batch_map": "--workers"}


_STOPPED = 130
"""Exit status after Ctrl-C."""


class StoppedError(Exception):
    """Ends a command after Ctrl-C with a line that says how to go on."""


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"{PROGRAM} {version(PROGRAM)}")
        raise typer.Exit


def _root(
    context: typer.Context,
    show_version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """Simulate plenoptic (light-field) cameras in Mitsuba 3 and refocus what they record.

    A [bold]capture[/bold] is the image on the camera's detector, a field of
    micro-images; a [bold]reconstruction[/bold] is an image refocused from it.
    Lengths are scene units, taken as millimetres; wavelengths are nanometres.

    [bold]Start here:[/bold]

      mitsuba-plenoptic render letters -o raw.exr --spp 4

      mitsuba-plenoptic reconstruct raw.exr -o out.png --distance 240
    """
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def _command() -> typer.Typer:
    """Return the command without subcommands."""
    made = typer.Typer(
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    made.callback(invoke_without_command=True)(_root)
    return made


def command_line(names: Iterable[str] = COMMANDS) -> typer.Typer:
    """Return the command with the named subcommands only, since loading all of them would take a second."""
    from .judging import judging

    made = _command()
    for name in names:
        command = getattr(importlib.import_module(COMMANDS[name]), name)
        if isinstance(command, typer.Typer):
            made.add_typer(command, name=name)
        else:
            made.command(name)(judging(command))
    return made


def _outline() -> typer.Typer:
    """Return the command with all subcommands as help texts only, without importing their modules."""
    made = _command()
    for name, path in COMMANDS.items():
        spec = importlib.util.find_spec(path)
        module = ast.parse(Path(str(spec and spec.origin)).read_text(encoding="utf-8"))
        # A group of commands has no function of its name.
        own = (node for node in module.body if isinstance(node, ast.FunctionDef) and node.name == name)
        made.command(name, help=ast.get_docstring(next(own, module)))(lambda: None)
    return made


def _called(words: Sequence[str]) -> list[str]:
    """Return the subcommand named in the words of a command line, or of one being completed; else an empty list."""
    if "_MITSUBA_PLENOPTIC_COMPLETE" in os.environ:
        # The last word is being typed.
        words = os.environ.get("COMP_WORDS", os.environ.get("_TYPER_COMPLETE_ARGS", "")).split(" ")[1:-1]
    return [word for word in words[:1] if word in COMMANDS]


def commands_of(group: Any, *words: str) -> Iterator[tuple[str, Any]]:
    """Yield the commands of a Typer group with the words that call them, such as ``benchmark make``."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands_of(command, *words, name)
        else:
            yield " ".join((*words, name)), command


def command_group(names: Iterable[str] = COMMANDS) -> Any:
    """Return the Typer group of the named commands, each with the common options."""
    group: Any = typer.main.get_command(command_line(names))
    for_all = typer.Typer()
    for_all.command()(_for_all)
    for _, command in commands_of(group):
        command.params += [one for one in typer.main.get_command(for_all).params if "--help" not in one.opts]
    return group


def _for_all(
    quiet: Annotated[
        bool,
        typer.Option(
            "-q",
            "--quiet",
            help="Print results and errors alone: no progress, notes or warnings.",
            callback=lambda wanted: _be_quiet() if wanted else None,
            is_eager=True,
            expose_value=False,
            rich_help_panel="Every command",
        ),
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option(
            "-v",
            "--verbose",
            help="Print details, too: what is read, written and set, with times.",
            callback=lambda wanted: _logger.setLevel(logging.DEBUG) if wanted else None,
            is_eager=True,
            expose_value=False,
            rich_help_panel="Every command",
        ),
    ] = False,
) -> None:
    """Store the options that every command has."""


def _be_quiet() -> None:
    # Progress, too, is silent at this level.
    _logger.setLevel(logging.CRITICAL)
    warnings.showwarning = lambda *_, **__: None


def __getattr__(name: str) -> Any:
    if name == "app":
        return command_line()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status.

    A user's mistake gives one line on standard error and status 2; an exception that is a mistake of ours
    passes through with its traceback.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    # Figures are written to files: no display is needed, and a notebook's is not there.
    os.environ["MPLBACKEND"] = "agg"
    if words and (absent := missing("commands", words[0])):
        return _fail(absent)
    called = _called(words)
    group = command_group(called) if called else typer.main.get_command(_outline())
    if called:
        # Options before the command, of which none is given: Typer would import pydantic to judge them.
        group.params.clear()
        group.add_help_option = False
    with _remarks(), _interrupts():
        try:
            # Progress begins before the options are read, thus before --quiet is.
            silent = not called or not words or not {"-h", "--help", "-q", "--quiet"}.isdisjoint(words)
            # Not in standalone mode, where Typer would print usage mistakes as boxes of many lines.
            with at_shell(_OPTIONS), contextlib.ExitStack() as shown:
                if not silent:
                    shown.enter_context(plain_lines(words[0]))
                status = group.main(words, prog_name=PROGRAM, standalone_mode=False)
            # Typer makes a status of Ctrl-C.
            if status == _STOPPED:
                raise KeyboardInterrupt
            return status if isinstance(status, int) else 0
        except (KeyboardInterrupt, typer.Abort, StoppedError) as stopped:
            _complain(str(stopped) or "stopped: nothing is kept; the same command begins anew")
            return _STOPPED
        except Exception as error:
            known = dict(commands_of(group)) if called and words else {}
            command = known.get(words[0]) or known.get(" ".join(words[:2])) if known else None
            own = command.params if command else ()
            message = mistake(error, {option: option for one in own for option in one.opts})
            if message is None:
                raise
            context = getattr(error, "ctx", None)
            usage = f" (see {context.command_path if context else PROGRAM} --help)" if _is_usage(error) else ""
            return _fail(message + usage)


def mistake(error: Exception, options: Mapping[str, str]) -> str | None:
    """Return the line that describes a user's mistake; None for other exceptions, which are faults of the program.

    Arguments named in the message are spelled as options of the command, by the mapping `options`.
    """
    if isinstance(error, InputError):
        return _with_options(str(error), options)
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)
    if not _is_usage(error):
        return None
    unknown = getattr(error, "option_name", "")
    if gone := missing("commands", unknown):
        return gone
    if hasattr(error, "possibilities"):
        rule = relation(unknown.strip("-").replace("-", "_"))
        return f"no such option: {unknown}" + (f"; {rule}" if rule else did_you_mean(unknown, options))
    return str(error.format_message()).rstrip(".")  # type: ignore[attr-defined]


def _is_usage(error: Exception) -> bool:
    """Return whether an error is one of Typer's usage errors, whose class has no public name in all versions."""
    return hasattr(error, "format_message")


@contextlib.contextmanager
def _interrupts() -> Iterator[None]:
    """Note Ctrl-C for bars of progress, which end the command where a library has dropped the KeyboardInterrupt."""
    INTERRUPTED.clear()

    def stop(signal_number: int, frame: object) -> None:
        INTERRUPTED.set()
        raise KeyboardInterrupt

    # Other handlers, and threads that receive no signals, keep what they have.
    ours = threading.current_thread() is threading.main_thread() and (
        signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    if ours:
        signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        INTERRUPTED.clear()


@contextlib.contextmanager
def _remarks() -> Iterator[None]:
    """Print the library's warnings and remarks, such as the time of a long rendering, on standard error."""

    def emit(record: logging.LogRecord) -> None:
        detail = f"{record.relativeCreated / 1000:.2f} s: " if record.levelno < logging.INFO else ""
        _complain(f"{detail}{record.getMessage()}")

    handler, level = logging.Handler(), _logger.level
    handler.emit = emit  # type: ignore[method-assign]
    _logger.addHandler(handler)
    _logger.setLevel(logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: _complain(f"warning: {message}")
            yield
    finally:
        _logger.setLevel(level)
        _logger.removeHandler(handler)


def _with_options(message: str, options: Mapping[str, str]) -> str:
    """Return a message in which arguments, ``name = value: ...``, are spelt as options of the command."""

    def spelled(found: re.Match[str]) -> str:
        option = options.get(_OPTIONS.get(found[1], f"--{found[1].replace('_', '-')}"))
        if option is None:
            return found[0]
        # At a shell flags and what is not given have no value.
        return option if found[2] else f"{option} = "

    about, colon, rule = message.partition(": ")
    return re.sub(r"\b(?<!-)([a-z]\w*) = (None\b|True\b)?", spelled, about) + colon + rule


def _fail(message: str) -> int:
    _complain(f"error: {message}")
    return 2


def _complain(message: str) -> None:
    # In one piece, so that neither Ctrl-C nor a line of progress comes between the text and the end of its line.
    print(f"{PROGRAM}: {' '.join(message.split())}\n", end="", file=sys.stderr)
