"""Quantities that follow from a camera's parameters: functions of a `PlenopticCamera`.

`quantities` has the planes in focus, the resolution at each distance, the size of micro-images and the lenses that
light a pixel; `aberration` has the aberration of parabolic main lenses; `deconvolved_contrast` the resolution that can
be reached by inverting the camera's response; `microscope` quantities of cameras with objectives.

Wavelengths are in nanometres. Where a wavelength is optional, diffraction is neglected without it.
"""

from .aberration import parabolic_aberration
from .deconvolved_contrast import ResolutionLimit, resolution_limit
from .microscope import depth_of_field, lens_aperture, lenses_across_stop, native_field, objective_limit, parallax
from .quantities import (
    EffectiveResolution,
    best_distances,
    crosstalk_lenses,
    crosstalk_neighbours,
    depth_ranges,
    direction_count,
    effective_resolution,
    field_of_view,
    field_width,
    focus_type,
    focus_types,
    image_f_number,
    lens_footprint,
    lenses_across,
    main_fresnel_number,
    micro_image_distance,
    mla_f_number,
    mla_fresnel_number,
    mla_object_distances,
    pixel_footprint,
    refocus_range,
    spot_radius,
    suitable_oversample,
    virtual_depth,
    white_mean,
)
from .warnings import design_warnings, mended

__all__ = [
    "EffectiveResolution",
    "ResolutionLimit",
    "best_distances",
    "crosstalk_lenses",
    "crosstalk_neighbours",
    "depth_of_field",
    "depth_ranges",
    "design_warnings",
    "direction_count",
    "effective_resolution",
    "field_of_view",
    "field_width",
    "focus_type",
    "focus_types",
    "image_f_number",
    "lens_aperture",
    "lens_footprint",
    "lenses_across",
    "lenses_across_stop",
    "main_fresnel_number",
    "mended",
    "micro_image_distance",
    "mla_f_number",
    "mla_fresnel_number",
    "mla_object_distances",
    "native_field",
    "objective_limit",
    "parabolic_aberration",
    "parallax",
    "pixel_footprint",
    "refocus_range",
    "resolution_limit",
    "spot_radius",
    "suitable_oversample",
    "virtual_depth",
    "white_mean",
]
