"""Run files in YAML: the steps of a run, each a command with its options by name."""

from __future__ import annotations

import functools
import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import InputError, did_you_mean, naming, refuse_if, require_choice, require_known, short_repr
from ..refocus_options import with_parameters
from .inputs import EXPERT

_PLAIN = re.compile(r"[\w./+-]([\w ./=+-]*[\w./+-])?")
"""Words that YAML reads as they are, in lists, too."""


@dataclass(frozen=True)
class RunStep:
    """A command with its options and arguments by name, as one step of a run file."""

    command: str
    options: Mapping[str, Any]

    def words(self, parameters: Mapping[str, Any]) -> dict[str, list[str]]:
        """Return the command-line words of each option, given the command's parameters by name."""
        require_known("", self.options, tuple(parameters))
        return {name: _words_of(name, value, parameters[name]) for name, value in self.options.items()}

    def command_line(self, parameters: Mapping[str, Any]) -> list[str]:
        """Return the words of the command line, options first; no command has two arguments."""
        by_name = self.words(parameters)
        arguments = [word for name in by_name if _is_argument(parameters[name]) for word in by_name[name]]
        options = [word for name in by_name if not _is_argument(parameters[name]) for word in by_name[name]]
        return [*options, "--", *arguments]


def parameters_of(commands: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the arguments and options of each command by their names in a run file."""
    return {name: _by_name(command) for name, command in commands.items()}


def _by_name(command: Any) -> dict[str, Any]:
    # Commands are not given those that every command has, such as --quiet.
    shown = (one for one in command.params if one.expose_value and "--save-run" not in one.opts)
    return {max(one.opts, key=len).lstrip("-"): one for one in shown}


def _is_argument(parameter: Any) -> bool:
    return not parameter.opts[0].startswith("-")


def _words_of(name: str, value: Any, parameter: Any) -> list[str]:
    if _is_argument(parameter):
        return _words(name, value, many=parameter.nargs != 1)
    if not parameter.is_flag:
        return [f"--{name}={word}" for word in _words(name, value, many=parameter.multiple)]
    if not isinstance(value, bool):
        raise InputError(f"{name} = {short_repr(value)}: it must be true or false")
    return [parameter.opts[0]] if value else parameter.secondary_opts[:1]


def _words(name: str, value: Any, *, many: bool) -> list[str]:
    """Return the command-line words of an option's value; several values only where the option allows them."""
    if isinstance(value, list):
        words = [_word(name, one) for one in value]
        return words if many else [",".join(words)]
    if isinstance(value, dict) and many:
        return [f"{key}={','.join(_words(f'{name}: {key}', one, many=False))}" for key, one in value.items()]
    return [_word(name, value)]


def _word(name: str, value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, (str, int, float, Path)):
        shown = "null" if value is None else short_repr(value)
        raise InputError(f"{name} = {shown}: it must be a number or a text")
    return repr(value).removesuffix(".0") if isinstance(value, float) else str(value)


def read_run_file(path: Path, commands: Mapping[str, Any]) -> list[RunStep]:
    """Read the steps of a run file; `commands` has the parameters by name of each command."""
    from ..runtime.files import read_yaml

    content = read_yaml(path)
    with naming(path):
        return parse_run(content, commands)


def parse_run(content: Any, commands: Mapping[str, Any]) -> list[RunStep]:
    """Return the steps of a run file; the file's shared options are added to each command that has them."""
    from ..io.versions import KEY

    refuse_if(
        not isinstance(content, dict) or not isinstance(content.get("steps"), list) or not content["steps"],
        "a run file must have 'steps', a list of commands with their options",
    )
    require_known("", content, (KEY, "shared", "steps"))
    shared = content.get("shared") or {}
    refuse_if(not isinstance(shared, dict), f"shared = {short_repr(shared)}: it must be options by name")
    steps = []
    for number, entry in enumerate(content["steps"], 1):
        if not isinstance(entry, dict) or len(entry) != 1:
            raise InputError(f"step {number} = {short_repr(entry)}: it must be one command, with its options by name")
        ((command, options),) = entry.items()
        with naming(f"step {number}"):
            require_choice("command", command, commands)
        options = {} if options is None else options
        refuse_if(
            not isinstance(options, dict),
            f"step {number} ({command}) = {short_repr(options)}: it must be options by name",
        )
        known = commands[command]
        steps.append(RunStep(command, {name: value for name, value in shared.items() if name in known} | options))
    for name in shared:
        if not any(name in commands[step.command] for step in steps):
            names = {one for step in steps for one in commands[step.command]}
            raise InputError(f"shared: {name}: no step has such an option{did_you_mean(name, names)}")
    return steps


SaveRun = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.yaml",
        help="Also write a run file that repeats this command, or add the command to one.",
        rich_help_panel=EXPERT,
    ),
]


