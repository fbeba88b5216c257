"""Make the pictures that open the site's pages, and the thumbnails of its gallery.

Usage: ``python tools/make_pictures.py [NAME ...] [-o FOLDER]``; without names, all are made, which takes some minutes.
Without a folder, the files in ``docs/pictures/`` are replaced. ``build/pictures/`` stores the captures that several
pictures show; remove it after a change of the models. Pictures of pages in a browser need Chromium and its driver.
Names that begin with ``thumbnails/`` need the notebooks that ``make docs`` has executed.

Pictures are palette PNG files of at most 150 kB.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import matplotlib
import mitsuba as mi
import numpy as np
import real_pictures
import scipy
import xarray as xr
from bench.cases import phase_space as walls
from check_release import page_code, page_files
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from picture_layout import DPI, WIDTH, coloured, drawn, in_browser, narrowed, sheet, write
from PIL import Image, ImageChops, ImageOps

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import particles as pt
from mitsuba_plenoptic.errors import require_choice
from mitsuba_plenoptic.extensions.studio.preview import preview_figure, preview_of
from mitsuba_plenoptic.fitting import View
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.optimisation import maximise
from mitsuba_plenoptic.points.units import brightness_of
from mitsuba_plenoptic.refocus import Volume
from mitsuba_plenoptic.report.images import Brightness, to_bytes
from mitsuba_plenoptic.report.plots import Plot, annotate, bare, contact_sheet, depth_figure
from mitsuba_plenoptic.waves.scheme import plan_of

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "pictures"
STORED = ROOT / "build" / "pictures"
NOTEBOOKS = ROOT / "build" / "jupyter_execute" / "guides" / "gallery"

PICTURES: dict[str, Callable[[], Image.Image]] = {}


def picture(make: Callable[[], Image.Image]) -> Callable[[], Image.Image]:
    """Register a picture under its function's name."""
    PICTURES[make.__name__] = make
    return make


CAMERA: dict[str, Any] = {"mla_pitch": 0.032, "mla_focal_length": 0.256, "resolution": (2048, 2048)}
"""A finer array than the paper's: 256 x 256 lenses of the same f-number, with 8 x 8 pixels each."""

CLOSE: dict[str, Any] = {"crop_offset": (1376, 1920), "crop_size": (320, 320)}
"""The part of the paper's detector, 10 x 10 lenses, that sees the left edge of the ball in the still life."""


def in_colour(camera: mp.PlenopticCamera, spp: int, model: str = "ray") -> mp.Capture:
    """Capture the still life in colour."""
    scene = mp.load_scene("still_life", variant="llvm_ad_rgb")
    return mp.render_capture(mp.with_camera(scene, camera), model=model, spp=spp)


@cache
def still_life(model: str = "ray") -> mp.Capture:
    """Capture the still life in colour with the fine array."""
    return stored(f"still_life_{model}", lambda: in_colour(mp.PlenopticCamera(**CAMERA), 16, model))


def stored(name: str, make: Callable[[], mp.Capture]) -> mp.Capture:
    """Make a capture, or read what an earlier run has stored."""
    path = STORED / f"{name}.exr"
    if not path.exists():
        STORED.mkdir(parents=True, exist_ok=True)
        mp.write_capture(path, make())
    return mp.read_capture(path)


@cache
def light_field() -> Any:
    """Decode the ray capture of the still life."""
    return mp.decode(still_life())


def micro_images(capture: mp.Capture, row: int, column: int, lenses: int = 10) -> np.ndarray:
    """Cut a square of micro-images out of a square array, counted from the middle of the detector."""
    pitch = capture.camera.micro_image_pitch / capture.camera.pixel_size
    top, left = (
        round(size / 2 + index * pitch) for size, index in zip(capture.image.shape, (row, column), strict=False)
    )
    size = round(lenses * pitch)
    return capture.image[top : top + size, left : left + size]


BALL = -8, -42
"""Row and column of the fine array's lenses, from the middle, at the left edge of the ball in the still life."""


@cache
def close(model: str = "ray") -> mp.Capture:
    """Capture 10 x 10 lenses of the paper's camera at the ball, in colour."""
    return in_colour(mp.PlenopticCamera(**CLOSE), 64, model)


@cache
def depth() -> Any:
    """Find the depth of the still life with the paper's array, whose views show more texture for each bin."""
    capture = stored("depth", lambda: in_colour(mp.PlenopticCamera(resolution=(2048, 2048)), 32))
    return mp.views.depth_map(mp.decode(capture), 190, 315)


