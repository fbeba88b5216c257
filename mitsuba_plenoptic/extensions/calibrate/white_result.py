"""Values of white pictures, and what the fit of a camera to one finds, in lines and for the file of the camera."""

from dataclasses import asdict
from typing import Any

import numpy as np

from .photon_transfer import PhotonTransfer
from .white_fit import WhiteFit


def summary(fit: WhiteFit, noise: PhotonTransfer | str | None) -> list[str]:
    """Return lines on a fit's numbers and how withheld micro-images agree."""
    judgement = fit.judgement
    frame = fit.frame
    across, up = np.sqrt((fit.off_array[fit.withheld] ** 2).mean(0))
    light = "rays" if fit.wavelength is None else f"waves of {fit.wavelength:g} nm"
    excluded = {"saturated": frame.saturated, "defective": frame.defective, "unlit": frame.unlit}
    left_out = ", ".join(f"{count} {name}" for name, count in excluded.items() if count) or "none"
    lines = [f"pixels left out: {left_out}; {judgement.outliers:.2%} of the others lie off the model, as of dust"]
    for name, values in fit.field.coefficients.items():
        lines.append(f"{name:>16} {values[0]:10.4g} +- {fit.deviations[name][0]:.2g}")
    pupil = fit.camera.vignetting
    assert pupil is not None
    lines += [
        f"pupil: a map of {len(pupil.transmission)} coefficients, an outline of {len(pupil.harmonics)}",
        f"withheld, {np.count_nonzero(fit.withheld)} micro-images, by {light}: residual {judgement.residual:.2%} of "
        f"the light in their middle, {judgement.systematic:.2%} of it alike in zones, {judgement.scatter:.2%} from "
        "lens to lens",
        f"mean micro-image: {judgement.mean_image:.2%}",
        f"places: {across:.3f} and {up:.3f} pixels RMS from the warped array",
    ]
    if isinstance(noise, str):
        lines.append(f"gain and noise of the sensor: not found, {noise}")
    elif noise is not None:
        lines.append(
            f"sensor: {noise.gain:.4g} +- {noise.gain_deviation:.2g} numbers per electron, read noise "
            f"{noise.read_noise:.3g} +- {noise.read_noise_deviation:.2g} electrons, {noise.hot_pixels} hot and "
            f"{noise.dead_pixels} dead pixels"
        )
    return lines


def record(fit: WhiteFit, noise: PhotonTransfer | str | None) -> dict[str, Any]:
    """Return what a fit found and how well it agrees, for the file of the camera."""
    judgement = fit.judgement
    return {
        "detector": asdict(noise.detector) if isinstance(noise, PhotonTransfer) else None,
        "lens_index": fit.lens_index(),
        "light": "rays" if fit.wavelength is None else {"wavelength_nm": fit.wavelength},
        "field": {
            "middle_px": fit.field.middle.tolist(),
            "scale_px": fit.field.scale,
            "coefficients": {
                name: {"value": values.tolist(), "deviation": fit.deviations[name].tolist()}
                for name, values in fit.field.coefficients.items()
            },
        },
        "pixels": {
            "saturated": fit.frame.saturated,
            "defective": fit.frame.defective,
            "unlit": fit.frame.unlit,
            "off_the_model": judgement.outliers,
        },
        "withheld": {
            "lenses": int(fit.withheld.sum()),
            **{name: getattr(judgement, name) for name in ("residual", "systematic", "scatter", "mean_image")},
            "off_array_px": np.sqrt((fit.off_array[fit.withheld] ** 2).mean(0)).tolist(),
        },
    }
