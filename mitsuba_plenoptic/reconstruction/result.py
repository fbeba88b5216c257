"""A reconstruction: an image refocused to one distance, on disk as OpenEXR."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..io.exr import write_exr


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """An image refocused to one distance.

    Attributes
    ----------
    image : (rows, columns[, channels]) float32 array
        Upright; one bin per microlens of the full detector, or as many as were asked for, in units of the capture. It
        lines up with the image of Mitsuba's ``thinlens`` focused at `distance`. NaN where no light can come from.
    distance : float
        Object distance in scene units; may be infinite.
    bin_size : float
        Width of a bin in the object plane, in scene units; at infinity its slope, the width at a distance of 1.
    method : str
        How it was made.
    options : dict
        The method's options.
    camera : PlenopticCamera
        The camera of the capture.
    guards : dict
        Fractions of the light that the guards of the physics found lost, by their names.
    facts : dict
        What the method tells of the image. ``deconvolved``: the ``iterations`` made, the ``residual`` (root mean square
        of what is left of the capture, over that of the capture), whether it was ``stopped_by_noise``, the
        ``resolution_limit`` in line pairs per scene unit (at infinity per unit of slope), and whether the plane is
        ``in_focus``, where finer bins tell little more (see `design.resolution_limit`).
    """

    image: np.ndarray
    distance: float
    bin_size: float
    method: str
    camera: PlenopticCamera
    options: dict[str, Any] = field(default_factory=dict)
    guards: dict[str, float] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)


def write_reconstruction(path: str | Path, result: Reconstruction, source: dict[str, Any] | None = None) -> None:
    """Write a reconstruction as float32 OpenEXR with camera, distance and method in the header.

    Parameters
    ----------
    path : path
        File to write.
    result : Reconstruction
        What to write.
    source : dict, optional
        Metadata of the capture, kept in the header.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    attributes = {
        "kind": "reconstruction",
        "camera": result.camera.to_dict(),
        "distance": result.distance,
        "bin_size": result.bin_size,
        "method": result.method,
        "options": result.options,
        "guards": result.guards,
        "facts": result.facts,
        "source": source or {},
    }
    write_exr(path, result.image, attributes)
