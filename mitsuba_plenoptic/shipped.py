"""Names of everything that the shipped extensions add; written by ``tools/make_shipped.py``."""

from __future__ import annotations

from typing import TYPE_CHECKING

SHIPPED: dict[str, dict[str, str]] = {
    "names": {
        "calibrate": "calibrate",
        "photon_transfer": "calibrate",
        "fit": "inverse",
        "StoredOperator": "inverse",
        "volume_points": "inverse",
        "refocus.CoherentRefocus": "inverse",
        "refocus.DeconvolvedRefocus": "inverse",
        "refocus.RayRefocus": "inverse",
        "focus_by_group": "lensdesign",
        "bank_disparity": "onchip",
        "dual_pixel": "onchip",
        "half_disparity": "onchip",
        "match_halves": "onchip",
        "psf_bank": "onchip",
        "demosaic": "raw",
        "EdgeSharpness": "sharpness",
        "edge_sharpness": "sharpness",
        "Viewer": "studio",
        "view": "studio",
    },
    "modules": {
        "calibration": "calibrate",
        "dataset": "data",
        "benchmark": "data",
        "fitting": "inverse",
        "optimisation": "inverse",
        "array_functions": "inverse",
        "scene_functions": "inverse",
        "torch": "inverse",
        "jax": "inverse",
        "laser": "laser",
        "onchip": "onchip",
        "particles": "particles",
        "exchange": "raw",
        "wavefront": "wavefront",
        "far_sources": "wavefront",
        "hcipy": "wavefront",
    },
    "commands": {
        "calibrate": "calibrate",
        "dataset": "data",
        "benchmark": "data",
        "fit": "inverse",
        "dual": "onchip",
        "reproduce": "paper",
        "particles": "particles",
        "demosaic": "raw",
        "mtf": "sharpness",
        "preview": "studio",
        "view": "studio",
        "sweep": "studio",
        "run": "studio",
    },
    "parameters": {"photodiode_response": "onchip"},
    "presets": {"full_frame_dual": "onchip", "phone_quad": "onchip", "phone_quad_bayer": "onchip"},
    "captures": {"small lenses": "onchip"},
    "comparisons": {"real": "prediction"},
    "cameras": {"libpleno": "calibrate"},
    "generators": {"particles": "particles"},
    "formats": {
        ".zmx": "lensdesign",
        ".seq": "lensdesign",
        ".lfp": "raw",
        ".lfr": "raw",
        ".raw": "raw",
        "parameters.cfg": "raw",
        ".mat": "raw",
    },
    "methods": {"incoherent": "deconvolution", "deconvolved": "deconvolution"},
    "plugins": {"plenoptic_laser": "laser"},
}

# For type checkers: at run time names are served when they are asked for.
if TYPE_CHECKING:
    from .extensions.calibrate import calibration as calibration
    from .extensions.calibrate.calibration import calibrate as calibrate
    from .extensions.calibrate.photon_transfer import photon_transfer as photon_transfer
    from .extensions.data import benchmark as benchmark
    from .extensions.data import dataset as dataset
    from .extensions.inverse import array_functions as array_functions
    from .extensions.inverse import fitting as fitting
    from .extensions.inverse import optimisation as optimisation
    from .extensions.inverse import scene_functions as scene_functions
    from .extensions.inverse.fitting import fit as fit
    from .extensions.inverse.stored import StoredOperator as StoredOperator
    from .extensions.inverse.volume_points import volume_points as volume_points
    from .extensions.laser import laser as laser
    from .extensions.lensdesign.focusing import focus_by_group as focus_by_group
    from .extensions.onchip import onchip as onchip
    from .extensions.onchip.onchip import bank_disparity as bank_disparity
    from .extensions.onchip.onchip import dual_pixel as dual_pixel
    from .extensions.onchip.onchip import half_disparity as half_disparity
    from .extensions.onchip.onchip import match_halves as match_halves
    from .extensions.onchip.onchip import psf_bank as psf_bank
    from .extensions.onchip.parameter import PhotodiodeParameter
    from .extensions.particles import velocimetry as particles
    from .extensions.raw import exchange as exchange
    from .extensions.raw.demosaic import demosaic as demosaic
    from .extensions.sharpness.sharpness import EdgeSharpness as EdgeSharpness
    from .extensions.sharpness.sharpness import edge_sharpness as edge_sharpness
    from .extensions.studio.viewer import Viewer as Viewer
    from .extensions.studio.viewer import view as view
    from .extensions.wavefront import far_sources as far_sources
    from .extensions.wavefront import wavefront as wavefront

    __all__ = [
        "EdgeSharpness",
        "StoredOperator",
        "Viewer",
        "array_functions",
        "bank_disparity",
        "benchmark",
        "calibrate",
        "calibration",
        "dataset",
        "demosaic",
        "dual_pixel",
        "edge_sharpness",
        "exchange",
        "far_sources",
        "fit",
        "fitting",
        "focus_by_group",
        "half_disparity",
        "laser",
        "match_halves",
        "onchip",
        "optimisation",
        "particles",
        "photon_transfer",
        "psf_bank",
        "scene_functions",
        "view",
        "volume_points",
        "wavefront",
    ]

    class ShippedParameters:
        """Camera parameters that shipped extensions add."""

        photodiode_response: PhotodiodeParameter
