"""Parameter sweeps: captures and reconstructions over a grid of cameras, wavelengths and distances in one dataset."""

import contextlib
import itertools
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ...camera import MATCHED, PARAMETERS, PlenopticCamera, varied_camera
from ...capture_spec import CaptureSpec
from ...errors import InputError, argument, did_you_mean, refuse_if, require_module, require_number, require_wavelength
from ...io import Cache, Capture, Checkpoint, StageOptions
from ...prescription import lens_data
from ...refocus import registered
from ...report import refocused
from ...runtime import (
    Array,
    BatchMap,
    Facts,
    Numbers,
    Progress,
    Sink,
    Sizes,
    atomic_output,
    read_yaml,
    remove_leftovers,
    require_writable,
    software,
)
from ...scene import check_scene_file, is_wave_capture, names_in, plenoptic_sensor, refuse_by_rays, scene_defaults
from ...scene_files import scene_path

__all__ = ["sweep"]

# Names that are not parameters of the scene.
WAVELENGTH = "wavelength"
DISTANCE = "distance"

Grid = Mapping[str, Sequence[float]]


def stated_grid(path: Path | None, texts: Iterable[str]) -> dict[str, list]:
    """Return the grid that a YAML file, if any, and texts such as ``name=1,2,3`` state."""
    content = {} if path is None else read_yaml(path)
    refuse_if(
        not isinstance(content, dict),
        f"{path}: it must hold names, each with a list of numbers, such as 'wavelength: [532, 633]'",
    )
    grid = {name: value if isinstance(value, list) else [value] for name, value in content.items()}
    for text in texts:
        name, _, values = text.partition("=")
        refuse_if(name in grid, f"grid: {name} is given twice")
        grid[name] = [value.strip() for value in values.split(",")] if values.strip() else []
    return grid


def check_grid(grid: Mapping) -> dict[str, Numbers]:
    """Return a grid of finite values without repetitions; refuse grids that are empty or too large."""
    checked = {}
    for name, values in grid.items():
        refuse_if(not isinstance(name, str) or not name.isidentifier(), f"grid: {name!r} is not a name")
        refuse_if(not len(values), f"grid: {name} has no values")
        checked[name] = tuple(_number(name, value) for value in values)
        for value, count in Counter(checked[name]).items():
            refuse_if(count > 1, f"grid: {name} = {value:g} is given twice")
    refuse_if(not checked, "grid: it is empty; give at least one name with values")
    count = math.prod(len(values) for values in checked.values())
    refuse_if(count > 100_000, f"grid: it has {count} points; at most 100000 are allowed")
    return checked


def _number(name: str, value: Any) -> float:
    refuse_if(
        isinstance(value, (list, tuple, dict)), f"grid: {name} holds a {type(value).__name__}: it must be a number"
    )
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = float(value)
    return require_number(f"grid: {name}", value)


