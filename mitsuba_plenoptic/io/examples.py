"""Finished captures shipped with the package, for reconstruction without rendering."""

from pathlib import Path

from ..choices import Example
from ..errors import require_choice
from .captures import Capture, read_capture
from .truth_files import GroundTruth, read_ground_truth, truth_path

FOLDER = Path(__file__).parents[1] / "examples"


def example(name: str) -> Capture:
    """Read a finished capture shipped with the package.

    All are by one camera of 48 x 48 microlenses with 16 x 16 pixels each, focused at 240 mm. ``letters-ray`` and
    ``letters-wave`` are the scene ``letters`` by both models of light, at 0.6 times its size: an 8 at 210 mm, an F at
    240 mm and a # at 280 mm. ``white`` is a luminous wall by the ray model, for the argument `white` of `reconstruct`
    and `decode`. All have the `lens_model` ``ideal``, so that the ray and wave captures do not differ by aberrations.
    ``tools/make_examples.py`` makes them.

    Parameters
    ----------
    name : {"letters-ray", "letters-wave", "white"}
        Name of the capture.

    Returns
    -------
    Capture

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> capture = mp.example("letters-wave")
    >>> capture.model, capture.wavelength, capture.camera.lens_count
    ('wave', 633.0, (48, 48))
    """
    return read_capture(_path(name))


def example_truth(name: str) -> GroundTruth:
    """Read the ground truth of an `example`: the depth at each pixel and in each view.

    Parameters
    ----------
    name : {"letters-ray", "letters-wave", "white"}
        Name of the capture.

    Returns
    -------
    GroundTruth
        Its only quantity is ``depth``, rounded to 2^-10 mm.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> truth = mp.example_truth("letters-wave")
    >>> lf = mp.decode(mp.example("letters-wave"), truth=truth)
    """
    return read_ground_truth(truth_path(_path(name)))


def _path(name: str) -> Path:
    return FOLDER / f"{require_choice('example', name, Example)}.exr"
