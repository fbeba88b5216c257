"""The paper's experiment on real light, and on light that the same camera is simulated to record, as a control.

The verdicts are those on simulated letters: `claims.check_claims` of the same measurements.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy import ndimage
from skimage.util import view_as_blocks

from ...camera import PlenopticCamera
from ...errors import naming
from ...io import Cache, Capture, StageOptions, digest, write_json
from ...refocus import reconstruct
from ...report import (
    COMPARED_METHODS,
    Experiment,
    Settings,
    comparison,
    open_store,
    pages,
    plots,
    refocused,
    window_sharpness,
)
from ...runtime import Facts, Floats, Named, Numbers, Pair, software
from ...scene import render_capture
from ...views import lens_numbers
from ..calibrate.photon_transfer import electrons
from ..deconvolution.deconvolved import flat_field
from ..deconvolution.response import Response
from .claims import Claim, check_claims, claims_section
from .readings import measure_readings, of_subsets, quarters
from .recording import Recording, Shape, aligned, moved_by, paper_of, read_recording_of, stray_width

FINE = 8
"""Bins along a lens of deconvolved pictures."""

_SHOWN = 4
"""The same of the other pictures."""

_FINER = 4
_BEYOND = 2.0
"""Bins of a control's sheets along one of `FINE`, and bins of one a lens by which sheets reach beyond the picture."""

STEPS = 30
VARIATION = 0.01
_RIM = 0.3
"""Steps, weight of the total variation, and light over the brightest of a lens below which pixels are left out: at the
rims of micro-images the model is worst, and steps make a grid of lenses of it."""

TITLES = {
    "ray": "Rays, lens footprint",
    "coherent": "Coherent",
    "partial": "Partially coherent, every second lens",
    "quarters": "Partially coherent, quarters of the array",
    "incoherent": "Incoherent",
    "deconvolved": "Deconvolved",
}
"""Methods of the pictures."""


@dataclass(frozen=True)
class Judged:
    """The paper's statements on one light field, and how well it is deconvolved."""

    pictures: dict[tuple[str, float], Floats]
    measured: Named
    claims: list[Claim]
    quality: list[Named]


def reproduce_real(output: Path, folder: Path, *, wavelength: float = 550.0, stages: StageOptions | None) -> Named:
    """Judge the paper's statements on a folder's light field and on a simulated control, and write the report."""
    store = open_store(output, stages)
    recorded = read_recording_of(folder)
    shapes = {name: asdict(shape) for name, shape in recorded.shapes.items()}
    key = {"pictures": digest(recorded.light, recorded.white), "camera": recorded.camera.to_dict()}
    stages_of_light = 2 + 2 * (len(TITLES) + sum(method.source == "wave" for method in COMPARED_METHODS))
    simulated = open_store(output / "control", stages)
    for cache in (store, simulated):
        cache.expect([0.0] * (3 + 2 * stages_of_light))
    placed = store.facts(
        "alignment",
        key,
        lambda _: {
            "moved": moved_by(recorded),
            "stray_width": stray_width(recorded),
            "electrons": electrons(recorded.white),
        },
    )
    real = aligned(recorded, placed["moved"], placed["stray_width"])
    judged = {"real": judge(real, store, folder.name, wavelength)}
    planes = {name: judged["real"].pictures["deconvolved", shape.distance] for name, shape in real.shapes.items()}
    control = _control(real, planes, simulated, wavelength, placed["electrons"])
    judged["control"] = judge(control, simulated, f"{folder.name}, simulated", wavelength)
    command = f"mitsuba-plenoptic reproduce --real {folder}"
    results = {
        "command": command,
        "wavelength": wavelength,
        "camera": real.camera.to_dict(),
        "shapes": shapes,
        "software": software(),
        "alignment": placed,
        "stage_seconds": store.seconds,
        **{
            name: {**result.measured, "claims": [asdict(claim) for claim in result.claims], "quality": result.quality}
            for name, result in judged.items()
        },
    }
    write_json(output / "results.json", results)
    for name, result in judged.items():
        draw(output / f"{name}.png", real.camera, result.pictures)
    _page(output, judged, placed, command)
    return results


