"""Checks that the wave model supports a camera, with errors that name the unsupported parameter."""

from __future__ import annotations

from ..camera import PlenopticCamera
from ..camera.checks import require_known_to
from ..camera.entry import Captures
from ..errors import InputError


def require_ideal(camera: PlenopticCamera) -> None:
    """Refuse a camera with features that the wave model of points does not support, such as an irregular array."""
    require_known_to(camera, Captures.POINTS, "waves of points are followed", "use ray captures, or ")


def require_no_glass(camera: PlenopticCamera, what: str) -> None:
    """Refuse a camera whose thin lenses are of dispersive glass, for computations without dispersion."""
    for name in ("glass", "mla_glass"):
        glass = getattr(camera, name)
        if glass is not None:
            raise InputError(f"{name} = {glass.name or glass.form}: {what} leave it out")
