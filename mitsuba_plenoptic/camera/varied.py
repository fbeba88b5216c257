"""A camera with values varied in what states it: parameters, or the numbers of a data sheet."""

from collections.abc import Mapping
from typing import Any

from ..errors import refuse_if, relation
from .matched import FOLLOWING, MATCHED, missing_from
from .plenoptic_camera import PlenopticCamera

_EITHER = (
    ("focus_distance", "mla_distance"),
    ("pixels_per_lens", "mla_pitch"),
    ("lenses", "resolution"),
    ("lenses", "sensor_size"),
)
"""Numbers of which a camera states one: a varied one replaces the other."""


def varied_camera(stated: Mapping[str, Any], varied: Mapping[str, Any]) -> PlenopticCamera:
    """Return the camera of stated parameters, or arguments of `PlenopticCamera.matched`, with varied ones among them.

    A data sheet is matched again. What follows from it can not be stated with it, and is changed in the camera of the
    sheet. If only varied values are of a data sheet, it is that of the stated camera.
    """
    of_sheet = [name for name in MATCHED if name in varied]
    is_complete = not missing_from({**stated, **varied}) and not FOLLOWING.keys() & stated.keys()
    if any(name in stated for name in MATCHED) or (of_sheet and is_complete):
        following = {name: value for name, value in varied.items() if name in FOLLOWING and not of_sheet}
        others = {name: value for name, value in varied.items() if name not in following}
        camera = PlenopticCamera._from_names(_joined(stated, others))
        return camera.replace(**following) if following else camera
    return PlenopticCamera._from_names(_joined(_sheet_of(stated, of_sheet, varied) if of_sheet else stated, varied))


def _joined(stated: Mapping[str, Any], varied: Mapping[str, Any]) -> dict[str, Any]:
    """Return stated values with varied ones in place of those that they replace."""
    replaced = {partner for first, two in _EITHER for name, partner in ((first, two), (two, first)) if name in varied}
    size: Any = stated.get("resolution")
    if "crop_size" in stated and hasattr(size, "__len__") and tuple(stated["crop_size"]) == tuple(size):
        replaced.add("crop_size")
    return {name: value for name, value in stated.items() if name not in replaced} | dict(varied)


def _sheet_of(stated: Mapping[str, Any], of_sheet: list[str], varied: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data sheet of a camera stated by parameters; refuse one whose micro-images do not touch."""
    camera = PlenopticCamera._from_names(dict(stated))
    instead = f"; {relation(of_sheet[0])}"
    refuse_if(
        not camera.has_array, f"{of_sheet[0]}: the camera has no microlens array, and no such data sheet{instead}"
    )
    width = camera.micro_image_diameter
    pitch = camera.micro_image_pitch
    # Sensors have numbers of single precision.
    refuse_if(
        abs(width / pitch - 1) > 1e-3 or camera.is_cropped,
        f"{of_sheet[0]}: micro-images of {width:.4g} mm are {pitch:.4g} mm apart: {', '.join(MATCHED)} state whole "
        f"cameras whose micro-images touch{instead}",
    )
    left_out = {*FOLLOWING, "mla_pitch", "crop_offset", "crop_size"}
    sheet = {name: value for name, value in stated.items() if name not in left_out and value is not None}
    focus = {} if sheet.keys() & {"focus_distance", "mla_distance"} else {"mla_distance": camera.mla_distance}
    sheet |= focus | {
        "focal_length": camera.focal_length,
        "resolution": camera.resolution,
        "f_number": camera.f_number,
        "pixels_per_lens": pitch / camera.pixel_size,
        "pixel_size": camera.pixel_size,
    }
    if "sensor_size" in varied:
        # Of resolution, pixel and detector sizes one follows: the pixels remain, unless their count varies, too.
        sheet.pop("pixel_size" if "resolution" in varied else "resolution")
    return sheet
