"""A real camera's pictures of flat shapes at several distances, and what moved or strayed between them.

A folder holds ``light`` and ``white``, and ``dark`` where there is one, as .png, .tiff or .exr with values proportional
to light; ``camera.json``, as `calibrate` writes it; and ``shapes.json``: by name the distance of each shape in mm, its
`region` LEFT, TOP, WIDTH, HEIGHT in bins of one a lens, and in the same way an `even` area at its distance and a window
with one nearly upright `edge`.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage
from skimage.registration import phase_cross_correlation

from ...camera import PlenopticCamera, camera_and_record
from ...detector import DetectorOperator
from ...errors import naming, refuse_if, refusing, require_choice, require_number
from ...io import Capture
from ...runtime import Floats, Numbers, Pair, read_text
from ...views import lens_numbers
from ..calibrate.white_frames import sensor_pictures

_AREAS = ("region", "even", "edge")

_WIDTHS = (8.0, 12.0, 16.0, 20.0, 25.0, 32.0, 45.0, 64.0)
"""Widths of stray light that are compared, in pixels."""


@dataclass(frozen=True)
class Shape:
    """A flat shape: its distance, and its areas by name as left, top, width and height in bins."""

    distance: float
    areas: Mapping[str, Numbers]

    def window(self, area: str, oversample: int = 1) -> tuple[slice, slice]:
        """Return the rows and columns of bins in one of the areas."""
        left, top, width, height = (round(oversample * value) for value in self.areas[area])
        return slice(top, top + height), slice(left, left + width)

    def pixels(self, camera: PlenopticCamera, area: str) -> tuple[slice, slice]:
        """Return the rows and columns of the pixels below one of the areas."""
        corner, size = np.split(np.array(self.areas[area]), 2)
        width = camera.micro_image_pitch / camera.pixel_size
        # Bins are counted from where the middle of the picture lies.
        start = np.array(camera.resolution) / 2 + width * (corner - np.array(camera.bin_count) / 2)
        left, top, right, bottom = np.rint([*start, *start + width * size]).astype(int).clip(0)
        return slice(top, bottom), slice(left, right)


@dataclass(frozen=True)
class Recording:
    """A light field and a white picture by one camera, and the shapes that are in view."""

    light: Floats
    white: Floats
    camera: PlenopticCamera
    shapes: dict[str, Shape]

    def capture(self, wavelength: float) -> Capture:
        """Return the light field as a capture by waves."""
        return Capture(self.light, self.camera, wavelength=wavelength, model="wave")


def read_recording_of(folder: Path) -> Recording:
    """Return the pictures, the camera and the shapes of a folder."""
    names = ["light", "white", "dark"]
    paths = {
        name: path
        for name in names
        for suffix in (".png", ".tif", ".tiff", ".exr")
        if (path := folder / f"{name}{suffix}").exists()
    }
    for name in names[:2]:
        refuse_if(name not in paths, f"{folder}: it has no {name}.png, .tiff or .exr")
    *pictures, dark = sensor_pictures(paths["white"], light=paths["light"], dark=paths.get("dark"))
    with naming(folder / "camera.json"):
        camera = camera_and_record(folder / "camera.json")[0]
        refuse_if(
            pictures[0].shape != camera.shape,
            f"white of shape {pictures[0].shape}: it must have the pixels of the camera, {camera.shape}",
        )
    # Noise below black is no light; it is a small part of a pixel's value.
    black = np.float32(0) if dark is None else dark.astype(np.float32)
    white, light = (np.maximum(picture.astype(np.float32) - black, 0) for picture in pictures)
    with naming(folder / "shapes.json"):
        shapes = _shapes(read_text(folder / "shapes.json", 2**20), camera)
    return Recording(light, white, camera, shapes)


def _shapes(text: str, camera: PlenopticCamera) -> dict[str, Shape]:
    """Return the shapes, nearest first, of a file's content."""
    shapes = {}
    with refusing("it holds no shapes by name, with distance and areas:", AttributeError, TypeError, ValueError):
        for name, entry in json.loads(text).items():
            for key in entry:
                require_choice(f"{name}", key, ("distance", *_AREAS))
            distance = require_number(f"{name}: distance", entry.get("distance"), positive=True)
            areas = {area: tuple(map(float, entry[area])) for area in _AREAS if area in entry}
            for area, corners in areas.items():
                columns, rows = camera.bin_count
                refuse_if(
                    len(corners) != 4
                    or min(corners) < 0
                    or min(corners[2:]) < 1
                    or corners[0] + corners[2] > columns
                    or corners[1] + corners[3] > rows,
                    f"{name}: {area} = {entry[area]}: it must be LEFT,TOP,WIDTH,HEIGHT within {columns} x {rows} bins",
                )
            refuse_if("region" not in areas, f"{name}: it has no region")
            shapes[name] = Shape(distance, areas)
    refuse_if(len({shape.distance for shape in shapes.values()}) != 2, "it must hold shapes at two distances")
    return dict(sorted(shapes.items(), key=lambda item: item[1].distance))