def refocused_still_life() -> list[tuple[str, np.ndarray]]:
    """Return the detector, images refocused to near, middle and far, and an image in focus everywhere, with titles."""
    capture = still_life("wave")
    near, middle, far = (result.image for result in mp.reconstruct(capture, [212, 258, 284]))
    return [
        ("Detector, close-up", micro_images(capture, -12, -42, 16)),
        ("Refocused to 212 mm", near),
        ("Refocused to 258 mm", middle),
        ("Refocused to 284 mm", far),
        ("In focus everywhere", depth()["image"].values),
    ]


@picture
def readme() -> Image.Image:
    """Show in one row what the package is about: a capture in colour, and images refocused from it."""
    return sheet([refocused_still_life()])


@picture
def start() -> Image.Image:
    """Show what the package is about: a capture, images refocused from it, and the depth."""
    scale = ScalarMappable(Normalize(190, 310), "viridis_r")
    known = depth()["depth"].values
    nearest = scipy.ndimage.distance_transform_edt(np.isnan(known), return_distances=False, return_indices=True)
    panels = [
        *refocused_still_life(),
        ("Depth; gaps from nearest", coloured(known[tuple(nearest)], 190, 310, colours="viridis_r")),
    ]
    return sheet([panels[:3], panels[3:]], colours=(scale, "mm from the main lens"))


def of_report(name: str) -> Image.Image:
    """Return a figure of the report on the paper, which is reproduced once."""
    path = STORED / "paper" / f"{name}.png"
    if not path.exists():
        words = ["reproduce", "--preset", "paper", "-o", str(path.parent)]
        subprocess.run([sys.executable, "-m", "mitsuba_plenoptic", *words], check=True)
    return narrowed(Image.open(path).convert("RGB"), 1000)


PICTURES |= {"reconstructions": partial(of_report, "methods")}
PICTURES |= {name: partial(of_report, name) for name in ("fig2", "fig4")}


@picture
def table() -> Image.Image:
    """Refocus the scene of the page for new users."""
    files = page_files((ROOT / "docs" / "start" / "index.md").read_text())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.xml"
        path.write_text(files["table.xml"])
        scene = mp.load_scene(path, variant="llvm_ad_mono")
        camera = mp.PlenopticCamera.from_json(files["camera.json"])
        results = mp.reconstruct(mp.render_capture(mp.with_camera(scene, camera), spp=32), [210, 240, 280])
    return sheet([[(f"refocused_{one.distance:g}.png", one.image) for one in results]])


@picture
def refocus() -> Image.Image:
    """Refocus a wave capture in colour."""
    results = mp.reconstruct(still_life("wave"), [212, 258, 284])
    return sheet([[(f"{one.distance:g} mm", one.image) for one in results]])


@picture
def waves() -> Image.Image:
    """Compare ray and wave captures of the same scene."""
    ray, wave = (close(model).image[:192, :192] for model in ("ray", "wave"))
    both = [result.image for model in ("ray", "wave") for result in mp.reconstruct(still_life(model), [258])]
    titles = ("Ray capture, 6 x 6 lenses", "Wave capture", "Ray capture, refocused", "Wave capture, refocused")
    cut = [image[60:200, 60:200] for image in both]
    return sheet([list(zip(titles, [ray, wave, *cut], strict=True))])


@picture
def ordinary() -> Image.Image:
    """Show the ball without an array: out of focus at f/8, and where f/32 makes diffraction wide."""
    size = {"mla_lattice": "none", "resolution": (2048, 2048), "crop_offset": (720, 760), "crop_size": (280, 280)}
    row = []
    for radius, model in ((5.0, "wave"), (1.25, "ray"), (1.25, "wave")):
        make = partial(in_colour, mp.PlenopticCamera(aperture_radius=radius, **size), 128, model)
        row.append((f"f/{40 / radius:g}, {model}s", stored(f"ordinary_{model}_{radius:g}", make).image))
    return sheet([row])


@picture
def real_camera() -> Image.Image:
    """Show the white picture of a real microscope beside that of the camera fitted to it."""
    return narrowed(drawn(real_pictures.white()), 820)


@picture
def real_light_field() -> Image.Image:
    """Show the light field of a real microscope beside those by waves and by rays."""
    return narrowed(drawn(real_pictures.light_field()), 820)


@picture
def real_volume() -> Image.Image:
    """Show slices of the volumes that waves and rays find in a real light field."""
    return narrowed(drawn(real_pictures.volume()), 820)


