"""``mitsuba-plenoptic doctor``: what this machine has, and whether it suffices."""

from __future__ import annotations

import typer

from ..report.installation import inspect_installation


def doctor() -> None:
    """Check the installation: versions, LLVM, Mitsuba variants, threads and GPU.

    The exit status is 0 if captures can be rendered here and 1 if not.
    """
    found = inspect_installation()
    for title, lines in found.sections.items():
        typer.echo(f"\n{typer.style(title, bold=True)}")
        for name, value in lines:
            typer.echo(f"  {name:<26} {value}")
    typer.echo()
    if found.problem:
        typer.echo(f"Problem: {found.problem}.")
    if not found.ready:
        raise typer.Exit(1)
    typer.echo("Ready to render.")