def judge(recording: Recording, store: Cache, scene: str, wavelength: float) -> Judged:
    """Refocus a light field to all shapes by all methods, and compute verdicts and the quality of deconvolution."""
    camera = recording.camera
    capture = recording.capture(wavelength)
    white = replace(capture, image=recording.white)
    paper = paper_of(recording)
    key = f"{digest(recording.light, recording.white)} {camera.to_json()} {wavelength:g}"
    keys = {"capture": key}
    near, *_, far = recording.shapes
    distances = [recording.shapes[name].distance for name in (near, far)]
    images = {}
    for method in (method for method in COMPARED_METHODS if method.source == "wave"):
        by_distance = refocused(store, method.name, capture, key, distances, method.options)
        images.update({(method.name, distance): image for distance, image in by_distance.items()})
    experiment = Experiment(
        settings=Settings(scene=scene, wavelength=wavelength, distances=tuple(distances)),
        camera=camera,
        ray=capture,
        wave=capture,
        points=None,
        wave_key=key,
        truths={},
        images=images,
        pinhole=np.zeros(camera.bin_count[::-1]),
        boxes={name: _box(camera, shape.distance, shape.areas["region"]) for name, shape in recording.shapes.items()},
        seconds=store.seconds,
        ordinary=None,
    )
    measured = {
        "reconstructions": [{"bins": list(image.shape[::-1])} for image in images.values()],
        "interference": comparison.shape_interference(experiment),
        "readings": measure_readings(experiment, store, near, far),
    }
    pictures = {}
    makers = {name: partial(_divided, name, capture, white) for name in TITLES}
    makers["deconvolved"] = partial(_deconvolved, capture, paper)
    for (name, make), distance in itertools.product(makers.items(), distances):
        pictures[name, distance], _ = store.image(
            f"picture_{name}_{distance:g}",
            {**keys, "paper": digest(paper), "steps": [STEPS, VARIATION, _RIM]},
            lambda _, make=make, distance=distance: (  # type: ignore[misc]
                make(distance),
                {"kind": "reconstruction", "distance": distance},
            ),
        )
    quality = store.facts(
        "quality",
        {**keys, "shapes": {name: asdict(shape) for name, shape in recording.shapes.items()}},
        lambda _: {
            "rows": [
                _quality(name, shape, recording, paper, pictures["deconvolved", shape.distance], wavelength)
                for name, shape in recording.shapes.items()
            ]
        },
    )["rows"]
    return Judged(pictures, measured, check_claims(experiment, measured, None, near, far), quality)


def _box(camera: PlenopticCamera, distance: float, area: Sequence[float]) -> Pair:
    """Return the corners in the camera's frame of left, top, width and height in bins."""
    left, top, width, height = area
    corners = np.array([[left + width, top + height], [left, top]]) - np.array(camera.bin_count) / 2
    low, high = np.column_stack([-corners * camera.bin_size(distance), [distance] * 2])
    return low, high


def _divided(name: str, capture: Capture, white: Capture, distance: float) -> Floats:
    """Return a picture of a light field, divided by that of white refocused in the same way."""

    def refocus(one: Capture) -> Floats:
        if name == "quarters":
            return np.asarray(of_subsets(one, distance, quarters, _SHOWN), np.float32)
        options = {"interleave": 2} if name == "partial" else {}
        return reconstruct(one, distance, method=name, oversample=_SHOWN, **options).image

    light, even = refocus(capture), refocus(white)
    return np.divide(light, even, out=np.full_like(light, np.nan), where=even > 0.05 * np.nanmax(even))


def _deconvolved(capture: Capture, paper: Floats, distance: float) -> Floats:
    """Return the plane that explains a light field, over the radiance of white."""
    lenses = lens_numbers(capture.camera)
    brightest = ndimage.maximum(paper, lenses, np.arange(lenses.max() + 1))[lenses]
    plane = reconstruct(
        capture,
        distance,
        method="deconvolved",
        response="wave",
        oversample=FINE,
        iterations=STEPS,
        variation=VARIATION,
        white=np.where(paper > _RIM * brightest, paper, 0),
    )
    return np.asarray(plane.image / np.quantile(paper, 0.9), np.float32)


def _quality(name: str, shape: Shape, recording: Recording, paper: Floats, image: Floats, wavelength: float) -> Named:
    """Return what is left of the lenses' grid, what is unexplained, and the width of an edge, in a shape's plane."""
    row = {"shape": name, "distance": shape.distance}
    camera = recording.camera
    if "even" in shape.areas:
        row["grid"] = grid(image[shape.window("even", FINE)])
        with Response(camera, [shape.distance], wavelength=wavelength, oversample=FINE) as response:
            flat = flat_field(response, paper)
            radiance = np.nan_to_num(image) * np.float32(np.quantile(paper, 0.9))
            model = flat * response.forward(response.from_image(radiance, 0))
        recorded = np.where(flat > 0, recording.light, 0)
        even = shape.pixels(camera, "even")
        row["unexplained"] = float(np.linalg.norm((recorded - model)[even]) / np.linalg.norm(recorded[even]))
        row["left_out"] = float((flat == 0).mean())
    if "edge" in shape.areas:
        with naming(f"{name}: edge = {shape.areas['edge']}"):
            edge = window_sharpness(image[shape.window("edge", FINE)].astype(np.float64))
        row["width_mm"] = float(edge.width * camera.bin_size(shape.distance) / FINE)
    return row