@picture
def unfocused_boards() -> Image.Image:
    """Show a board in a raw picture of an unfocused camera, and in three views with the corners found there."""
    camera = mp.PlenopticCamera.preset("lytro").replace(resolution=(1000, 1000), detector_width=1.4)
    board = mp.calibration.Board(6, 5, 9.0)
    pose = np.array([0.3, 0.2, 3.1, 24, 18, 320])
    white = mp.views.white_image(camera)
    centres = mp.calibration.find_centres(white).table("white")
    image = mp.render_capture(mp.calibration.board_scene(board, pose, camera), spp=16).image
    corners = mp.calibration.detect_view_corners(image, white, centres, board, camera)
    lf = mp.decode(image, camera=camera)
    row = [("Raw picture, 9 x 8 lenses", image[500:590, 500:590])]
    step = camera.row_pitch * camera.image_growth / camera.pixel_size
    for arm in (-3, 0, 3):
        u = -arm * camera.pupil_step
        view = mp.views.view(lf, u=u).values
        shown = np.repeat((255 * view.clip(0, 1)).astype(np.uint8)[..., None], 3, axis=2).repeat(6, 0).repeat(6, 1)
        beside = np.rint([corners["u"] - corners["x"], corners["v"] - corners["y"]]) == [[arm], [0]]
        for place in np.stack([corners["x"], corners["y"]], axis=-1)[beside.all(0)]:
            column, line = (6 * ((place - 499.5) / step + np.array(view.shape[::-1]) / 2)).astype(int)
            for across, down in ((8, 1), (1, 8)):
                shown[line - down : line + down + 1, column - across : column + across + 1] = (220, 120, 0)
        row.append((f"View {arm:+d} pixels aside" if arm else "Central view", shown))
    return sheet([row])


@picture
def laser() -> Image.Image:
    """Show a laser spot on a wall with one mode and several, and as if its light were incoherent."""
    size = {"detector_width": 0.256, "resolution": 128, "sky": 0.3}
    scene = mp.load_scene("speckle", variant="llvm_ad_mono", parameters=size)
    captures = {
        "One mode, 4 x 4 lenses": mp.render_capture(scene),
        "Eight modes": mp.render_capture(scene, model="wave", modes=8),
        "Incoherent, ray capture": mp.render_capture(scene, model="ray", spp=64),
    }
    return sheet([[(name, one.image) for name, one in captures.items()]])


