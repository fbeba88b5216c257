"""Changes of a camera's parameters that mend faults of its design.

Changes of the microlenses keep the image that they see, at the distance a before the array: for every z, :math:`1/f_2 =
1/z + 1/a`.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from ..camera import PARAMETERS, PlenopticCamera, one_if_equal, one_if_single
from ..errors import InputError
from .quantities import mla_object_distances

Changes = dict[str, Any] | None
"""Parameters by name; None where no parameters mend a design."""


@dataclass(frozen=True)
class Finding:
    """A fault of a design and its remedies, the best first, each as words and changes of parameters."""

    text: str
    remedies: tuple[tuple[str, Changes], ...] = ()
    # What lessens it besides.
    besides: str = ""

    def mended(self, camera: PlenopticCamera) -> Iterator[tuple[str, PlenopticCamera]]:
        """Yield the possible remedies, in words with their values, and the cameras that they lead to."""
        for words, changes in self.remedies:
            changed = changed_camera(camera, changes)
            # F-number below which no lens in air images without aberrations.
            if changes is not None and changed is not None and changed.f_number >= min(0.5, camera.f_number):
                # Of a main lens, the words say what is changed.
                values = ", ".join(f"{n} = {_written(v)}" for n, v in changes.items() if n != "main_lens")
                yield f"{words} ({values})" if values else words, changed

    def sentence(self, camera: PlenopticCamera) -> str:
        """Return the sentence of a warning: the fault and its remedies."""
        offers = [words for words, _ in self.mended(camera)] + [self.besides] * bool(self.besides)
        return self.text + ("; " + ", or ".join(offers) if offers else "")


def changed_camera(camera: PlenopticCamera, changes: Changes) -> PlenopticCamera | None:
    """Return the camera with the changes, None if such a camera is refused.

    For example, the lens may not open so far, a shape may set the focal length, or the detector may be too large.
    """
    try:
        return None if changes is None else camera.replace(**changes)
    except InputError:
        return None


def _written(value: Any) -> str:
    """Write a value with the digits that a warning needs."""
    if isinstance(value, tuple):
        return f"({', '.join(map(_written, value))})"
    return f"{value:.6g}" if isinstance(value, float) else f"{value}"


def detector_at(camera: PlenopticCamera, reduced_distance: float) -> Changes:
    """Return the microlens focal length for a detector at a distance (in air) that leaves the same image in focus."""
    powers = [1 / reduced_distance + 1 / a for a in mla_object_distances(camera)]
    if min(powers) <= 0:
        return None
    lengths = one_if_single(tuple(camera.mla_medium / power for power in powers))
    return {"detector_distance": camera.mla_medium * reduced_distance, "mla_focal_length": lengths}


def larger_lenses(camera: PlenopticCamera, factor: float) -> Changes:
    """Return the parameters of microlenses larger by a factor, and as much farther from the detector."""
    pitch = one_if_equal((factor * camera.mla_pitches[0], factor * camera.mla_pitches[1]))
    behind = detector_at(camera, factor * camera.reduced_distance)
    return behind and {"mla_pitch": pitch, **behind}


def finer_pixels(camera: PlenopticCamera, factor: float) -> Changes:
    """Return the changes that divide the width of pixels by a factor, rounded up to whole numbers of pixels."""
    count = math.ceil(factor * (1 - 1e-9))

    def several(pair: tuple[int, int]) -> tuple[int, int]:
        return count * pair[0], count * pair[1]

    changes = {"resolution": several(camera.resolution)}
    if camera.is_cropped:
        changes |= {"crop_offset": several(camera.crop_offset), "crop_size": several(camera.crop_size)}
    return changes


def in_millimetres(camera: PlenopticCamera) -> Changes:
    """Return changes that turn a camera's lengths from metres into millimetres."""
    of_length = [name for name, entry in PARAMETERS.items() if entry.unit == "mm" and not entry.instead_of]
    values = {name: getattr(camera, PARAMETERS[name].attribute) for name in of_length}
    return {
        name: tuple(1000 * length for length in value) if isinstance(value, tuple) else 1000 * value
        for name, value in values.items()
        if value is not None
    }


def least_change(change: Callable[[float], Changes], camera: PlenopticCamera, good: Callable[[Any], bool]) -> Changes:
    """Return the changes at the greatest factor below 1, to a thousandth, at which the camera is good."""
    low = 0.0
    high = 1.0
    for _ in range(12):
        middle = (low + high) / 2
        changed = changed_camera(camera, change(middle))
        low, high = (middle, high) if changed is not None and good(changed) else (low, middle)
    return change(low) if low else None