def grid(image: Floats, oversample: int = FINE) -> float:
    """Return the deviation of what repeats in all lenses of an area, over its mean, without slow changes and noise."""
    down, across = (size // oversample for size in image.shape)
    area = image[: down * oversample, : across * oversample].astype(np.float64)
    y, x = (values / max(area.shape) for values in np.indices(area.shape))
    terms = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=-1).reshape(area.size, -1)
    slow = (terms @ np.linalg.lstsq(terms, area.ravel())[0]).reshape(area.shape)
    lenses = view_as_blocks(area - slow, (oversample, oversample)).reshape(down * across, -1)
    return math.sqrt(max(lenses.mean(0).var() - lenses.var(0).mean() / len(lenses), 0)) / float(area.mean())


def _control(
    real: Recording, planes: Mapping[str, Floats], store: Cache, wavelength: float, counts: float
) -> Recording:
    """Return what the camera records, by waves, of the planes that were found in a real light field, with its noise."""
    mi.set_variant("llvm_ad_mono")
    T = mi.ScalarTransform4f()
    sheets, textures = {}, []
    for name, image in planes.items():
        shape = real.shapes[name]
        area, values = _sheet(shape, [other for other in real.shapes.values() if other is not shape], image)
        low, high = _box(real.camera, shape.distance, area)
        middle, half = (low + high) / 2, abs(high - low) / 2
        textures.append(values)
        # The first row of a texture is at the bottom of a rectangle that faces the camera.
        texture = mi.Bitmap(np.ascontiguousarray(values[::-1, :, None], np.float32))
        sheets[name] = {
            "type": "rectangle",
            "to_world": T.translate(middle.tolist()).rotate([0, 1, 0], 180).scale([half[0], half[1], 1]),
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
            "emitter": {"type": "area", "radiance": {"type": "bitmap", "bitmap": texture, "raw": True}},
        }
    level = float(np.quantile(real.white, 0.9))
    pictures: list[Floats] = []
    for name, content in (("light", sheets), ("white", {"sky": {"type": "constant"}})):
        scene = {"type": "scene", "integrator": {"type": "direct"}, "camera": real.camera.to_sensor(), **content}

        def make(progress: Any, checkpoint: Any, scene: Any = scene) -> Capture:
            return render_capture(
                mi.load_dict(scene, parallel=False),
                model="wave",
                wavelength=wavelength,
                spp=16,
                progress=progress,
                checkpoint=checkpoint,
            )

        inputs = {"planes": digest(*textures), "camera": real.camera.to_dict(), "wavelength": wavelength}
        capture, _ = store.capture(name, inputs, make)
        light = level * np.atleast_3d(capture.image)[..., 0]
        random = np.random.default_rng(len(pictures))
        pictures.append((random.poisson(light.clip(0) * counts) / counts).astype(np.float32))
    return replace(real, light=pictures[0], white=pictures[1])


