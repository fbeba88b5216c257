"""Quantities that follow from a camera's parameters: functions of a `PlenopticCamera`.

`focus` has the planes in focus, the spot of a microlens and the resolution at each distance; `micro_images` the size of
micro-images and the lenses that light a pixel; `aberration` that of thin main lenses that are parabolic phases;
`deconvolution` the resolution that can be reached by inverting the camera's response; `microscope` quantities of
cameras with objectives.

Wavelengths are in nanometres. Where a wavelength is optional, diffraction is neglected without it.
"""

from .aberration import parabolic_aberration
from .deconvolved_contrast import ResolutionLimit, resolution_limit
from .focus import (
    EffectiveResolution,
    best_distances,
    depth_ranges,
    direction_count,
    effective_resolution,
    field_of_view,
    field_width,
    focus_type,
    focus_types,
    lens_footprint,
    lenses_across,
    mla_object_distances,
    pixel_footprint,
    refocus_range,
    spot_radius,
    suitable_oversample,
    virtual_depth,
)
from .micro_images import (
    crosstalk_lenses,
    crosstalk_neighbours,
    image_f_number,
    main_fresnel_number,
    micro_image_distance,
    mla_f_number,
    mla_fresnel_number,
    white_mean,
)
from .microscope import depth_of_field, lens_aperture, lenses_across_stop, native_field, objective_limit, parallax
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
