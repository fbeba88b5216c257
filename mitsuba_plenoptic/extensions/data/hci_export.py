"""Export of the benchmark's light fields to the folder format of the 4D Light Field Benchmark.

Honauer, Johannsen, Kondermann and Goldluecke 2016, "A dataset and evaluation methodology for depth estimation on 4D
light fields": views ``input_Cam000.png`` row by row, ``parameters.cfg``, and the depth (metres) and disparity (pixels
from view to view, positive for what is nearer than the plane in focus) of the central view as PFM. A decoded light
field is such an array of cameras on the pupil, one step of views apart, with sensors as far behind it as the microlens
array and as large, shifted so that the plane in focus stays in place.
"""

from __future__ import annotations

from pathlib import Path

from ...errors import require_choice
from ...views import decode
from ..raw.hci import write_hci
from .contents import CAPTURES, Benchmark, capture_of, central_truth


def export_hci(made: Benchmark, folder: str | Path, capture: str = "ray") -> list[Path]:
    """Write the light fields decoded from captures of one kind, one folder each; return the folders.

    In mirrors the depth is that of the mirror image. Views at the rim, which the pupil covers only in part, are left
    out: the views form the largest square within the pupil.

    Parameters
    ----------
    made : Benchmark
        The benchmark.
    folder : path
        Folder for the folders ``SCENE_CAMERA_CAPTURE``.
    capture : str
        Kind of captures.

    Returns
    -------
    list of Path
        The folders.

    Raises
    ------
    InputError
        If there is no such kind of captures, or a file cannot be written.
    """
    require_choice("capture", capture, CAPTURES)
    written = []
    for index in made.entries():
        sample = made[index]
        recorded = capture_of(sample, capture)
        lf = decode(recorded, white=made.white(index, recorded.model))
        depth = central_truth(sample)["virtual_depth"]
        place = Path(folder) / "_".join([*made.name(index), capture])
        version = str(made.manifest["recipe"]["benchmark"])
        write_hci(place, lf, depth, name="_".join(made.name(index)), version=version, white=1.0)
        written.append(place)
    return written
