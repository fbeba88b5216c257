"""The function that makes a camera's main lens, from plain parameters or from Dr.Jit arrays with gradients."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..camera import PlenopticCamera
from ..errors import InputError
from . import real_lens, telecentric, thin  # noqa: F401 (each registers what it builds)
from .base import BUILDERS, LensNumbers


def main_lens(
    camera: PlenopticCamera,
    wavelength: float | None = None,
    *,
    varying: Mapping[str, Any] | None = None,
    model: str | None = None,
) -> Any:
    """Return a camera's main lens.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float, optional
        Wavelength in nanometres. Default: that for which the main lens is specified.
    varying : mapping, optional
        Values that replace the camera's, such as Dr.Jit arrays with gradients: ``focal_length``,
        ``aperture_radius``, ``mla_distance`` and ``wavefront``.
    model : {"ideal", "parabolic"}, optional
        Refraction model of rays. Default: the camera's `lens_model`.

    Raises
    ------
    InputError
        If no function is registered for a main lens of this type.
    """
    given = varying or {}
    names = "focal_length", "aperture_radius", "mla_distance", "wavefront"
    numbers = {name: given.get(name, getattr(camera, name)) for name in names}
    build = BUILDERS.get(type(camera.main_lens))
    if build is None:
        raise InputError(f"main_lens = {camera.main_lens!r}: no function is marked to build a lens of this kind")
    return build(LensNumbers(camera, wavelength, **numbers, model=model or camera.lens_model))
