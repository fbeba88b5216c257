"""The entry of `photodiode_response` in the table of a camera's parameters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...camera import Form, Parameter, Use, approximate, refused
from ...errors import refuse_if
from .photodiode_response import PhotodiodeResponse, known_response, require_pixel_pairs

if TYPE_CHECKING:
    from ...camera import CameraGeometry

PhotodiodeParameter = Parameter[PhotodiodeResponse | str | Path | dict[str, Any] | None, PhotodiodeResponse | None]

_WAVES = (
    Use.SCENES
    | Use.SCENE_POINTS
    | Use.SMALL_LENSES
    | Use.POINTS
    | Use.FULL_FIELDS
    | Use.POINT_FIELDS
    | Use.COHERENT_POINTS
    | Use.POINT_RAYS
    | Use.RAY_SPREADS
    | Use.SCENE_DERIVATIVES
    | Use.POINT_DERIVATIVES
)


def require_fit(camera: CameraGeometry) -> None:
    """Refuse a camera whose lenses do not cover 2 x 2 pixels, or whose medium the response already contains."""
    require_pixel_pairs(camera)
    refuse_if(
        camera.mla_absorption > 0,
        f"mla_absorption = {camera.mla_absorption:g}: photodiode_response contains the medium; leave one out",
    )


PHOTODIODE_RESPONSE: PhotodiodeParameter = Parameter(
    default=None,
    check=known_response,
    fit=require_fit,
    words=(
        "Response of the photodiodes under lenses of 2 x 2 pixels by the direction of light before the lens, from "
        "measurements or electromagnetic simulations: a JSON file, its text or in Python its dictionary, see "
        "`PhotodiodeResponse`. It takes the place of the microlenses' refraction: `mla_focal_length` and "
        "`detector_distance` only set the unit, so that 1 within the square of the pupil that a pixel sees through "
        "an ideal lens gives the ideal capture."
    ),
    form=Form.RESPONSE,
    otherwise="that of the microlenses",
    support=(
        refused(_WAVES, "the table contains the diffraction of microlenses", "ray captures"),
        refused(Use.RESPONSES | Use.FIELDS, "light goes back through microlenses that refract", "method ray"),
        approximate(
            Use.RAY_REFOCUSING | Use.DECODING | Use.WHITE_IMAGES,
            "pixels count as equal behind microlenses that refract",
        ),
    ),
    of_array=True,
)
