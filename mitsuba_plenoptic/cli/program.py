"""The command ``mitsuba-plenoptic``: reads options, calls the library, prints.

Commands import the library in their bodies, so that help, completion and refused options need not wait for it.
"""

import contextlib
import functools
import importlib
import inspect
import logging
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from ..errors import InputError, at_shell, did_you_mean, relation, require_choice, short_repr
from ..extension import entries, missing
from ..runtime import INTERRUPTED, plain_lines
from .signatures import documented, help_text, summary

PROGRAM = "mitsuba-plenoptic"

_logger = logging.getLogger(__package__.partition(".")[0])

_COMMANDS_OF_CORE = {
    "example": "example",
    "render": "render_command",
    "reconstruct": "reconstruct",
    "sheet": "reconstruct",
    "views": "light_field",
    "epi": "light_field",
    "stack": "light_field",
    "depth": "light_field",
    "expose": "render_command",
    "convert": "light_field",
    "compare": "compare",
    "info camera": "info",
    "info lens": "info",
    "doctor": "doctor",
}

COMMANDS = {name: f"{__package__}.{module}" for name, module in _COMMANDS_OF_CORE.items()} | {
    name: f"{package}.{module}" for package, name, module in entries("commands")
}
"""In the order of the help: the module of each command, which has a function of the last word of its name."""

# Options that are not called as the arguments of the library that they are for.
_OPTIONS = {"views": "--view-count", "names": "--parameter", "parameters": "-D", "batch_map": "--workers"}


