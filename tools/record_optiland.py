"""Record what Optiland, another ray tracer, makes of lenses, so that the tests need no Optiland.

    python tools/record_optiland.py

It needs Optiland, the extra `lenses`, and writes `tests/optiland_records` again: `results.json` has the paraxial
numbers and the rays of the lenses below; `spots.json` the rays of scene points on the detector of an ordinary camera
and which of them pass the lens; `stand_in` is a package that the tests import in Optiland's place, with the
catalogue entries and the indices of the glasses below.
"""

from __future__ import annotations

import csv
import json
import math
import shutil
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic.prescription import bundled_prescription, paraxial

RECORDS = Path(__file__).resolve().parent.parent / "tests" / "optiland_records"

SAMPLES = {
    "double_gauss": ("DoubleGauss", 1.0, 14.0),
    "cooke_triplet": ("CookeTriplet", 1.0, 20.0),
    "tessar": ("TessarLens", 25.4, 20.5),
}
"""Optiland's samples of the bundled lenses, by how much ours are larger, and the field in degrees."""

FILES = {"cooke_triplet.zmx": (1.0, 20.0), "double_gauss.seq": (1.0, 14.0), "asphere.zmx": (25.4, 3.0)}
"""Lens files among the records, with the millimetres in their unit, which Optiland leaves aside, and the field."""

SPOTS = {"double_gauss": 14.0, "double_gauss_f2": 22.0, "phone": 31.0, "singlet": 5.0}
"""Bundled lenses before the detector of an ordinary camera, and the outermost of three points in degrees.

Farther out than 32 degrees Optiland 0.6.3 meets the phone lens's tenth surface behind the filter, beyond its edge.
"""

FOCUS, ACROSS, WIDER = 1000.0, 9, 1.15
"""Distance in mm of the points before the front principal plane, rays across the pupil, their extent over its own."""

GLASSES = (
    "BK7", "E-SF5", "F2", "F5", "J-SF5", "N-BK7", "N-SF5", "N-SK16", "N-SK2", "N-SSK2", "S-LAH53", "SF5", "SK16",
)  # fmt: skip
"""Names of glasses, which are recorded of every maker's catalogue that has one."""

CRYSTALS = ("main/CaF2/Malitson.yml",)
"""Files of other materials."""

WAVELENGTHS = (486.1327, 587.5618, 656.2725)
"""In nanometres, for the bundled lenses; of files their own."""

RAYS, FIELDS = 20, 5


def sample(name: str) -> tuple[Any, float]:
    """Return Optiland's lens and the scale of ours."""
    from optiland.samples import objectives

    kind, scale, _ = SAMPLES[name]
    return getattr(objectives, kind)(), scale


def image_distance(optic: Any, scale: float) -> float:
    """Return the distance of Optiland's image plane from the last vertex, in our millimetres."""
    positions = np.ravel(optic.surfaces.positions)
    return float(positions[-1] - positions[-2]) * scale


