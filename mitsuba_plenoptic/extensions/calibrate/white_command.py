"""The part of ``mitsuba-plenoptic calibrate`` that fits a camera to a white picture, and the file that it writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import typer

from ...camera import PlenopticCamera
from ...errors import naming
from ...io.captures import read_capture
from ...io.pictures import read_picture
from ...runtime.files import write_text
from ...runtime.progress import progress_bar
from .white_fit import WhiteFit, fit_white


def fit_camera(
    white: Path, output: Path, camera: PlenopticCamera, dark: Path | None, wavelength: float | None
) -> WhiteFit:
    """Fit a camera to a white picture, write the camera as JSON, and print what was found."""
    light, black = _values(white), None if dark is None else _values(dark)
    with naming(white), progress_bar("Fitting the camera") as progress:
        found = fit_white(light, camera, dark=black, wavelength=wavelength, progress=progress)
    text = json.dumps({**found.camera.to_dict(), "calibration": record(found)}, indent=1) + "\n"
    write_text(output, text, ".json")
    for line in summary(found):
        typer.echo(line)
    typer.echo(f"{output}: fitted to {np.count_nonzero(~found.withheld)} micro-images")
    return found


def _values(path: Path) -> np.ndarray:
    """Return a sensor's values, proportional to light."""
    return read_capture(path).image if path.suffix.lower() == ".exr" else read_picture(path, linear=True)


def summary(found: WhiteFit) -> list[str]:
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
    return lines


def record(found: WhiteFit) -> dict[str, Any]:
    """Return what a fit found and how well it agrees, for the file of the camera."""
    judged = found.judgement
    return {
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
