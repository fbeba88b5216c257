"""Which cameras waves can be followed through, and by which methods: others are refused by name."""

from __future__ import annotations

from ..camera import PlenopticCamera
from ..errors import InputError


def require_ideal(camera: PlenopticCamera) -> None:
    """Refuse, for work by waves, a camera with a tilted array or a thin main lens that distorts.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        Naming the parameter.
    """
    require_regular(camera)
    for name in ("mla_tilt", "distortion"):
        if any(getattr(camera, name)):
            raise InputError(f"{name} = {getattr(camera, name)}: waves need 0; work by rays, or set it to 0")


def require_regular(camera: PlenopticCamera) -> None:
    """Refuse, for work by waves, an irregular array and pixels that answer to angles differently.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        Naming the parameter.
    """
    for name in ("mla_jitter", "pixel_response"):
        if any(getattr(camera, name)):
            raise InputError(f"{name} = {getattr(camera, name)}: it is for rays; work by rays, or leave it out")


def require_no_glass(camera: PlenopticCamera, what: str) -> None:
    """Refuse, for work that knows no dispersion, a camera whose thin lenses are of glass.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    what : str
        The rule, before "leave it out".

    Raises
    ------
    InputError
        Naming the glass.
    """
    for name in ("glass", "mla_glass"):
        glass = getattr(camera, name)
        if glass is not None:
            raise InputError(f"{name} = {glass.name or glass.form}: {what} leave it out")