STOPS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that end a command in order: Ctrl-C, and those of batch systems and of a terminal that closes."""

received: list[int] = []
checkpoints: list[Path] = []
stoppable: list = []
"""Signals that the running command has received, files from which the same command goes on, where they exist, and the
checkpoints that a run writes before it ends."""


_HELP = {"help_option_names": ["-h", "--help"]}


class StoppedError(Exception):
    """Ends a command after a signal with a line that says how to go on."""


class _Commands(TyperGroup):
    """Commands by the first sentences of their help; only the module of the one that is called is imported."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands, which then have their sentences."""
        for name, command in self.commands.items():
            command.help = command.help or summary(COMMANDS[self._full_name(name)], name)
        return super().list_commands(ctx)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the name, the command and the words that follow."""
        name, command, following = super().resolve_command(ctx, args)
        full_name = self._full_name(str(name))
        return name, load(full_name) if command and full_name in COMMANDS else command, following

    def _full_name(self, name: str) -> str:
        return name if name in COMMANDS else f"{self.name} {name}"


def command_group() -> Any:
    """Return the command with its subcommands, none of which is imported."""
    application = typer.Typer(
        cls=_Commands, rich_markup_mode="rich", pretty_exceptions_enable=False, context_settings=_HELP
    )
    application.callback(invoke_without_command=True)(_root)
    root: Any = typer.main.get_command(application)
    for words, module in COMMANDS.items():
        *group, name = words.split()
        commands = root.commands
        for title in group:
            subgroup = _Commands(name=title, help=help_text(module), rich_markup_mode="rich", context_settings=_HELP)
            commands = commands.setdefault(title, subgroup).commands
        commands[name] = TyperCommand(name)
    return root


@functools.cache
def load(name: str) -> Any:
    """Return a command with the options that every command has."""
    from ..refocus_options import with_parameters

    module = COMMANDS[name]
    command = getattr(importlib.import_module(module), name.split()[-1])
    options = documented(command, module)

    @functools.wraps(command)
    def called(quiet: bool, verbose: bool, **values: Any) -> None:
        taken_by = {name: {option: values[option] for option in group} for name, group in options.items()}
        command(**{name: group.get(name, group) for name, group in taken_by.items()})

    parameters = [parameter for group in options.values() for parameter in group.values()]
    called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    alone = typer.Typer(rich_markup_mode="rich", add_completion=False)
    alone.command(name, help=help_text(module, command.__name__), context_settings=_HELP)(
        with_parameters(called, _FOR_ALL)
    )
    return typer.main.get_command(alone)


def _print_version(flag: bool) -> None:
    if flag:
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


def _be_quiet(flag: bool) -> None:
    if flag:
        # Progress, too, is silent at this level.
        _logger.setLevel(logging.CRITICAL)
        warnings.showwarning = lambda *_, **__: None


def _be_verbose(flag: bool) -> None:
    if flag:
        _logger.setLevel(logging.DEBUG)


_FOR_ALL: dict[str, Any] = {
    name: Annotated[
        bool,
        typer.Option(
            f"-{name[0]}", f"--{name}", help=text, callback=callback, is_eager=True, rich_help_panel="Every command"
        ),
    ]
    for name, text, callback in (
        ("quiet", "Print results and errors alone: no progress, notes or warnings.", _be_quiet),
        ("verbose", "Print details, too: what is read, written and set, with times.", _be_verbose),
    )
}


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
    if words[:1] == ["info"] and {"camera", "lens", "-h", "--help"}.isdisjoint(words[1:2]):
        from .info import kind_of

        words.insert(1, kind_of(words[1:]))
    called = next((name for name in (" ".join(words[:2]), *words[:1]) if name in COMMANDS), None)
    if called:
        from ..runtime import claiming
    with _remarks(), _interrupts(), claiming() if called else contextlib.nullcontext():
        try:
            # Progress begins before the options are read, thus before --quiet is.
            has_progress = called is not None and {"-h", "--help", "-q", "--quiet"}.isdisjoint(words)
            # Not in standalone mode, where Typer would print usage mistakes as boxes of many lines.
            with at_shell(_OPTIONS), plain_lines() if has_progress else contextlib.nullcontext():
                if called:
                    following = words[len(called.split()) :]
                    status = load(called).main(following, prog_name=f"{PROGRAM} {called}", standalone_mode=False)
                else:
                    status = command_group().main(words, prog_name=PROGRAM, standalone_mode=False)
            # Typer makes a status of Ctrl-C.
            if status == 128 + signal.SIGINT:
                raise KeyboardInterrupt
            # A full disk shows here, instead of after the end.
            sys.stdout.flush()
            return status if isinstance(status, int) else 0
        except (Exception, KeyboardInterrupt) as error:
            # Libraries make errors of what stops them.
            if received or isinstance(error, (KeyboardInterrupt, typer.Abort, StoppedError)):
                goes_on = any(path.exists() for path in checkpoints)
                anew = "the same command goes on from there" if goes_on else "nothing unfinished is kept"
                _complain(str(error) if isinstance(error, StoppedError) else f"stopped: {anew}")
                return 128 + (received or [signal.SIGINT])[-1]
            command = load(called) if called else command_group()
            message = _mistake(error, {option for parameter in command.params for option in parameter.opts})
            if message is None:
                raise
            return _fail(message)


def _mistake(error: BaseException, options: Collection[str]) -> str | None:
    """Return the line that describes a user's mistake; None for other exceptions, which are faults of the program.

    Arguments named in the message are spelled as options of the command.
    """
    if isinstance(error, OSError):
        return f"{error.filename or 'standard output'}: {error.strerror}" if error.strerror else str(error)
    # The class of usage errors of Typer has no public name in all versions.
    if hasattr(error, "format_message"):
        unknown = getattr(error, "option_name", "")
        message = str(error.format_message()).rstrip(".")
        name = unknown.strip("-").replace("-", "_")
        if hasattr(error, "possibilities"):
            rule = relation(name)
            message = f"no such option: {unknown}" + (f"; {rule}" if rule else did_you_mean(unknown, options))
        elif chosen := re.search(r"(?s)'(.*)' is not one of (.*)", getattr(error, "message", "")):
            name = max(error.param.opts, key=len).strip("-").replace("-", "_")  # type: ignore[attr-defined]
            try:
                require_choice(name, chosen[1], re.findall(r"'(.*?)'", chosen[2]))
            except InputError as refused:
                return _with_options(str(refused), options)
        elif faults := getattr(error.__cause__, "errors", None):
            # The cause is pydantic's, whose sentence leaves out the value.
            wrong = faults()[0]
            kind = {"int": "a whole number", "float": "a number"}.get(wrong["type"].partition("_")[0])
            rule = f"it must be {kind}" if kind else wrong["msg"]
            message = f"{max(error.param.opts, key=len)} = {short_repr(wrong['input'])}: {rule}"  # type: ignore[attr-defined]
            unit = error.param.metavar  # type: ignore[attr-defined]
            message += f" of {unit.lower()}, without the unit" if unit in ("MM", "NM", "PIXELS") else ""
        context = getattr(error, "ctx", None)
        return f"{message} (see {context.command_path if context else PROGRAM} --help)"
    return _with_options(str(error), options) if isinstance(error, InputError) else None


@contextlib.contextmanager
def _interrupts() -> Iterator[None]:
    """Note signals that end a command for bars of progress, since some libraries drop the KeyboardInterrupt."""
    INTERRUPTED.clear()
    received.clear()
    checkpoints.clear()

    def stop(signal_number: int, frame: object) -> None:
        received.append(signal_number)
        if len(received) == 1 and any(checkpoint.stop() for checkpoint in stoppable):
            _logger.info("stopping after the current batch; Ctrl-C again stops at once")
            return
        INTERRUPTED.set()
        raise KeyboardInterrupt

    # Other handlers, and threads that receive no signals, keep what they have.
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {signum: signal.getsignal(signum) for signum in STOPS}
    ours = [signum for signum, handler in before.items() if handler in (signal.default_int_handler, signal.SIG_DFL)]
    for signum in ours:
        signal.signal(signum, stop)
    try:
        yield
    finally:
        for signum in ours:
            signal.signal(signum, before[signum])
        INTERRUPTED.clear()


@contextlib.contextmanager
def _remarks() -> Iterator[None]:
    """Print the library's warnings and remarks, such as the time of a long rendering, on standard error."""

    def emit(record: logging.LogRecord) -> None:
        detail = f"{record.relativeCreated / 1000:.2f} s: " if record.levelno < logging.INFO else ""
        _complain(f"{detail}{record.getMessage()}")

    handler = logging.Handler()
    level = _logger.level
    handler.emit = emit  # type: ignore[method-assign]
    _logger.addHandler(handler)
    # What libraries log of files stands in our line, too.
    silent = logging.NullHandler()
    logging.getLogger().addHandler(silent)
    _logger.setLevel(logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: _complain(f"warning: {message}")
            yield
    finally:
        _logger.setLevel(level)
        _logger.removeHandler(handler)
        logging.getLogger().removeHandler(silent)


def _with_options(message: str, options: Collection[str]) -> str:
    """Return a message in which arguments, ``name = value: ...``, are spelt as options of the command."""

    def spelled(argument: re.Match[str]) -> str:
        option = _OPTIONS.get(argument[1], f"--{argument[1].replace('_', '-')}")
        if option not in options:
            return argument[0]
        # At a shell flags and what is not given have no value.
        return option if argument[2] else f"{option} = "

    about, colon, rule = message.partition(": ")
    return re.sub(r"\b(?<!-)([a-z]\w*) = (None\b|True\b)?", spelled, about) + colon + rule


def _fail(message: str) -> int:
    _complain(f"error: {message}")
    return 2


def _complain(message: str) -> None:
    # In one piece, so that neither Ctrl-C nor a line of progress comes between the text and the end of its line.
    # Nobody may read it any more.
    with contextlib.suppress(OSError):
        print(f"{PROGRAM}: {' '.join(message.split())}\n", end="", file=sys.stderr)
