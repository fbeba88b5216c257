"""``mitsuba-plenoptic run``: runs those steps of a run file that are not finished."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from ...cli import mistake, step_commands
from ...cli.inputs import parse_definitions, scene_roots
from ...cli.run_file import RunStep, parameters_of, read_run_file
from ...cli.stopping import resumable
from ...errors import InputError, refuse_if, short_repr

_log = logging.getLogger(__name__)


def run(
    file: Annotated[Path, typer.Argument(metavar="RUN.yaml", help="The run file, YAML or JSON.")],
) -> None:
    """Run several commands that a file lists, and again only those whose inputs have changed.

    A run file has a list of steps, each a command with its options by name, and options that several steps share.
    [bold]--save-run[/bold] of a command writes one. File names are relative to the folder of the run file.
    RUN.steps.json, next to it, notes the files that each step has read and written. A run that was stopped resumes
    where it was.

    [bold]Examples:[/bold]

      mitsuba-plenoptic render letters -o raw.exr --save-run run.yaml

      mitsuba-plenoptic depth raw.exr -o depth.pdf --save-run run.yaml

      mitsuba-plenoptic run run.yaml
    """
    from ...io.checkpoints import finished_step, lock_of, locked, note_step
    from ...io.versions import VERSION, is_of_1_0
    from ...runtime.files import files_used, read_yaml

    commands = step_commands()
    parameters = parameters_of(commands)
    steps = read_run_file(file, parameters)
    log = file.absolute().with_suffix(".steps.json")
    with contextlib.chdir(file.parent), contextlib.ExitStack() as alone, resumable():
        # All are parsed before the first is run, which may take long.
        contexts, by_waves = [], False
        for number, step in enumerate(steps, 1):
            with _naming_step(file, number, step, parameters[step.command]):
                words = step.command_line(parameters[step.command])
                contexts.append(commands[step.command].make_context(step.command, words))
                by_waves |= _is_by_waves(contexts[-1])
        _require_outputs_apart(file, steps)
        if by_waves and is_of_1_0(read_yaml(file.name)):
            _log.info(
                "%s: it states no version, as those of version 1.0 and earlier: waves refracted at a thin main lens as "
                "lens_model parabolic then, and follow the camera's lens_model now; the line version: %s ends this",
                file,
                VERSION,
            )
        is_locked = False
        for number, (step, context) in enumerate(zip(steps, contexts, strict=True), 1):
            label = f"step {number} of {len(steps)}, {step.command}"
            with _naming_step(file, number, step, parameters[step.command]):
                settings = _settings(step, parameters[step.command])
                entry = finished_step(log, settings)
            # A run with nothing to do needs no lock, and its folder may be one that it may not write.
            if entry is None and not is_locked:
                alone.enter_context(locked(lock_of(log), f"{file}: another process is running it"))
                is_locked, entry = True, finished_step(log, settings)
            if entry is not None:
                typer.echo(f"{label}: up to date")
                continue
            typer.echo(label)
            with _naming_step(file, number, step, parameters[step.command]):
                with context, files_used() as used:
                    commands[step.command].invoke(context)
                note_step(log, settings, used)


_LIGHT = {"render": "model", "sweep": "model", "fit": "model", "reconstruct": "method"}
"""Options that choose rays or waves, by the command."""


def _is_by_waves(context: Any) -> bool:
    """Return whether a parsed step computes by waves, or has a recipe that may."""
    name = context.info_name
    chosen = context.params[_LIGHT[name]] if name in _LIGHT else "wave" if name == "dataset" else "ray"
    if chosen is None:
        roots = scene_roots(context.params["scene"], parse_definitions(context.params["define"]))
        return any(each.get("type", "").startswith("plenoptic_") for root in roots for each in root.iter("integrator"))
    return chosen != "ray"


@contextlib.contextmanager
def _naming_step(file: Path, number: int, step: RunStep, parameters: Mapping[str, Any]) -> Iterator[None]:
    """Prefix a user's mistake with run file and step, and spell options as the file does, while the context is open."""
    try:
        yield
    except Exception as error:
        names = {option: name for name, one in parameters.items() for option in one.opts}
        message = mistake(error, names)
        if message is None:
            raise
        # Typer's message on a value does not show the value.
        of = names.get(next(iter(getattr(getattr(error, "param", None), "opts", ())), ""), "")
        if of in step.options:
            message = f"{of} = {short_repr(step.options[of])}: {getattr(error, 'message', message)}"
        raise InputError(f"{file}: step {number} ({step.command}): {message}") from error


def _require_outputs_apart(file: Path, steps: list[RunStep]) -> None:
    """Refuse two steps that write the same file, since each would undo the other."""
    found: dict[Path, int] = {}
    for number, step in enumerate(steps, 1):
        if "output" in step.options:
            first = found.setdefault(Path(str(step.options["output"])).absolute(), number)
            refuse_if(
                first != number,
                f"{file}: step {number} ({step.command}): output = {step.options['output']}: step {first} writes it, "
                "too; give each a name of its own",
            )


def _settings(step: RunStep, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a step, and hashes of its scenes and of the files that scenes name; no other inputs."""
    # Brings libraries that take a while to load.
    from ...report.stage_store import scene_fingerprint

    words = step.words(parameters)
    scenes = [word.removeprefix("--scene=") for word in words.get("scene", ())]
    definitions = parse_definitions([word.removeprefix("--define=") for word in words.get("define", ())])
    return {
        "command": step.command,
        "options": words,
        "scenes": [scene_fingerprint(scene, definitions) for scene in scenes],
    }
