"""Animations as GIF."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..choices import ANIMATED
from ..errors import argument, refuse_if, require_number
from ..runtime import Array, atomic_output
from .images import enlarge, enlargement, to_bytes


def sweep_distances(distances: Sequence[float], by: str = "distance") -> list[float]:
    """Return the distances of a focal sweep between two, in even steps of their reciprocals, or of disparities."""
    refuse_if(
        len(distances) != 2,
        f"{argument(by)}: a focal sweep goes from one {by} to another, and {len(distances)} are given",
    )
    first, last = distances
    if by == "disparity":
        return [float(step) for step in np.linspace(first, last, 24)]
    first, last = (1 / require_number("distance", value, positive=True, finite=False) for value in distances)
    return [float(1 / step) if step else math.inf for step in np.linspace(first, last, 24)]


def write_animation(
    path: str | Path, frames: Sequence[tuple[Array, str]], white: float, scale: int | None = None
) -> None:
    """Write linear images of one size as an animation that repeats, with 12.5 frames a second.

    Parameters
    ----------
    path : str or Path
        A GIF file, which programs such as ffmpeg turn into other videos.
    frames : sequence of (array, str)
        Images, (rows, columns) or with three channels, each with a text for its lower left corner.
    white : float
        Value that is shown white.
    scale : int, optional
        Pixels of the animation across one of an image. Default: as many as make the longer side nearly 480.
    """
    path = Path(path)
    scale = scale or enlargement(frames[0][0], 480)
    pictures = []
    for image, text in frames:
        picture = Image.fromarray(to_bytes(enlarge(image, scale), white))
        size = max(9, picture.height // 20)
        ImageDraw.Draw(picture).text(
            (size // 2, picture.height - size // 2),
            text,
            fill="white",
            font=ImageFont.load_default(size),
            anchor="ls",
            stroke_width=max(1, size // 12),
            stroke_fill="black",
        )
        pictures.append(picture)
    first, *following = pictures
    with atomic_output(path, *ANIMATED) as temporary:
        # Milliseconds a frame: GIF stores whole hundredths of a second.
        first.save(temporary, save_all=True, append_images=following, duration=80, loop=0)
