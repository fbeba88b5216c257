"""The part of ``mitsuba-plenoptic calibrate`` that fits a camera to a white picture, and the file that it writes."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import typer

from ...camera import PlenopticCamera
from ...choices import RAW_SUFFIXES
from ...errors import InputError, naming
from ...io.captures import Capture
from ...io.pictures import read_numbers
from ...runtime.files import write_text
from ...runtime.progress import progress_bar
from ...views.light_field_files import read_recording
from .fitted_camera import stray_fraction
from .photon_transfer import PhotonTransfer, photon_transfer
from .white_fit import WhiteFit, fit_white
from .white_page import write_white_report


def fit_camera(
    white: Path,
    output: Path,
    camera: PlenopticCamera,
    dark: Path | None,
    wavelength: float | None,
    report: Path | None,
) -> None:
    """Fit a camera to a white picture, write the camera as JSON and a report, and print what was found."""
    light, black = sensor_values(white), None if dark is None else sensor_values(dark)
    noise = None if black is None else _noise(light, black)
    with naming(white), progress_bar("Fitting the camera") as progress:
        found = fit_white(light, camera, dark=black, wavelength=wavelength, progress=progress)
    values = {**found.camera.to_dict(), "calibration": record(found, noise)}
    write_text(output, json.dumps(values, indent=1) + "\n", ".json")
    lines = summary(found, noise)
    for line in lines:
        typer.echo(line)
    if report is not None:
        with progress_bar("Simulating the white picture"):
            write_white_report(report, found, lines)
    typer.echo(f"{output}: fitted to {np.count_nonzero(~found.withheld)} micro-images")


def sensor_values(path: Path) -> np.ndarray:
    """Return a sensor's values, proportional to light: the numbers in a picture."""
    if path.suffix.lower() in RAW_SUFFIXES:
        return read_numbers(path).numbers.astype(np.float64)
    found = read_recording(path, linear=True)
    return found.image if isinstance(found, Capture) else found


def _noise(white: np.ndarray, dark: np.ndarray) -> PhotonTransfer | str:
    """Return what white and dark pictures tell about the sensor, or why they tell nothing."""
    try:
        return photon_transfer(white, dark)
    except InputError as error:
        return str(error)


def summary(found: WhiteFit, noise: PhotonTransfer | str | None) -> list[str]:
    """Return lines on a fit's numbers and how withheld micro-images agree."""
    judged, frame = found.judgement, found.frame
    across, up = np.sqrt((found.off_array[found.withheld] ** 2).mean(0))
    light = "rays" if found.wavelength is None else f"waves of {found.wavelength:g} nm"
    excluded = {"saturated": frame.saturated, "defective": frame.defective, "unlit": frame.unlit}
    left_out = ", ".join(f"{count} {name}" for name, count in excluded.items() if count) or "none"
    lines = [f"pixels left out: {left_out}; {judged.outliers:.2%} of the others lie off the model, as of dust"]
    for name, values in found.field.coefficients.items():
        lines.append(f"{name:>16} {values[0]:10.4g} +- {found.deviations[name][0]:.2g}")
    lines += [
        f"withheld, {np.count_nonzero(found.withheld)} micro-images, by {light}: residual {judged.residual:.2%} of the "
        f"light in their middle, {judged.systematic:.2%} of it alike in zones, {judged.scatter:.2%} from lens to lens",
        f"mean micro-image: {judged.mean_image:.2%}",
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


def record(found: WhiteFit, noise: PhotonTransfer | str | None) -> dict[str, Any]:
    """Return what a fit found and how well it agrees, for the file of the camera."""
    judged, stray = found.judgement, stray_fraction(found.camera, found.field)
    sensor = noise.detector if isinstance(noise, PhotonTransfer) else None
    return {
        "detector": {"stray_light": stray} if sensor is None else asdict(replace(sensor, stray_light=stray)),
        "lens_index": found.lens_index(),
        "light": "rays" if found.wavelength is None else {"wavelength_nm": found.wavelength},
        "field": {
            "middle_px": found.field.middle.tolist(),
            "scale_px": found.field.scale,
            "coefficients": {
                name: {"value": values.tolist(), "deviation": found.deviations[name].tolist()}
                for name, values in found.field.coefficients.items()
            },
        },
        "pixels": {
            "saturated": found.frame.saturated,
            "defective": found.frame.defective,
            "unlit": found.frame.unlit,
            "off_the_model": judged.outliers,
        },
        "withheld": {
            "lenses": int(found.withheld.sum()),
            "residual": judged.residual,
            "systematic": judged.systematic,
            "scatter": judged.scatter,
            "mean_image": judged.mean_image,
            "off_array_px": np.sqrt((found.off_array[found.withheld] ** 2).mean(0)).tolist(),
        },
    }
