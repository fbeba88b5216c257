"""Which cameras waves can be followed through, and by which methods: others are refused by name."""

from __future__ import annotations

from ..camera import PlenopticCamera
from ..camera.checks import require_known_to
from ..camera.entry import Captures
from ..errors import InputError


def require_ideal(camera: PlenopticCamera) -> None:
    """Refuse, for waves of points, a camera with what they know nothing of, such as a tilted or irregular array."""
    require_known_to(camera, Captures.POINTS, "waves of points are followed", "use ray captures, or ")


def require_no_glass(camera: PlenopticCamera, what: str) -> None:
    """Refuse, for work that knows no dispersion, a camera whose thin lenses are of glass."""
    for name in ("glass", "mla_glass"):
        glass = getattr(camera, name)
        if glass is not None:
            raise InputError(f"{name} = {glass.name or glass.form}: {what} leave it out")