@picture
def light_fields() -> Image.Image:
    """Show views, and one line of all views."""
    lf = light_field()
    left, right = (mp.views.view(lf, u=u).values for u in (3.0, -3.0))
    line = mp.views.epipolar_image(lf, at=0.0).values[1:-1]
    line = line.repeat(-(-len(left) // len(line)), axis=0)[: len(left)]
    titles = ("View from the pupil's left", "View from its right", "One line, from left (top) to right")
    return sheet([list(zip(titles, [left, right, line], strict=True))])


@picture
def depth_map() -> Image.Image:
    """Draw a depth map as the command does."""
    return drawn(depth_figure(depth()))


@picture
def cameras() -> Image.Image:
    """Show the micro-images of the same place of a scene by five arrays."""
    focal = {"mla_lattice": "hexagonal", "mla_aperture": "circle"}
    arrays = {
        "square": {},
        "hexagonal, round": focal,
        "rotated, with gaps": {"mla_rotation": 20, "mla_aperture": "circle", "mla_fill": 0.8},
        "focused (Keplerian)": {"detector_distance": 0.64},
        "three focal lengths": {**focal, "mla_focal_length": (0.45, 0.5, 0.56), "detector_distance": 0.61},
    }
    captures = {name: in_colour(mp.PlenopticCamera(**(CLOSE | array)), 64) for name, array in arrays.items()}
    return sheet([[(name, one.image) for name, one in captures.items()]])


@picture
def detector() -> Image.Image:
    """Expose a capture, and record it through a mosaic."""
    capture = close()
    peak = Brightness().peak([capture.image])
    scaled = replace(capture, image=capture.image / peak)
    raw = mp.expose(scaled, mp.Detector(mosaic="RGGB"), photons=300, seed=1)
    mosaic = np.zeros_like(scaled.image)
    for (row, column), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
        mosaic[row::2, column::2, channel] = np.squeeze(raw.image)[row::2, column::2]
    noisy = mp.expose(scaled, mp.Detector(), photons=300, seed=1)
    captures = {
        "Capture, 4 x 4 lenses": scaled,
        "Exposed, 300 photons": noisy,
        "Through a Bayer mosaic": replace(scaled, image=mosaic),
        "Demosaicked": mp.demosaic(raw),
    }
    row = [(name, one.image[:128, :128]) for name, one in captures.items()]
    return sheet([row], white=0.8)


@picture
def exchange() -> Image.Image:
    """Show a light field as a mosaic of lenses and as one of views."""
    lf = light_field()
    part = lf[:, :, 90:154, 60:124]
    lenses = part.values.transpose(2, 0, 3, 1, 4).reshape(64 * lf.sizes["v"], 64 * lf.sizes["u"], 3)
    views = np.asarray(mp.views.view_mosaic(mp.views.pick_views(part, 3)))
    titles = ("The capture, 20 x 20 lenses", ".eslf.png: the samples of each lens", ".png: whole views, 3 x 3")
    eslf = lenses[: 20 * lf.sizes["v"], : 20 * lf.sizes["u"]]
    return sheet([list(zip(titles, [micro_images(still_life(), -38, -68, 20), eslf, views], strict=True))])


@picture
def microscope() -> Image.Image:
    """Show a point at three depths of a light-field microscope, and one in the Fourier arrangement."""
    array = {"mla_pitch": 0.15, "mla_focal_length": 3.0, "detector_width": 1.35, "resolution": (135, 135)}
    native = mp.PlenopticCamera(main_lens=mp.Objective(20, 0.5), **array)
    array = {"mla_pitch": 0.5, "mla_focal_length": 20.0, "detector_width": 3.5, "resolution": (700, 700)}
    objective = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50.0)
    fourier = mp.PlenopticCamera(main_lens=objective, mla_offset=(0.25, 0.25), **array)
    row = []
    for title, depth in {"20 \u00b5m nearer": -0.02, "in focus": 0.0, "20 \u00b5m farther": 0.02}.items():
        spread = mp.point_spread_function(native, (0.004, 0.0, depth), wavelength=550)
        row.append((title, np.sqrt(np.asarray(spread) / np.max(spread))))
    points = [(0.01, -0.004, 0.0), (-0.012, 0.006, 0.02)]
    image = mp.CaptureOperator(fourier, points, wavelength=550, method="full_field").forward([1.0, 1.0])
    row.append(("two points, Fourier", np.sqrt(image.clip(0) / image.max())))
    return sheet([row], white=1.0)


@picture
def microscope_volume() -> Image.Image:
    """Show a capture of beads, and the volume that deconvolution finds, from the camera and from above."""
    size = {"detector_width": "3", "resolution": "300"}
    scene = mp.load_scene("beads", variant="llvm_ad_mono", parameters=size)
    capture = mp.render_capture(scene, model="wave", spp=256)
    planes = [round(0.013 * number, 3) for number in range(-4, 5)]
    volume = Volume.of(mp.reconstruct(capture, planes, method="deconvolved", volume=True, oversample=5))
    front, above = (np.sqrt(volume.maximum(axis)) for axis in ("z", "y"))
    # Voxels of the view from above are as long as they are.
    above = np.repeat(above, round(volume.spacing / volume.voxel_size), axis=0)
    above = np.pad(above, ((len(front) - len(above)) // 2, 0))
    shown = {"the capture": capture.image, "from the camera": front, "from above": above}
    return sheet([[(title, values / np.nanpercentile(values, 99.9)) for title, values in shown.items()]], white=1.0)


@picture
def wavefront_sensors() -> Image.Image:
    """Show a star behind turbulence, simulated by HCIPy, in both wavefront sensors."""
    import hcipy

    from mitsuba_plenoptic.hcipy import phase_screen
    from mitsuba_plenoptic.points.point_spread import point_fields

    grid = hcipy.make_pupil_grid(128, 0.0102)
    strength = hcipy.Cn_squared_from_fried_parameter(0.01 / 6, 633e-9)
    screen = phase_screen(hcipy.FiniteAtmosphericLayer(grid, strength, L0=1, seed=5).phase_for(633e-9), 633e-9)
    points, weights = mp.far_sources.star()

    def captured(preset: str, rows: int, **changes: Any) -> np.ndarray:
        camera = mp.PlenopticCamera.preset(preset).replace(**changes)
        image = mp.CaptureOperator(camera, points, wavelength=633, method="full_field").forward(weights)
        margin = (len(image) - rows) // 2
        return to_bytes(np.maximum(image[margin : margin + rows, margin : margin + rows], 0), 0.7 * image.max())

    telescope = mp.PlenopticCamera.preset("telescope").replace(phase_screen=screen)
    field = point_fields(telescope, points[0], wavelength=633).mla
    middle = round((-0.64 - field.origin[0]) / field.pitch), round((0.64 - field.origin[0]) / field.pitch)
    star = np.abs(field.samples[slice(*middle), slice(*middle)]) ** 2
    inside = np.hypot(*np.meshgrid(*2 * [np.linspace(-1, 1, 128)])) < 1
    path = screen.waves - screen.waves[inside].mean()
    half = np.ptp(path[inside]) / 2
    wavefront = coloured(np.where(inside, path, np.nan), -half, half, unknown=255)
    return sheet(
        [
            [
                (f"Wavefront over {np.ptp(path[inside]):.1f} waves", wavefront),
                ("Shack-Hartmann: flat wavefront", captured("shack_hartmann", 352)),
                ("Shack-Hartmann: this wavefront", captured("shack_hartmann", 352, phase_screen=screen)),
            ],
            [
                ("Star in the focus, 1.28 mm wide", to_bytes(star, 0.7 * star.max())),
                ("Array in the focus: flat wavefront", captured("telescope", 128)),
                ("Array in the focus: this wavefront", captured("telescope", 128, phase_screen=screen)),
            ],
        ]
    )


def signed(values: np.ndarray, largest: float | None = None) -> np.ndarray:
    """Draw positive values in red and negative ones in blue."""
    colours = matplotlib.colormaps["RdBu_r"](0.5 + values / (2 * (largest or np.abs(values).max())))
    return (255 * colours[..., :3]).astype(np.uint8)


@picture
def phase_space() -> Image.Image:
    """Show coefficients and kernels of signed rays, and a wall against its exact sum."""
    mi.set_variant("llvm_ad_mono")
    camera = walls.CAMERAS["square"]
    plan = plan_of(camera, walls.WAVELENGTH, False, walls.WAVELENGTH)
    kernels = plan.kernels(camera.pixel_size / 4, plan.reach)
    middle = slice(kernels.shape[1] // 2 - 40, kernels.shape[1] // 2 + 41)
    numbers = {"First": 0, "Second": 1, "Fourth": 3, "First oblique": plan.functions.count}
    rows = [
        [
            ("First coefficient, P = 0", coefficient(plan, 0.0, 0)),
            ("P = 0.75 R", coefficient(plan, 0.75, 0)),
            ("P = 0.97 R", coefficient(plan, 0.97, 0)),
            ("Second coefficient, P = 0", coefficient(plan, 0.0, 1)),
        ],
        [(f"{title} kernel", signed(np.cbrt(kernels[number][middle, middle]))) for title, number in numbers.items()],
        wall_of_signed_rays(),
    ]
    return sheet(rows)


def coefficient(plan: walls.PhaseSpace, radius: float, number: int) -> np.ndarray:
    """Draw a coefficient over the 3 x 3 lenses around that of the ray, at a node near a radius of the pupil."""
    node = round((1 - (1 - radius) ** 0.5) * plan.accuracy.radial)
    place, side = plan.nodes[node], 3 * plan.camera.row_pitch
    along = [(np.arange(count) + 0.5) * s / count - s / 2 for count, s in zip(place.counts, place.sides, strict=True)]
    inside = [np.flatnonzero(np.abs(each) < side / 2) for each in along]
    shown = np.zeros((240, 240, 3), np.uint8) + 255
    values = plan.table[node][0, ..., number][np.ix_(inside[1], inside[0])]
    size = round(240 * min(1, place.sides[0] / side))
    rows = np.arange(size) * len(values) // size
    shown[(240 - size) // 2 :][:size, (240 - size) // 2 :][:, :size] = signed(values)[np.ix_(rows, rows)]
    return shown


def wall_of_signed_rays() -> list[tuple[str, np.ndarray]]:
    """Capture a wall far off the axis by signed rays, with and without oblique kernels, and as an exact sum."""
    camera, shown, gain = walls.CAMERAS["keplerian"], 96, 25
    whole = walls.planned(camera, False, 1)
    # A blur of two lenses, 58 lenses off the axis; 12 points across a lens, and 1024 rays for each cell.
    given = 2.0, 3, 12, 1024, 1, 4, 58.0
    image, exact, _, _ = walls.pair(whole, camera, *given)
    plain = walls.pair(replace(whole, tolerance=np.inf), camera, *given)[0]
    part = slice((len(exact) - shown) // 2, (len(exact) + shown) // 2)
    image, plain, exact = (each[part, part] for each in (image, plain, exact))
    largest = exact.max()
    return [
        ("Wall, signed rays", to_bytes(np.maximum(image, 0), largest)),
        ("Exact sum of points", to_bytes(np.maximum(exact, 0), largest)),
        (f"Difference x {gain}", signed(gain * (image - exact), largest)),
        ("Without oblique kernels", signed(gain * (plain - exact), largest)),
    ]


@cache
def focused_captures() -> dict[str, mp.Capture]:
    """Capture the chart with three cameras of the same detector."""
    size = {"detector_width": 2.048, "resolution": 1024}
    return {
        name: mp.render_capture(mp.load_scene(scene, variant="llvm_ad_mono", parameters=size), spp=32)
        for name, scene in {"unfocused": "chart", "Keplerian": "keplerian", "Galilean": "galilean"}.items()
    }


@picture
def focused() -> Image.Image:
    """Compare unfocused and focused cameras."""
    found = focused_captures()
    lenses = [(f"{name}: 4 x 4 lenses", one.image[448:576, 448:576]) for name, one in found.items()]
    results = [mp.reconstruct(one, 240, oversample=1 if name == "unfocused" else 8) for name, one in found.items()]
    refocused = [(f"refocused, {len(one.image)} x {len(one.image)} bins", one.image) for one in results]
    return sheet([lenses, refocused], 1.0)


@picture
def sweeps() -> Image.Image:
    """Vary the aperture and the distance."""
    rows = []
    for radius in (1.25, 5.0):
        camera = {"detector_width": 3.072, "resolution": 768, "letter_scale": 0.6, "aperture_radius": radius}
        scene = mp.load_scene("letters", variant="llvm_ad_mono", parameters=camera)
        results = mp.reconstruct(mp.render_capture(scene, spp=32), [210, 240, 280])
        rows.append([(f"radius {radius:g} mm, refocused to {one.distance:g} mm", one.image) for one in results])
    return sheet(rows)


@picture
def inverse_problems() -> Image.Image:
    """Recover the weights of points as the page does."""
    names: dict[str, Any] = {}
    code = (ROOT / "docs" / "guides" / "inverse_problems.md").read_text()
    blocks = [block for block in page_code(code).split("\n\n") if "pylops" not in block]
    exec("\n\n".join(blocks).partition("import torch")[0], names)
    shape = names["x"].shape
    found = {
        "Weights of 8 x 8 points": names["true"],
        "Capture with noise": names["image"] / names["image"].max(),
        "Least squares": names["least_squares"].reshape(shape),
        "Tikhonov": names["tikhonov"].reshape(shape),
        "Total variation": names["smooth"],
    }
    return sheet([list(found.items())], 1.0)


@picture
def gaussians() -> Image.Image:
    """Run the code of the page, and show what its fits leave."""
    names: dict[str, Any] = {}
    exec(page_code((ROOT / "docs" / "guides" / "gaussians.md").read_text()), names)
    target = np.array(names["target"])
    row = [("Wave capture", (target / target.max()).clip(0, 1))]
    for model, found in names["found"].items():
        left = np.array(names["mi"].render(names["scene_of"](*found, names[model]), spp=64)) - target
        shown = coloured(left.mean(2) / target.max(), -0.3, 0.3, colours="RdBu_r")
        row.append((f"Left by the fit through {model}", shown))
    return sheet([row])


@picture
def long_runs() -> Image.Image:
    """Show what more samples buy."""
    camera = mp.PlenopticCamera(**(CAMERA | {"crop_offset": (600, 750), "crop_size": (512, 512)}))
    row = []
    for spp in (1, 4, 16, 64):
        (result,) = mp.reconstruct(in_colour(camera, spp), [258])
        row.append((f"{spp} samples per pixel", result.image[94:158, 75:139]))
    return sheet([row])


@picture
def figures() -> Image.Image:
    """Run the code of the page."""
    names: dict[str, Any] = {}
    code = page_code((ROOT / "docs" / "guides" / "figures.md").read_text())
    exec(code.partition("contact_sheet(results).save")[0], names)
    return drawn(contact_sheet(names["results"]))


@picture
def preview() -> Image.Image:
    """Preview the still life by the paper's camera."""
    scene = mp.load_scene("still_life", variant="llvm_ad_mono")
    return narrowed(drawn(preview_figure("", preview_of(scene, mp.PlenopticCamera()))))


@picture
def dual_pixel() -> Image.Image:
    """Show the pictures of both photodiodes of a telephone's camera, overlaid, and the disparity."""
    camera = mp.PlenopticCamera.preset("phone_quad")
    nearer = 1 / (1 / camera.focal_length - 1 / 262)
    camera = camera.replace(mla_distance=nearer, resolution=(600, 480), detector_width=0.732)
    scene = mp.with_camera(mp.load_scene("still_life", variant="llvm_ad_rgb"), camera)
    halves = mp.dual_pixel(mp.render_capture(scene, model="ray", spp=160))
    left, right = halves[0].values
    white = Brightness().peak([left + right])
    grey = [to_bytes(half.mean(-1) * 2, white) for half in (left, right)]
    disparity = mp.match_halves(halves, window=21, search=12).values
    panels = {
        "Left photodiodes": to_bytes(2 * left, white),
        "Right photodiodes": to_bytes(2 * right, white),
        "Left red, right cyan": np.dstack([grey[0], grey[1], grey[1]]),
        "Disparity: blue -8, yellow 4 lenses": coloured(disparity, -8, 4, unknown=128),
    }
    return sheet([list(panels.items())[:2], list(panels.items())[2:]])


def draw_from_above(axes: Axes, volume: xr.DataArray, place: np.ndarray, move: np.ndarray) -> None:
    """Draw a volume from above, and particles (n, 3) with their displacements."""
    above = volume.max("y")
    axes.pcolormesh(above["x"], above["z"], np.sqrt(above), cmap="gray")
    (x, _, z), (dx, _, dz) = place.T, move.T
    axes.quiver(x, z, dx, dz, color="tab:orange", angles="xy", scale_units="xy", scale=1)
    # From above, x points to the left of a camera that looks upwards on the page.
    axes.invert_xaxis()


@picture
def particles() -> Image.Image:
    """Show particles by waves and by rays, and from above those found again beside those that were there."""
    array = {"mla_pitch": 0.125, "mla_focal_length": 1.0, "detector_width": 2.0, "resolution": (256, 256)}
    camera = mp.PlenopticCamera(focal_length=50, aperture_radius=6.25, focus_distance=100, **array)
    box = pt.ParticleVolume((-0.75, -0.75, 96), (0.75, 0.75, 104))
    flow = pt.HillVortex(speed=1.5, radius=3.0, axis="x", centre=(0, 0, 100))
    truth = pt.particle_sequence(camera, box, pt.Seeding(count=16, diameter=1), flow, interval=0.12, seed=3)
    captures = [pt.ParticleImages(truth, wavelength=550, model=model).capture(0) for model in ("wave", "ray")]
    grid = pt.VoxelGrid((-0.85, -0.85, 95), (0.85, 0.85, 105), (20, 28, 28))
    window = pt.Window(96, 1.333)
    projector = pt.VoxelProjector(camera, grid, wavelength=550, window=window, per_lens=2, budget=3.0)
    volume = pt.reconstruct_volume(projector, captures[0], grid)
    plot = Plot(WIDTH, dpi=DPI)
    ((*pictures, axes),) = plot.panels(1, 3)
    for shown, capture, title in zip(pictures, captures, ("By waves", "By rays"), strict=True):
        shown.imshow(np.sqrt(np.maximum(capture.image, 0)), cmap="gray", vmax=0.12, interpolation="none")
        annotate(shown, title=title, size=9)
    chosen = truth["inside"].values[0] == 1
    draw_from_above(axes, volume, truth["position"].values[0, chosen], truth["displacement"].values[0, chosen])
    axes.set_title("Volume, z over x in mm", size=9, loc="left", pad=3)
    axes.set_xticks([-0.5, 0, 0.5], ["-0.5", "0", "0.5"], fontsize=8)
    axes.set_yticks([96, 100, 104], ["96", "100", "104"], fontsize=8)
    return drawn(plot)


@picture
def fitting() -> Image.Image:
    """Fit an array's pitch and offset to a capture with noise of known points."""
    random = np.random.default_rng(4)
    half: dict[str, Any] = {"focal_length": 40, "aperture_radius": 2.5, "mla_distance": 60, "detector_distance": 0.512}
    truth = mp.PlenopticCamera(detector_width=0.256, resolution=(128, 128), **half)
    nominal = truth.replace(mla_pitch=0.0642, mla_offset=(0.0012, -0.001))
    points = np.column_stack([random.uniform(-0.2, 0.2, (8, 2)), random.uniform(112, 128, 8)])
    photons = 2000

    def model(camera: mp.PlenopticCamera) -> np.ndarray:
        operator = mp.CaptureOperator(camera, points, wavelength=633, accuracy=0.03)
        return np.asarray(brightness_of(camera, main_lens(camera)) * operator.forward(np.ones(len(points))))

    brightest = model(truth).max()
    exact = model(truth) / brightest
    seen = random.poisson(photons * exact.clip(0)) / photons
    view = View(seen, points, np.full(len(points), 1 / brightest))
    names = ["mla_pitch", "mla_offset"]
    found = mp.fit(nominal, view, names, wavelength=633, photons=photons, accuracy=0.03)
    deviation = np.sqrt(exact.clip(0) / photons + 1 / photons**2)

    def residual(camera: mp.PlenopticCamera) -> np.ndarray:
        return coloured((model(camera) / brightest - seen) / deviation, -5, 5, colours="RdBu_r")

    pitch, (x, y) = 1e3 * found.camera.row_pitch, (1e3 * value for value in found.camera.mla_offset)
    print(f"fitting: pitch {pitch:.3f} um, offset ({x:.3f}, {y:.3f}) um; true: 64, (0, 0)")
    panels = {
        "Capture with noise, 4 x 4 lenses": to_bytes(np.sqrt(seen / seen.max()), 1.0),
        "Nominal camera less capture": residual(nominal),
        "Fitted camera less capture": residual(found.camera),
    }
    return sheet([list(panels.items())])


@picture
def designing() -> Image.Image:
    """Vary one aberration, and show what points at two depths look like without it and with the best of it."""
    names: dict[str, Any] = {}
    exec(page_code((ROOT / "docs" / "guides" / "designing.md").read_text()), names)
    camera, figure = names["camera"], names["figure"]
    best = maximise(figure, camera, {"wavefront.11": (-1, 1)}).camera
    waves = np.linspace(-0.7, 0.7, 29)
    curve = [1e3 * np.mean(figure.deviations(camera.replace(wavefront=(0.0,) * 10 + (wave,)))) for wave in waves]
    plot = Plot(WIDTH, 2.75, DPI)
    left, right = plot.add_gridspec(1, 2, width_ratios=(3.4, 3.75))
    axes = plot.add_subplot(left)
    axes.plot(waves, curve, color="#1b1f24")
    chosen = best.wavefront[10]
    axes.plot([chosen], [1e3 * np.mean(figure.deviations(best))], "o", color="#ffb000", label="found")
    axes.set_xticks([-0.5, 0, 0.5])
    ticks = np.arange(0, max(curve), 10)
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_ylim(0, 1.05 * max(curve))
    axes.tick_params(labelsize=8)
    axes.set_xlabel("spherical aberration in waves", size=8)
    axes.set_title("Deviation of depth in micrometres", size=9, loc="left", pad=3)
    axes.legend(fontsize=8)
    panels = right.subgridspec(2, 3).subplots()
    for row, (name, one) in enumerate({"without": camera.replace(wavefront=()), "found": best}.items()):
        for column, depth in enumerate((116.0, 118.0, 122.0)):
            spread = np.asarray(mp.point_spread_function(one, (0.02, 0.01, depth), wavelength=633))
            panel = panels[row, column]
            bare(panel).imshow(np.sqrt(spread[40:90, 36:86]), cmap="gray", interpolation="none")
            annotate(panel, title=f"{depth:g} mm" if row == 0 else "", side=name if column == 0 else "", size=9)
    return drawn(plot)


@picture
def viewer() -> Image.Image:
    """Show the viewer in a browser."""
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "view.html"
        mp.view(in_colour(mp.PlenopticCamera(resolution=(1024, 1024)), 32)).save(page)
        return in_browser(page, 1100, 900)


@picture
def compare() -> Image.Image:
    """Show the report of a comparison in a browser."""
    with tempfile.TemporaryDirectory() as folder:
        options = ["-D", "detector_width=3.072", "-D", "resolution=768", "-D", "letter_scale=0.6"]
        words = ["compare", "letters", "-o", folder, *options, "--distance", "210", "--distance", "280"]
        subprocess.run([sys.executable, "-m", "mitsuba_plenoptic", *words], check=True)
        return in_browser(Path(folder) / "report.html", 1100, 1000)


def thumbnail(page: str) -> Image.Image:
    """Take a picture that a notebook of the gallery shows, the last unless another is chosen."""
    path = NOTEBOOKS / f"{page}.ipynb"
    outputs = [one for cell in json.loads(path.read_text())["cells"] for one in cell.get("outputs", [])]
    shown = [one["data"]["image/png"] for one in outputs if "image/png" in one.get("data", {})]
    if not shown:
        raise SystemExit(f"{path}: it shows no picture: run 'make docs' first")
    image = Image.open(io.BytesIO(base64.b64decode(shown[CHOSEN.get(page, -1)]))).convert("RGB")
    content = ImageChops.difference(image, Image.new("RGB", image.size, "white")).getbbox()
    return ImageOps.expand(ImageOps.pad(image.crop(content), (464, 304), color="white"), 8, "white")


CHOSEN = {"rays_and_waves": 1} | dict.fromkeys(
    ("refocusing_and_depth", "main_lenses", "focused_cameras", "laser_light", "ordinary_camera", "particles"), 0
)
"""Pictures of notebooks that are not their last, from 0."""

for _page in sorted((ROOT / "docs" / "guides" / "gallery").glob("*.md")):
    if _page.stem != "index":
        PICTURES[f"thumbnails/{_page.stem}"] = partial(thumbnail, _page.stem)


def main() -> None:
    """Make those that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all of them")
    parser.add_argument("-o", "--output", type=Path, default=FOLDER, metavar="FOLDER")
    given = parser.parse_args()
    for name in given.names or PICTURES:
        write(given.output / f"{require_choice('picture', name, PICTURES)}.png", PICTURES[name]())


if __name__ == "__main__":
    main()