def _sheet(shape: Shape, others: Sequence[Shape], image: Floats) -> tuple[Numbers, Floats]:
    """Return the area in bins, and the radiance, of a shape's sheet, which reaches the other regions or the borders.

    The shape's edge is a sharp one, so that its width in the control is that of the camera and the method.
    """
    # Light comes from beyond the picture, too.
    rows, columns = (size // FINE for size in image.shape)
    low, high = np.array([-_BEYOND] * 2), np.array([columns, rows]) + _BEYOND
    start, size = np.split(np.array(shape.areas["region"]), 2)
    for neighbour in others:
        first, width = np.split(np.array(neighbour.areas["region"]), 2)
        gaps = np.stack([start - first - width, first - start - size])
        side, axis = np.unravel_index(gaps.argmax(), gaps.shape)
        if side == 0:
            low[axis] = max(low[axis], first[axis] + width[axis])
        else:
            high[axis] = min(high[axis], first[axis])
    unknown = ~np.isfinite(image)
    nearest = ndimage.distance_transform_edt(unknown, return_distances=False, return_indices=True)
    values = image[tuple(nearest)].clip(0).repeat(_FINER, 0).repeat(_FINER, 1)
    if "edge" in shape.areas:
        edge = window_sharpness(image[shape.window("edge", FINE)].astype(np.float64))
        finer = shape.window("edge", FINE * _FINER)
        part = values[finer]
        y, x = (np.indices(part.shape) + 0.5) / _FINER - 0.5
        across = x - edge.column - math.tan(math.radians(edge.angle)) * (y - edge.row)
        left, right = (np.median(part[side * across > edge.width / 2]) for side in (-1, 1))
        values[finer] = np.where(across < 0, left, right)
    padding = round(_BEYOND * FINE * _FINER)
    values = np.pad(values, padding, "edge")
    left, top, right, bottom = (round(FINE * _FINER * (value + _BEYOND)) for value in (*low, *high))
    return (*low, *(high - low)), values[top:bottom, left:right]


@plots.styled
def draw(path: Path, camera: PlenopticCamera, pictures: Mapping[tuple[str, float], Floats]) -> None:
    """Draw a light field refocused to each distance by each method: the paper's figure 4."""
    distances = list(dict.fromkeys(distance for _, distance in pictures))
    columns, rows = camera.bin_count
    plot = plots.Plot(10.6)
    half = (len(TITLES) + 1) // 2
    panels = plot.panels(2 * len(distances), half, rows / columns)
    peak = float(np.nanquantile(pictures["ray", distances[0]], 0.98))
    for across, (name, title) in enumerate(TITLES.items()):
        for down, distance in enumerate(distances):
            axes = panels[2 * (across // half) + down, across % half]
            plots.show(axes, np.nan_to_num(pictures[name, distance]), "", peak=peak)
            plots.annotate(axes, title=f"{title}, {distance:g} mm", size=8)
    plot.save(path)


def _page(output: Path, judged: Mapping[str, Judged], placed: Facts, command: str) -> None:
    """Write the report."""
    titles = {"real": "Real light", "control": "Control: the same planes, simulated"}
    sections = []
    for name, title in titles.items():
        caption = f"{title}, refocused and divided by white. The paper's figure 4 by all methods."
        sections.append(pages.Section(title, pages.pictures_in(output, {f"{name}.png": caption})))
    verdicts = [
        {"statement": real.statement, "real": real.verdict, "control": control.verdict}
        for real, control in zip(judged["real"].claims, judged["control"].claims, strict=True)
    ]
    columns = {"Statement": "{statement}", "Real light": "{real}", "Control": "{control}"}
    sections.append(pages.Section("Verdicts", [pages.Table(columns, verdicts, words=3)]))
    quality = [
        row | {"light": titles[name], "width": f"{row['width_mm']:.3g} mm" if "width_mm" in row else ""}
        for name, one in judged.items()
        for row in one.quality
    ]
    table = pages.Table(
        {
            "Light": "{light}",
            "Shape": "{shape} at {distance:g} mm",
            "Grid of lenses": "{grid:.2%}",
            "Unexplained": "{unexplained:.2%}",
            "Pixels left out": "{left_out:.1%}",
            "Edge, 10 to 90 %": "{width}",
        },
        quality,
        "Deconvolved planes. Grid and unexplained light are those of even areas.",
        words=2,
    )
    moved = "{:.2f} and {:.2f}".format(*placed["moved"])
    stray = "over the whole picture" if placed["stray_width"] is None else f"over {1e3 * placed['stray_width']:.0f} um"
    limits = (
        f"Between white picture and light field micro-images moved by {moved} pixels along x and y; camera and white "
        f"were moved with them. Stray light is spread {stray}. Pixels at which white is far from the camera's, dust "
        "and defective ones, are left out. Printed letters are no points of light at two distances alone: ink is "
        "grey, and paper has a texture. The control is made of the planes that deconvolution found."
    )
    sections += [
        pages.Section("Deconvolution", [table]),
        claims_section(judged["real"].claims, judged["real"].measured),
        pages.Section("Limits", [limits]),
        pages.Section("Make it again", [f"{command} -o {output.name}"]),
    ]
    confirmed = sum(claim.verdict == "confirmed" for claim in judged["real"].claims)
    lead = (
        f"Real light, refocused by rays and by waves. Of {len(judged['real'].claims)} statements of the paper "
        f"{confirmed} are confirmed on it."
    )
    pages.Page("The paper's experiment on real light", lead, sections).write(output / "report.html")
