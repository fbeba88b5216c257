"""Known cameras with on-chip lenses, as parameters of `PlenopticCamera`.

``full_frame_dual``
    Like a full-frame camera with dual pixels, the Canon EOS 5D Mark IV before a 50 mm f/1.8 lens. Published by Canon: a
    sensor of 36 x 24 mm with 6720 x 4480 lenses 5.36 um apart, two photodiodes below each.

``phone_quad``
    Like the main camera of a telephone with quad pixels, the iPhone 14 Pro. Published by Apple: 48 megapixels, which
    its raw files have as 8064 x 6048, of 1.22 um, in groups of four of 2.44 um, and f/1.78; its pictures state 6.86 mm.
    Ours: one lens on each group of four.

``phone_quad_bayer``
    Like the main camera of the OPPO Find X2 Pro with Sony's IMX689. Published by them: 48 megapixels of 1.12 um on a
    sensor of the type 1/1.43 inch, a quad Bayer mosaic, one lens on the four pixels of each filter ("2x2 OCL"), and an
    f/1.7 lens that corresponds to 25 mm. Ours: 8000 x 6000 pixels, whose diagonal is that of the type; 6.47 mm, from
    the diagonals. Expose captures with ``mosaic="QUAD_RGGB"``.

No maker publishes what lies between lenses and photodiodes. Our assumptions: a height of 8 um for the full frame and of
4.5 um for telephones in a medium of the index 1.5; focused lenses without gaps, two pixels apart and shifted by
`mla_cra` to the chief rays through the pupil's centre; no crosstalk. As in all such cameras, 2 x 2 square pixels lie
below each lens; `dual_pixel` adds those that form a larger photodiode. Main lenses are assumed thin, focused at 2 m or
at 1 m.
"""

import math
from typing import Any


def _on_chip(
    pixel: float,
    resolution: tuple[int, int],
    focal_length: float,
    f_number: float,
    focus_distance: float,
    height: float,
) -> dict[str, Any]:
    """Return the parameters of an on-chip-lens camera; `height` is the distance in the medium to the photodiodes."""
    mla_distance = 1 / (1 / focal_length - 1 / focus_distance)
    # Pairs of image height in mm, up to the corner, and chief-ray angle in degrees, for `mla_cra`. Image heights are
    # those of pixels; lenses stand nearer to the axis by the chief ray's path in the medium.
    corner = pixel / 2 * math.hypot(*resolution)
    table = []
    steps = 20
    for step in range(steps + 1):
        slope = corner / mla_distance * step / steps
        within = math.asin(math.sin(math.atan(slope)) / 1.5)
        table += [mla_distance * slope + height * math.tan(within), math.degrees(math.atan(slope))]
    return {
        "focal_length": focal_length,
        "aperture_radius": focal_length / f_number / 2,
        "focus_distance": focus_distance,
        "mla_focal_length": height,
        "mla_medium": 1.5,
        "mla_pitch": 2 * pixel,
        # The middle of each lens's pixels sees the middle of the pupil.
        "mla_cra": tuple(table),
        "detector_width": pixel * resolution[0],
        "resolution": resolution,
    }


CAMERAS = {
    "full_frame_dual": _on_chip(0.00268, (13440, 8960), 50.0, 1.8, 2000.0, 0.008),
    "phone_quad": _on_chip(0.00122, (8064, 6048), 6.86, 1.78, 1000.0, 0.0045),
    "phone_quad_bayer": _on_chip(0.00112, (8000, 6000), 6.47, 1.7, 1000.0, 0.0045),
}
