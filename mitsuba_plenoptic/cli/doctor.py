"""``mitsuba-plenoptic doctor``: the state of the installation."""

import json

import typer

from .options import Json


def doctor(*, as_json: Json = False) -> None:
    """Check the installation: versions, LLVM, Mitsuba variants, threads and GPU.

    Each variant that may work renders a triangle in a process of its own, which takes some seconds. The exit status is
    0 if captures can be rendered here with the default variant, and 1 if not.
    """
    from ..report import inspect_installation

    installation = inspect_installation()
    if as_json:
        sections = {title: dict(lines) for title, lines in installation.sections.items()}
        facts = {"ready": installation.ready, "verdict": installation.verdict, "problem": installation.problem}
        typer.echo(json.dumps(facts | sections, indent=1))
        raise typer.Exit(0 if installation.ready else 1)
    for title, lines in installation.sections.items():
        typer.echo(f"\n{typer.style(title, bold=True)}")
        for name, value in lines:
            typer.echo(f"  {name:<26} {value}")
    typer.echo()
    if installation.problem:
        typer.echo(f"Problem: {installation.problem}.")
    typer.echo(f"{installation.verdict}.")
    if not installation.ready:
        raise typer.Exit(1)