def recorded(function: Callable[..., None], commands: Callable[[], Mapping[str, Any]]) -> Callable[..., None]:
    """Return a command with the option ``--save-run``; `commands` returns all possible steps by name."""

    @functools.wraps(function)
    def command(*, save_run: Path | None, context: typer.Context, **options: Any) -> None:
        if save_run is not None:
            from ..runtime.files import require_writable

            require_writable(save_run, ".yaml", ".yml")
        function(**options)
        if save_run is not None:
            add_step(save_run, _step_of(context, save_run.parent), parameters_of(commands()))

    return with_parameters(command, {"save_run": SaveRun, "context": typer.Context})


def _step_of(context: Any, folder: Path) -> RunStep:
    """Return the running command as a step, with the options given to it and files relative to a folder."""
    options: dict[str, Any] = {}
    for name, parameter in _by_name(context.command).items():
        if context.get_parameter_source(parameter.name).name != "COMMANDLINE":
            continue
        value = context.params[parameter.name]
        if parameter.nargs != 1 or getattr(parameter, "multiple", False):
            options[name] = [_seen_from(folder, name, one) for one in value]
        else:
            options[name] = value if isinstance(value, bool) else _seen_from(folder, name, value)
    return RunStep(context.command.name, options)


_FILES_OR_NAMES = {"scene", "camera", "source"}
"""Options whose text is the path of a file or the name of something built in; other texts name no files."""


def _seen_from(folder: Path, name: str, value: Any) -> str:
    """Return an option's value as a word; relative paths are rewritten relative to the run file's folder."""
    word = _word("", value)
    named = isinstance(value, Path) or (name in _FILES_OR_NAMES and Path(word).is_file())
    return os.path.relpath(word, folder) if named and not Path(word).is_absolute() else word


def add_step(path: Path, step: RunStep, commands: Mapping[str, Any]) -> None:
    """Write a run file of one step, or append the step to an existing file that lacks it."""
    from ..io.versions import KEY, VERSION
    from ..runtime.files import parse_yaml, write_text

    # It is read as a run file first, which refuses what is none.
    steps = read_run_file(path, commands) if path.exists() else []
    before = path.read_text(encoding="utf-8") if path.exists() else f"{KEY}: {VERSION}\nsteps:\n"
    if _commands_of([step], commands)[0] in _commands_of(steps, commands):
        return
    text = f"{before.rstrip()}\n- {step.command}:\n"
    for name, value in step.options.items():
        text += f"    {name}: {_yaml(value)}\n"
    try:
        after = parse_run(parse_yaml(text), commands)
    except (InputError, ValueError):
        after = []
    refuse_if(
        _commands_of(after, commands) != _commands_of([*steps, step], commands),
        f"{path}: the step cannot be added at its end; 'steps' must be its last entry, a list with a line for each "
        "step, and 'shared' have no option that the step was not given",
    )
    write_text(path, text)


def _commands_of(steps: list[RunStep], commands: Mapping[str, Any]) -> list[tuple[str, dict[str, list[str]]]]:
    return [(step.command, step.words(commands[step.command])) for step in steps]


def _yaml(value: Any) -> str:
    """Write a word, a list of words or a flag as YAML, quoted only where plain text would be read back differently."""
    from ..runtime.files import parse_yaml

    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(_yaml(one) for one in value)}]"
    if _PLAIN.fullmatch(value):
        found = parse_yaml(value)
        if isinstance(found, (str, int, float)) and not isinstance(found, bool) and _word("", found) == value:
            return str(value)
    return json.dumps(value)