def bundles(pupil: float, radius: float, field: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return places (2, n) in the plane of the first vertex, and slopes, of rays through 0.7 of an entrance pupil."""
    random = np.random.default_rng(seed)
    slopes = np.zeros((2, FIELDS, RAYS))
    slopes[1] = np.linspace(0, math.tan(math.radians(field)), FIELDS)[:, None]
    r, angle = 0.7 * radius * np.sqrt(random.random((FIELDS, RAYS))), random.uniform(0, 2 * np.pi, (FIELDS, RAYS))
    places = np.stack([r * np.cos(angle), r * np.sin(angle)]) - pupil * slopes
    return places.reshape(2, -1), slopes.reshape(2, -1)


def results(optic: Any, scale: float, rays: tuple[np.ndarray, np.ndarray], wavelengths: tuple[float, ...]) -> Any:
    """Return numbers of a lens, where its rays meet the image plane, and their paths; in millimetres, as plain data."""
    from optiland.rays import RealRays

    places, slopes = rays
    N = 1 / np.sqrt(1 + np.sum(slopes**2, axis=0))
    ones = np.ones_like(N)
    traced = {}
    for wavelength in wavelengths:
        x, y = (places - 30 * slopes) / scale
        start = RealRays(x, y, -30 / scale * ones, slopes[0] * N, slopes[1] * N, N, ones, wavelength * 1e-3 * ones)
        found = optic.surfaces.trace(start, skip=1)
        traced[f"{wavelength:.10g}"] = {"image": _plain([found.x, found.y], scale), "paths": _plain(found.opd, scale)}
    parts = optic.paraxial
    return {
        "wavelength": float(optic.primary_wavelength) * 1e3,
        "surfaces": optic.surfaces.num_surfaces - 2,
        "image_distance": _plain(image_distance(optic, scale)),
        "focal_length": _plain(parts.f2(), scale),
        "entrance_pupil": _plain(parts.EPL(), scale),
        "exit_pupil": _plain(parts.XPL(), scale),
        "entrance_diameter": _plain(parts.EPD(), scale),
        "exit_diameter": _plain(parts.XPD(), scale),
        "f_number": _plain(parts.FNO()),
        "places": _plain(places),
        "slopes": _plain(slopes),
        "rays": traced,
    }


def _plain(values: Any, scale: float = 1.0) -> Any:
    """Return a number or lists of numbers for JSON, to twelve digits."""
    found = np.squeeze(np.asarray(values, float)) * scale
    return float(f"{found:.12g}") if found.ndim == 0 else [_plain(value) for value in found]


def sample_results(name: str) -> Any:
    """Return the results for a bundled lens, by rays through the pupil of ours."""
    optic, scale = sample(name)
    numbers = paraxial(bundled_prescription(name))
    rays = bundles(numbers.entrance_pupil, numbers.entrance_radius, SAMPLES[name][2])
    return results(optic, scale, rays, WAVELENGTHS)


def rebuilt(name: str) -> Any:
    """Return a bundled lens as Optiland's, with edges, and the distance of the detector behind its last vertex."""
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic
    from optiland.physical_apertures import RadialAperture

    lens = bundled_prescription(name)
    numbers, optic = paraxial(lens), Optic()
    detector = numbers.focal_length * FOCUS / (FOCUS - numbers.focal_length) + numbers.rear_principal
    optic.surfaces.add(index=0, radius=math.inf, thickness=FOCUS - numbers.front_principal)
    for number, (surface, index) in enumerate(zip(lens.surfaces, lens.indices(lens.wavelength), strict=True)):
        last = number == len(lens.surfaces) - 1
        form = {"surface_type": "even_asphere", "coefficients": [0.0, *surface.asphere], "tol": 1e-12}
        optic.surfaces.add(
            index=number + 1,
            radius=surface.radius,
            conic=surface.conic,
            thickness=detector if last else surface.thickness,
            material=IdealMaterial(index),
            is_stop=number == lens.stop,
            aperture=RadialAperture(surface.semi_aperture),
            **(form if surface.asphere else {}),
        )
    optic.surfaces.add(index=len(lens.surfaces) + 1)
    return optic, detector


def spot_results(name: str) -> Any:
    """Return where rays of three points meet the detector, and which pass; lengths in mm from the first vertex."""
    from optiland.rays import RealRays

    lens, (optic, detector) = bundled_prescription(name), rebuilt(name)
    numbers = paraxial(lens)
    axis = np.linspace(-WIDER, WIDER, ACROSS) * numbers.entrance_radius
    X, Y = (values[np.hypot(*grid) <= axis[-1]] for grid in [np.meshgrid(axis, axis)] for values in grid)
    distance, points = FOCUS - numbers.front_principal, []
    for angle in np.radians(SPOTS[name]) * np.array([0, 0.7, 1]):
        height = -math.tan(angle) * (distance + numbers.entrance_pupil)
        towards = np.array([X, Y - height, 0 * X + distance + numbers.entrance_pupil])
        L, M, N = towards / np.linalg.norm(towards, axis=0)
        ones = np.ones_like(X)
        start = RealRays(0 * X, height * ones, -distance * ones, L, M, N, ones, lens.wavelength * 1e-3 * ones)
        found = optic.surfaces.trace(start, skip=1)
        is_open = np.isfinite(found.x) & (found.i > 0)
        image, slopes = (
            np.where(is_open, pair, 0.0) for pair in ([found.x, found.y], [found.L / found.N, found.M / found.N])
        )
        points.append(
            {
                "height": _plain(height),
                "towards": _plain([L / N, M / N]),
                "open": is_open.tolist(),
                "image": _plain(image),
                "slopes": _plain(slopes),
            }
        )
    return {"focus": FOCUS, "detector": _plain(detector), "points": points}


def file_results(name: str) -> Any:
    """Return the results for a lens file, by rays through the pupil that it states, and its indices."""
    from optiland import fileio

    read = {".zmx": fileio.load_zemax_file, ".seq": fileio.load_codev_file}[Path(name).suffix]
    optic, (scale, field) = read(str(RECORDS / name)), FILES[name]
    wavelengths = tuple(round(float(one.value) * 1e3, 6) for one in optic.wavelengths.wavelengths)
    pupil = float(np.ravel(optic.paraxial.EPL())[0]) * scale, float(np.ravel(optic.paraxial.EPD())[0]) / 2 * scale
    lens = [optic.surfaces[number] for number in range(1, optic.surfaces.num_surfaces - 1)]
    for surface in lens:
        # Aspheres read from files are met to 1e-6 of the unit only, which would be 0.03 waves of path.
        if hasattr(surface.geometry, "tol"):
            surface.geometry.tol = 1e-12
    found = results(optic, scale, bundles(*pupil, field), wavelengths)
    found["indices"] = {
        f"{one:.10g}": [_plain(surface.material_post.n(one * 1e-3)) for surface in lens] for one in wavelengths
    }
    return found


def _is_recorded(file: str, name: str) -> bool:
    """Whether the stand-in has an entry of the catalogue."""
    return (file.startswith("glass/") and name in GLASSES) or file in CRYSTALS


def write_stand_in(folder: Path) -> None:
    """Write the glasses' catalogue entries as they are, and their indices at the wavelengths of our tables."""
    from optiland.materials import MaterialFile

    original = resources.files("optiland.database")
    with (original / "catalog_nk.csv").open(encoding="utf-8") as file:
        reader = csv.DictReader(file)
        rows = [row for row in reader if _is_recorded(row["filename"], row["filename_no_ext"])]
    shutil.rmtree(folder / "data-nk", ignore_errors=True)
    with (folder / "catalog_nk.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, reader.fieldnames or (), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    for name in {row["filename"] for row in rows}:
        material = MaterialFile(str(original / "data-nk" / name))
        row = next(row for row in rows if row["filename"] == name)
        low, high = 1e3 * float(row["min_wavelength"]), 1e3 * float(row["max_wavelength"])
        table = {f"{one:.10g}": _plain(material.n(one * 1e-3)) for one in range(380, 1001, 10) if low <= one <= high}
        path = folder / "data-nk" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(table) + "\n")


def write(name: str, lenses: dict[str, Any]) -> None:
    """Write the results for lenses by name, a line for each lens."""
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(found)}" for name, found in lenses.items())
    text = f'{{\n "optiland": "{version("optiland")}",\n "lenses": {{\n{lines}\n }}\n}}\n'
    (RECORDS / name).write_text(text)


def main() -> None:
    """Write all records."""
    lenses = {name: sample_results(name) for name in SAMPLES} | {name: file_results(name) for name in FILES}
    write("results.json", lenses)
    write("spots.json", {name: spot_results(name) for name in SPOTS})
    write_stand_in(RECORDS / "stand_in" / "optiland" / "database")


if __name__ == "__main__":
    main()