class Points:
    """The points of a grid, each with a capture and its reconstructions."""

    def __init__(self, spec: CaptureSpec, grid: Grid, method: str, store: Cache):
        self._spec = spec
        self._method = method
        self._store = store
        # What the scene's sensor states, by the scene's parameters.
        self._of_sensor: dict[str, Facts] = {}
        # Rows and columns, and of bins, of the largest images.
        self.largest: Sizes = ()
        # Of the capture of each point, and of its reconstructions.
        self._work: list[float] = []
        self.distances = grid.get(DISTANCE, ())
        self.axes = {name: values for name, values in grid.items() if name != DISTANCE}
        scene = Path(spec.scene)
        roots = check_scene_file(scene if scene.is_file() else scene_path(spec.scene), spec.parameters)
        of_scene = set[str]().union(*map(names_in, [element for root in roots for element in root.iter()]))
        of_cameras = (*PARAMETERS, *MATCHED)
        # The scene's own parameters come first, unless another camera takes the place of its camera.
        self.of_camera = [name for name in self.axes if name in of_cameras and (spec.camera or name not in of_scene)]
        for name in self.axes:
            # Mitsuba also replaces what longer names begin with.
            if name not in (WAVELENGTH, *self.of_camera) and not any(
                parameter.startswith(name) for parameter in of_scene
            ):
                similar = did_you_mean(name, (*scene_defaults(roots), *of_cameras, WAVELENGTH, DISTANCE))
                raise InputError(f"parameter {name}: the scene {spec.scene} has none of that name{similar}")
            refuse_if(
                name in OWN_NAMES and name not in self.of_camera,
                f"grid: {name}: the dataset has a variable or dimension of this name; rename it in the scene",
            )

    def __iter__(self) -> Iterator[dict[str, float]]:
        for values in itertools.product(*self.axes.values()):
            yield dict(zip(self.axes, values, strict=True))

    def spec(self, point: dict[str, float]) -> CaptureSpec:
        """Return the specification of the capture at a grid point."""
        others = (WAVELENGTH, *self.of_camera)
        varied = {name: _text(value) for name, value in point.items() if name not in others}
        for name in varied:
            refuse_if(name in self._spec.parameters, f"grid: {name} varies and is set by {argument('parameters')} too")
        spec = replace(self._spec, parameters={**self._spec.parameters, **varied}, wavelength=point.get(WAVELENGTH))
        if spec.camera is None and not self.of_camera:
            return spec
        stated = spec.camera
        key = repr(spec.parameters)
        if stated is None:
            if key not in self._of_sensor:
                self._of_sensor[key] = plenoptic_sensor(spec.load()).stated
            stated = self._of_sensor[key]
        camera = varied_camera(stated, {name: _whole(point[name]) for name in self.of_camera})
        return replace(spec, camera=camera.to_dict())

    def check(self, **for_waves: Any) -> None:
        """Construct every camera once before the work starts, and find the largest images.

        `for_waves` are options that ray captures refuse; None means not given.
        """
        for wavelength in self.axes.get(WAVELENGTH, ()):
            require_wavelength(wavelength)
        method = registered(self._method)
        # Approximate microseconds of a pixel of an image, and of a sample of one.
        of_image = 15.0 if method.long else 1.0 if method.waves else 0.3
        sizes = {}
        for point in self:
            spec = self.spec(point)
            if (key := repr((spec.parameters, spec.camera))) not in sizes:
                scene = spec.load()
                by_waves = is_wave_capture(scene, spec.model)
                if not by_waves:
                    refuse_by_rays(resume=self._store.resume or None, **for_waves)
                sensor = scene.sensors()[0]
                camera = PlenopticCamera.from_sensor(sensor)
                samples = spec.spp or sensor.sampler().sample_count()
                sizes[key] = camera.shape + (camera.bin_count if self.distances else ())
                for distance in self.distances:
                    lens_data.image_distance(camera.focal_length, distance, name=DISTANCE)
            pixels = float(math.prod(sizes[key][:2]))
            # Diffraction is planned first, and before the first image there is the white one, of a second each.
            capture = (1.0 if by_waves else 0.6) * samples * pixels + 1e6 * by_waves
            images = [of_image * pixels + 1e6 * by_waves * (not index) for index in range(len(self.distances))]
            self._work += [capture, *images]
        self.largest = tuple(map(max, zip(*sizes.values(), strict=True)))

    def compute(self, batch_map: BatchMap | None) -> Iterator[tuple[Capture, list[Array]]]:
        """Yield each capture with its reconstructions, read from the store if they exist there."""
        method = {"method": self._method}
        self._store.expect(self._work)
        for point in self:
            capture, key = self._capture(point, batch_map)
            name = f"refocused{_name(point)}"
            yield capture, [refocused(self._store, name, capture, key, [at], method)[at] for at in self.distances]

    def _capture(self, point: dict[str, float], batch_map: BatchMap | None) -> tuple[Capture, str]:
        spec = self.spec(point)

        def make(progress: Progress, checkpoint: Checkpoint) -> Capture:
            scene = spec.load()
            keeper = checkpoint if is_wave_capture(scene, spec.model) else None
            return spec.render(scene, progress=progress, checkpoint=keeper, batch_map=batch_map)

        return self._store.capture(f"capture{_name(point)}", spec.fingerprint(), make)


def _name(point: dict[str, float]) -> str:
    return "".join(f",{name}={_text(value)}" for name, value in point.items())


def _whole(value: float) -> float:
    """Return a whole number as an int, as counts must be."""
    return int(value) if value == int(value) else value


def _text(value: float) -> str:
    return repr(_whole(value))


_UNITS = {WAVELENGTH: "nm", DISTANCE: "mm", "pixel_size": "mm", "sensor_size": "mm"} | {
    name: entry.unit for name, entry in PARAMETERS.items() if entry.unit and isinstance(entry.unit, str)
}

_DIMENSIONS = ("row", "column", "channel", "bin_row", "bin_column")
OWN_NAMES = ("capture", "reconstruction", "pixel_size", "bin_size", *_DIMENSIONS)
"""Names of the dataset's variables and dimensions besides the grid."""


