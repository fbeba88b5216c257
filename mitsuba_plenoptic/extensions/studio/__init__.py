"""Extension `studio`: the viewer, previews, sweeps of parameters, and what notebooks show."""

from ...extension import Extension

EXTENSION = Extension(
    commands={
        "preview": ("preview_command", "See in seconds what a camera will see of a scene, before it is captured."),
        "view": ("view_command", "Make a page to look at a capture: viewpoint, focus, micro-images."),
        "sweep": ("sweep_command", "Render a scene over a grid of cameras and wavelengths, refocus to distances."),
    },
    displays={
        "Capture": "thumbnails:show_capture",
        "PlenopticCamera": "thumbnails:show_camera",
        "Reconstruction": "thumbnails:show_reconstruction",
        "Reconstructions": "thumbnails:show_reconstructions",
    },
)
