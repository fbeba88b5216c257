"""Extension `paper`: the study of the paper, with its figures, times and conclusions computed again."""

from ...extension import Extension

EXTENSION = Extension(
    commands={
        "reproduce": ("reproduce_command", "Compute the paper's figures, timing and conclusions again."),
    }
)
