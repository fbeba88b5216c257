"""Files of text, each whole, and who reads them: for cases of bytes that are not text."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.calibration import read_camera
from mitsuba_plenoptic.camera.aperture import known_image
from mitsuba_plenoptic.camera.phase_screen import known_screen
from mitsuba_plenoptic.dataset import read_recipe
from mitsuba_plenoptic.extensions.calibrate.observations import read_centres, read_foreign_centres
from mitsuba_plenoptic.extensions.data.shards import read_manifest
from mitsuba_plenoptic.extensions.onchip.photodiode_response import known_response
from mitsuba_plenoptic.extensions.raw.hci import read_hci
from mitsuba_plenoptic.extensions.studio.sweep import read_grid
from mitsuba_plenoptic.microlens.shape import known_shape
from mitsuba_plenoptic.optics.spectrum import read_responses
from mitsuba_plenoptic.prescription.lens_file import read_lens, read_prescription

LENS = """name: Achromat
surfaces:
  - {radius: 61.47, thickness: 6, semi_aperture: 12.5, stop: true, glass: {index: 1.5168, abbe: 64.17}}
  - {radius: -44.64, thickness: 2.5, semi_aperture: 12.5, glass: {index: 1.67270, abbe: 32.21}}
  - {radius: -129.94, semi_aperture: 12.5, conic: 0, asphere: [0, 0]}
"""
ZEMAX = """MODE SEQ
NAME Singlet
UNIT MM X W X CM MR CPMM
ENPD 10
WAVM 1 0.55 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0
  DISZ INFINITY
SURF 1
  STOP
  TYPE STANDARD
  CURV 0.02
  DISZ 5
  GLAS ___BLANK 1 0 1.5168 64.17 0
  DIAM 6 1 0 0 1
SURF 2
  TYPE STANDARD
  CURV -0.02
  DISZ 48
  DIAM 6 1 0 0 1
SURF 3
  TYPE STANDARD
  CURV 0
  DISZ 0
"""
CODEV = """TITLE 'Singlet'
DIM M
RDM Y
EPD 10
WL 550
REF 1
SO 0 1e20
S 50 5 516800.641700
  STO
  CIR 6
S -50 48
  CIR 6
SI 0 0
"""
RECIPE = """name: few
count: 2
seed: 1
models: [ray]
camera: {detector_width: 0.256, resolution: [64, 64], focus_distance: {from: 230, to: 250}}
scenes:
  - {generator: shapes, objects: {from: 3, to: 6, step: 1}}
ray: {spp: {from: 1, to: 2, step: 1}}
"""
RESPONSE = {"angles_x": [-1, 0, 1], "angles_y": [-1, 1], "responses": [[[[1, 1, 1], [1, 1, 1]]]]}

HCI = f"""[extrinsics]
num_cams_x = 2
num_cams_y = 2
[mitsuba_plenoptic]
camera = {mp.PlenopticCamera(resolution=(64, 64), detector_width=0.256).to_json()}
white = 1.5
channels = 1
""".replace("\n ", " ").replace("\n}", "}")


def read_views(path: str) -> Any:
    """Read a folder of the 4D Light Field Benchmark from the text and four pictures, which are put beside it."""
    folder = Path(path).parent
    for number in range(4):
        Image.new("RGB", (4, 4)).save(folder / f"input_Cam{number:03d}.png")
    return read_hci(folder)


TEXTS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "camera.json": (mp.PlenopticCamera(resolution=(64, 64), detector_width=0.256).to_json(), read_camera),
    "lens.yaml": (LENS, read_prescription),
    "lens.json": (
        json.dumps(
            {
                "name": "Ball",
                "surfaces": [
                    {"radius": 50, "thickness": 5, "semi_aperture": 6, "stop": True, "glass": 1.5},
                    {"radius": -50, "semi_aperture": 6},
                ],
            }
        ),
        read_lens,
    ),
    "design.zmx": (ZEMAX, read_prescription),
    "design.seq": (CODEV, read_prescription),
    "screen.json": (json.dumps({"waves": [[0, 0.1, 0, 0.2]] * 4, "width": 10}), known_screen),
    "aperture.json": (json.dumps({"transmission": [[0, 0.5], [1, 0.25]]}), known_image),
    "shape.json": (json.dumps({"form": "conic", "curvature_radius": 0.26, "conic": 0}), known_shape),
    "response.json": (json.dumps(RESPONSE), lambda path: known_response("pixel_response", path)),
    "responses.csv": ("# nm, response\n400, 0.2\n500, 0.9\n600, 0.4\n", read_responses),
    "centres.csv": ("k,l,u,v\n0,0,8.0,8.0\n1,0,24.0,8.0\n", read_centres),
    "centres.json": (json.dumps({"mic_list": [[8.0, 8.0, 0, 0], [8.0, 24.0, 0, 1]]}), read_foreign_centres),
    "recipe.yaml": (RECIPE, read_recipe),
    "varied.yaml": ("samples: [1, 2]\ndistance: [210.0, 2.8e2]\n", lambda path: read_grid(Path(path))),
    "parameters.cfg": (HCI, read_views),
    "dataset.json": (
        json.dumps({"count": 2, "samples_per_shard": 1, "recipe": {}}),
        lambda path: read_manifest(Path(path).parent),
    ),
}
"""Contents and readers by the names of files."""