def moved_by(recording: Recording) -> Pair:
    """Return the pixels along x and y by which the light field has moved since the white picture.

    White is dimmed to the light field's brightness, lens by lens; borders of micro-images are then correlated.
    """
    lenses = lens_numbers(recording.camera)
    full, lit = (np.bincount(lenses.ravel(), picture.ravel()) for picture in (recording.white, recording.light))
    brightness = lit / np.maximum(full, 1e-12)
    bright = brightness > 0.3 * brightness.max()
    pictures = (bright * brightness)[lenses] * recording.white, bright[lenses] * recording.light
    borders = (ndimage.gaussian_gradient_magnitude(picture, 1.0) for picture in pictures)
    y, x = phase_cross_correlation(*borders, upsample_factor=100, normalization=None)[0].tolist()
    lens = recording.camera.micro_image_pitch / recording.camera.pixel_size
    refuse_if(max(abs(x), abs(y)) > lens / 4, f"light: it lies {-x:g} and {-y:g} pixels off the white picture")
    return -x, -y


def stray_width(recording: Recording) -> float | None:
    """Return the width in mm of the stray light around what is lit, from dark lenses; None for an even one.

    Between bright micro-images light that their rims diffract is as bright as stray light.
    """
    numbers = lens_numbers(recording.camera)
    brightness = np.bincount(numbers.ravel(), recording.light.ravel()) / np.maximum(np.bincount(numbers.ravel()), 1)
    dark = (brightness < brightness.max() / 10)[numbers]
    refuse_if(dark.mean() < 0.02, "light: hardly any of its lenses are dark, by which stray light is measured")
    lit = np.where(dark, 0, recording.light)
    seen = recording.light[dark].astype(np.float64)
    misfits = []
    for width in _WIDTHS:
        # A stray light of 1 adds the light around to each pixel; what is alike everywhere may be the black level.
        around = DetectorOperator(stray_light=1.0, stray_width=width).forward(lit)[dark]
        around = around - around.mean()
        strength = np.vdot(around, seen) / max(float(np.vdot(around, around)), 1e-12)
        misfits.append(float(np.linalg.norm(seen - seen.mean() - strength * around)))
    # The borders of dark micro-images resemble a narrow spread, to a hundredth.
    if min(misfits) > 0.9 * np.linalg.norm(seen - seen.mean()):
        return None
    return _WIDTHS[int(np.argmin(misfits))] * recording.camera.pixel_size


def aligned(recording: Recording, moved: Pair, width: float | None) -> Recording:
    """Return the recording with camera and white picture where the light field is, and with stray light of a width."""
    camera = recording.camera
    step = camera.pixel_size / camera.image_growth
    x, y = (before + step * pixels for before, pixels in zip(camera.mla_offset, moved, strict=True))
    white = ndimage.shift(recording.white, moved[::-1], order=3, mode="nearest")
    camera = camera.replace(mla_offset=(x, y), stray_width=width)
    return replace(recording, white=np.maximum(white, 0).astype(np.float32), camera=camera)


def paper_of(recording: Recording) -> Floats:
    """Return the white picture as it would be of each shape's paper, which spreads light otherwise over directions.

    In a shape's region it is multiplied by one parabola over each micro-image, which its even area tells.
    """
    camera = recording.camera
    white = recording.white.astype(np.float64)
    lenses = lens_numbers(camera)
    centres = ndimage.center_of_mass(white, lenses, np.arange(lenses.max() + 1))
    away = np.indices(lenses.shape) - np.moveaxis(np.nan_to_num(centres)[lenses], -1, 0)
    y, x = away * camera.pixel_size / camera.micro_image_pitch
    parabola = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    paper = white.copy()
    for shape in recording.shapes.values():
        if "even" not in shape.areas:
            continue
        part, region = (shape.pixels(camera, area) for area in ("even", "region"))
        lens, seen, even = lenses[part], recording.light[part], white[part]
        lit, full = (np.bincount(lens.ravel(), values.ravel()) for values in (seen, even))
        even = even * (lit / np.maximum(full, 1e-12))[lens]
        # Rims of micro-images, shadows and dust tell nothing of directions.
        bright = even > even.max() / 2
        numbers = np.linalg.lstsq(parabola[part][bright] * even[bright][:, None], seen[bright])[0]
        paper[region] = white[region] * (parabola[region] @ numbers).clip(0)
    return paper.astype(np.float32)
