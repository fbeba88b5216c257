"""Extension `studio`: the viewer, previews, sweeps of parameters, and what notebooks show."""

from ...extension import Extension

EXTENSION = Extension(
    commands={"preview": "preview_command", "view": "view_command", "sweep": "sweep_command"},
    displays={
        "Capture": "thumbnails:show_capture",
        "PlenopticCamera": "thumbnails:show_camera",
        "Reconstruction": "thumbnails:show_reconstruction",
        "Reconstructions": "thumbnails:show_reconstructions",
    },
)
