"""Extension `studio`: the viewer, previews, sweeps of parameters and run files."""

from ...extension import Extension

EXTENSION = Extension(
    names={"viewer": ("Viewer", "view")},
    commands={"preview": "preview_command", "view": "view_command", "sweep": "sweep_command", "run": "run_command"},
)
