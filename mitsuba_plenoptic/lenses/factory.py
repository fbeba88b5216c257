"""The function that makes a camera's main lens, from plain parameters or from Dr.Jit arrays with gradients."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from ..camera import PlenopticCamera
from ..errors import InputError
from .base import MainLens


@dataclass(frozen=True)
class LensNumbers:
    """Parameters from which a main lens is built.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera, for all parameters without gradients.
    wavelength : float, optional
        Wavelength in nanometres. None selects the wavelength for which the main lens is specified.
    focal_length, aperture_radius, mla_distance : float or Dr.Jit array
        Values of the camera, possibly with gradients.
    wavefront : floats or Dr.Jit arrays
        Coefficients of the aberrations.
    model : {"ideal", "parabolic"}
        Refraction model of rays, see `PlenopticCamera`.
    """

    camera: PlenopticCamera
    wavelength: float | None
    focal_length: Any
    aperture_radius: Any
    mla_distance: Any
    wavefront: Any
    model: str


Builder = TypeVar("Builder", bound=Callable[[LensNumbers], Any])

BUILDERS: dict[type, Callable[[LensNumbers], MainLens]] = {}
"""Functions that make a main lens, by the type of the camera's `main_lens`."""


def builds(description: type) -> Callable[[Builder], Builder]:
    """Mark the function that builds main lenses from a `main_lens` of some type; `type(None)` selects the thin lens."""

    def mark(function: Builder) -> Builder:
        BUILDERS[description] = function
        return function

    return mark


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