class SweepFile:
    """The dataset of a sweep in a file, written image by image.

    Its images are as large as the largest; what smaller ones leave of them is not a number.
    """

    def __init__(self, file: Any, spec: CaptureSpec, grid: Grid, method: str, first: Capture, largest: Sizes):
        self.variables = file.variables
        self._grid = grid
        axes = [name for name in grid if name != DISTANCE]
        self.shape = tuple(len(grid[name]) for name in axes)
        sizes = {name: len(values) for name, values in grid.items()}
        sizes |= zip(("row", "column", "bin_column", "bin_row"), largest, strict=False)
        channels = ("channel",) if first.image.ndim == 3 else ()
        file.dimensions = sizes | dict.fromkeys(channels, 3)
        for name, values in grid.items():
            variable = file.create_variable(name, (name,), data=np.array(values))
            variable.attrs.update({"units": _UNITS[name]} if name in _UNITS else {})

        def add(name: str, dimensions: tuple[str, ...], facts: dict[str, str], image: bool = True) -> None:
            shape = [file.dimensions[d].size for d in dimensions]
            # One image to a chunk, as they are written and read.
            chunks = [1 if d in grid else size for d, size in zip(dimensions, shape, strict=True)]
            storage = (
                {"chunks": tuple(chunks), "compression": "gzip", "shuffle": True, "fillvalue": np.nan} if image else {}
            )
            kind = "f4" if image else "f8"
            file.create_variable(name, dimensions, kind, **storage).attrs.update(facts)

        radiance = {"units": "1", "long_name": "mean radiance over the lens"}
        add("capture", (*axes, "row", "column", *channels), {**radiance, "coordinates": "pixel_size"})
        # Where it varies, it is an axis.
        if "pixel_size" not in grid:
            add("pixel_size", tuple(axes), {"units": "mm", "long_name": "width of a pixel"}, image=False)
        if DISTANCE in grid:
            over = (*axes, DISTANCE)
            add("reconstruction", (*over, "bin_row", "bin_column", *channels), {**radiance, "coordinates": "bin_size"})
            add("bin_size", over, {"units": "mm", "long_name": "width of a bin in the object plane"}, image=False)
        file.attrs.update(
            {
                "title": f"Sweep of the scene {Path(spec.scene).stem}",
                "model": first.model,
                "settings": json.dumps({**asdict(spec), "method": method}, sort_keys=True),
                "software": json.dumps(software(), sort_keys=True),
            }
        )

    def put(self, index: tuple, capture: Capture, images: list[Array]) -> None:
        """Write one capture with its reconstructions into the file."""
        # A grid of distances alone has one capture, without an axis.
        at = tuple(map(int, index))
        rows, columns = capture.image.shape[:2]
        self.variables["capture"][(*at, slice(rows), slice(columns), ...)] = capture.image
        if "pixel_size" not in self._grid:
            self.variables["pixel_size"][at] = capture.camera.pixel_size
        for plane, (distance, image) in enumerate(zip(self._grid.get(DISTANCE, ()), images, strict=True)):
            rows, columns = image.shape[:2]
            self.variables["reconstruction"][(*at, plane, slice(rows), slice(columns), ...)] = image
            self.variables["bin_size"][(*at, plane)] = capture.camera.bin_size(distance)


def sweep(
    spec: CaptureSpec,
    grid: Grid,
    output: Path,
    *,
    method: str = "ray",
    batch_map: BatchMap | None = None,
    stages: StageOptions | None = None,
) -> xr.Dataset:
    """Return the dataset of captures, and of reconstructions at given distances, at every point of a grid.

    Each point is stored in a folder next to the output, ``out.points`` for ``out.nc``: a sweep that was stopped, or
    whose grid has grown, computes only what is missing. The dataset is written point by point, so that memory does
    not grow with the grid.

    Parameters
    ----------
    spec : CaptureSpec
        What does not vary.
    grid : mapping of names to numbers
        The settings that vary: parameters of the scene; parameters of the camera and, of a camera whose micro-images
        touch, arguments of `PlenopticCamera.matched`, in place of what the specification or the scene states, from
        which the camera follows anew; ``wavelength`` of wave captures in nanometres; ``distance``, to which each
        capture is refocused.
    output : path
        NetCDF-4 file to write, which ends in ``.nc``.
    method : str
        Method of the reconstructions.
    batch_map : callable, optional
        For wave captures: computes the sums, for example `Cluster`.
    stages : StageOptions, optional
        Report of progress, and treatment of checkpoints.

    Returns
    -------
    xarray.Dataset
        The file, opened: ``capture`` over the grid, ``row`` and ``column`` (and ``channel``), with the coordinate
        ``pixel_size``; and, where distances are given, ``reconstruction`` over the grid, ``distance``, ``bin_row`` and
        ``bin_column``, with ``bin_size``. Images are in units of radiance; beyond smaller images than the largest they
        are NaN.
    """
    return prepare(spec, grid, output, method, stages, batch_map=batch_map)(batch_map)


def prepare(
    spec: CaptureSpec, grid: Grid, output: Path, method: str, stages: StageOptions | None, **for_waves: Any
) -> Callable[[BatchMap | None], xr.Dataset]:
    """Check a sweep before workers start, and return the function that computes it on workers.

    `for_waves` are options, by name, that ray captures refuse; None means not given.
    """
    h5netcdf = require_module("h5netcdf", "sweep: datasets need h5netcdf: pip install h5netcdf h5py")
    output = require_writable(output, ".nc")
    grid = check_grid(grid)
    store = Cache(output.with_suffix(".points"), replace(stages or StageOptions(), number=itertools.count(1)))
    points = Points(spec, grid, method, store)
    points.check(**for_waves)

    def compute(batch_map: BatchMap | None) -> xr.Dataset:
        remove_leftovers(output)
        with atomic_output(output) as temporary, Sink(temporary, "w+") as sink:
            with h5netcdf.File(sink, "w") as file:
                for index, (capture, images) in enumerate(points.compute(batch_map)):
                    if not index:
                        sweep_file = SweepFile(file, spec, grid, method, capture, points.largest)
                    sweep_file.put(np.unravel_index(index, sweep_file.shape), capture, images)
                    sink.check(output)
            sink.check(output)
        return xr.open_dataset(output, engine="h5netcdf")

    return compute
