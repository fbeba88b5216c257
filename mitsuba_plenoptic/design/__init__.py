"""Quantities that follow from a camera's parameters: functions of a `PlenopticCamera`, in closed form and by rays.

`focus` says what the microlenses are focused on, and how sharply the camera sees at which distance; `micro_images`
how large the micro-images are, by rays and with diffraction, and which lenses light a pixel; `deconvolution`
how finely a plane can be resolved by inverting the camera's response; `microscope` is for objectives.

A wavelength is in nanometres; where it may be left out, diffraction then is, too.
"""

from .deconvolution import ResolutionLimit, resolution_limit
from .focus import (
    EffectiveResolution,
    best_distances,
    depth_ranges,
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
    suitable_oversample,
    virtual_depth,
)
from .micro_images import (
    crosstalk_lenses,
    crosstalk_neighbours,
    direction_count,
    image_f_number,
    main_fresnel_number,
    micro_image_distance,
    mla_f_number,
    mla_fresnel_number,
    spot_radius,
    white_mean,
)
from .microscope import lens_aperture, lenses_across_stop, native_field, objective_limit, parallax
from .warnings import design_warnings

__all__ = [
    "EffectiveResolution",
    "ResolutionLimit",
    "best_distances",
    "crosstalk_lenses",
    "crosstalk_neighbours",
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
    "micro_image_distance",
    "mla_f_number",
    "mla_fresnel_number",
    "mla_object_distances",
    "native_field",
    "objective_limit",
    "parallax",
    "pixel_footprint",
    "refocus_range",
    "resolution_limit",
    "spot_radius",
    "suitable_oversample",
    "virtual_depth",
    "white_mean",
]
