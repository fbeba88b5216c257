"""Results: images refocused to one distance, as OpenEXR files, and volumes, as TIFF or Zarr files."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile

from ..camera import PlenopticCamera
from ..choices import VOLUMES
from ..errors import NO_RECORD, InputError, naming, refuse_if, refusing, require_choice, require_number, short_repr
from ..extension import Displayed, Shown
from ..io import read_exr, write_exr, write_labelled_data
from ..runtime import Array, Floats, Named, Numbers, atomic_output, require_memory, require_writable, require_zarr

if TYPE_CHECKING:
    import xarray as xr

_ALONG = {"z": 0, "y": 1, "x": 2}


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction(Displayed):
    """An image refocused to one object distance.

    Attributes
    ----------
    image : (rows, columns[, channels]) float32 array
        Upright, in units of the capture; by default one bin per microlens of the full detector. It lines up with the
        image of Mitsuba's ``thinlens`` focused at `distance`. NaN where no light can come from.
    distance : float
        Object distance in scene units; may be infinite.
    bin_size : float
        Width of a bin in the object plane, in scene units; at infinity its slope, the width at a distance of 1.
    method : str
        Name of the method.
    options : dict
        The method's options.
    camera : PlenopticCamera
        The camera of the capture.
    guards : dict
        Fractions of the light that the guards of the physics found lost, by their names.
    facts : dict
        The ``model`` of the capture's light and, but for objectives, whether the distance is ``in_range`` of refocusing
        and the ``samples_per_lens`` resolved there (see `design.refocus_range`, `design.effective_resolution`). Of
        ``deconvolved`` also: the ``iterations`` made, the ``residual`` (root mean square of the unexplained part of
        the capture, over that of the capture), whether it was ``stopped_by_noise``, the
        ``resolution_limit`` in line pairs per scene unit (at infinity per unit of slope), and whether the plane is
        ``in_focus``, where finer bins show little more (see `design.resolution_limit`).
    """

    image: Array
    distance: float
    bin_size: float
    method: str
    camera: PlenopticCamera
    options: Named = field(default_factory=dict)
    guards: dict[str, float] = field(default_factory=dict)
    facts: Named = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return a description of the reconstruction in one line."""
        rows, columns = self.image.shape[:2]
        return f"Reconstruction({columns} x {rows} bins at {self.distance:g} mm by {self.method})"


class Reconstructions(Shown, list[Reconstruction]):
    """List of reconstructions of one capture, which notebooks show as pictures on one scale."""


def write_reconstruction(path: str | Path, result: Reconstruction, source: Named | None = None) -> None:
    """Write a reconstruction as float32 OpenEXR with camera, distance and method in the header.

    Parameters
    ----------
    path : path
        File to write.
    result : Reconstruction
        The reconstruction.
    source : dict, optional
        Metadata of the capture, which are written to the header.
    """
    write_exr(path, result.image, header_of(result, source or {}))


def header_of(result: Reconstruction, source: Named) -> Named:
    """Return what the header of a reconstruction's file holds, with the metadata of the capture."""
    return {
        "kind": "reconstruction",
        "camera": result.camera.to_dict(),
        "distance": result.distance,
        "bin_size": result.bin_size,
        "method": result.method,
        "options": result.options,
        "guards": result.guards,
        "facts": result.facts,
        "source": source,
    }


def read_reconstruction(path: str | Path) -> Reconstruction:
    """Return the reconstruction in a file of `write_reconstruction`.

    Parameters
    ----------
    path : path
        The file.
    """
    image, _, about = read_exr(path)
    with naming(path):
        refuse_if(
            about.get("kind") != "reconstruction", f"it holds a {short_repr(about.get('kind'))}, not a reconstruction"
        )
        with refusing("its header is not that of a reconstruction:", *NO_RECORD):
            camera = PlenopticCamera.from_dict(about["camera"])
            return Reconstruction(
                image,
                require_number("distance", about["distance"], positive=camera.lens_data.converges, finite=False),
                require_number("bin_size", about["bin_size"], positive=True),
                str(about["method"]),
                camera,
                *(dict(about[name]) for name in ("options", "guards", "facts")),
            )


@dataclass(frozen=True, eq=False)
class Volume:
    """Planes from near to far on voxels of one width.

    Attributes
    ----------
    values : float32 array (planes, rows, columns[, channels])
        Upright images in units of the capture; NaN beyond what a plane shows.
    distances : tuple of floats
        Distances of the planes from the main lens, in scene units.
    voxel_size : float
        Width and height of a voxel in scene units.
    attributes : dict
        Facts as plain data: camera, method, options, and the facts about each plane.
    """

    values: Floats
    distances: Numbers
    voxel_size: float
    attributes: Named = field(default_factory=dict)

    @classmethod
    def of(cls, results: Sequence[Reconstruction]) -> Volume:
        """Return the volume of reconstructions of one capture.

        Bins grow with the distance. All planes of a volume have voxels as wide as the finest bins, over the field of
        the farthest plane, interpolated linearly between bin centres.

        Parameters
        ----------
        results : sequence of Reconstruction
            The planes, in any order.

        Returns
        -------
        Volume
        """
        refuse_if(not results, "results = []: a volume needs one plane at least")
        planes = sorted(results, key=lambda result: result.distance)
        distances = tuple(plane.distance for plane in planes)
        for nearer, distance in zip((None, *distances), distances, strict=False):
            if math.isinf(distance) or distance == nearer:
                rule = "a volume needs finite distances" if math.isinf(distance) else "it is given twice"
                raise InputError(f"distance = {distance:g}: {rule}")
        refuse_if(
            len({plane.image.shape[2:] for plane in planes}) > 1,
            "results: their images differ in the number of channels",
        )
        size = min(plane.bin_size for plane in planes)
        rows, columns = (
            max(math.ceil(plane.image.shape[axis] * plane.bin_size / size - 1e-6) for plane in planes)
            for axis in (0, 1)
        )
        shape = len(planes), rows, columns, *planes[0].image.shape[2:]
        require_memory(12.0 * math.prod(shape), f"a volume of {len(planes)} planes of {columns} x {rows} voxels")
        values = np.empty(shape, np.float32)
        for position, plane in zip(values, planes, strict=True):
            along_rows = _interpolated(plane.image, 0, plane.bin_size / size, rows)
            position[...] = _interpolated(along_rows, 1, plane.bin_size / size, columns)
        first = planes[0]
        attributes = {
            "camera": first.camera.to_dict(),
            "method": first.method,
            "options": first.options,
            "facts": [plane.facts for plane in planes],
        }
        return cls(values, distances, size, attributes)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return np.array(self.values, dtype, copy=copy)

    @property
    def spacing(self) -> float | None:
        """Distance between planes in mm; None for one plane, and for distances that vary by more than a thousandth."""
        steps = np.diff(self.distances)
        # Evenly spaced planes may each lie a thousandth of the mean spacing elsewhere.
        if not len(steps) or float(np.ptp(steps)) > 2e-3 * float(steps.mean()):
            return None
        return float(steps.mean())

    def maximum(self, axis: str = "z") -> Floats:
        """Return the brightest voxel along an axis.

        Parameters
        ----------
        axis : {"z", "y", "x"}
            Seen from the camera, from above, or from the side.

        Returns
        -------
        float32 array
            (rows, columns[, channels]) along z, (planes, columns[, channels]) along y, (planes, rows[, channels]) along
            x; 0 where no voxel shows anything.
        """
        along = _ALONG[require_choice("axis", axis, tuple(_ALONG))]
        return np.nan_to_num(self.values, nan=0.0).max(axis=along)

    def slices(
        self, plane: int | None = None, row: int | None = None, column: int | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """Return three orthogonal slices through one voxel.

        Parameters
        ----------
        plane, row, column : int, optional
            The voxel. Default: each that of the brightest one.

        Returns
        -------
        tuple of float32 arrays
            (rows, columns[, channels]) of the plane, (planes, columns[, channels]) of the row, and
            (planes, rows[, channels]) of the column.
        """
        grey = np.nan_to_num(self.values if self.values.ndim == 3 else self.values.mean(-1), nan=-np.inf)
        brightest = np.unravel_index(int(grey.argmax()), grey.shape)
        position = []
        for name, value, best, count in zip(
            ("plane", "row", "column"), (plane, row, column), brightest, grey.shape, strict=True
        ):
            if value is not None and not (isinstance(value, (int, np.integer)) and 0 <= value < count):
                raise InputError(f"{name} = {value!r}: the volume's are numbered from 0 to {count - 1}")
            position.append(int(best if value is None else value))
        return self.values[position[0]], self.values[:, position[1]], self.values[:, :, position[2]]

    def to_xarray(self) -> xr.DataArray:
        """Return the volume as an array with axes ``distance``, ``y`` and ``x``, in mm from the middle of its planes.

        As in all pictures, +x is to the left and +y up: both fall with the index.
        """
        # It takes half a second to load.
        import xarray as xr

        _, rows, columns = self.values.shape[:3]
        coordinates = {
            "distance": list(self.distances),
            "y": ((rows - 1) / 2 - np.arange(rows)) * self.voxel_size,
            "x": ((columns - 1) / 2 - np.arange(columns)) * self.voxel_size,
        }
        dimensions = [*coordinates, "channel"][: self.values.ndim]
        attributes = {"voxel_size": self.voxel_size, **{k: json.dumps(v) for k, v in self.attributes.items()}}
        return xr.DataArray(self.values, coordinates, dimensions, name="radiance", attrs=attributes)


def require_volume_path(path: str | Path, distances: Sequence[float]) -> Path:
    """Return a path after a check, before a long computation, that a volume of these planes can be written to it."""
    path = require_writable(path, *VOLUMES)
    if path.suffix.lower() == ".zarr":
        require_zarr(path)
    elif not _is_ome(path) and len(distances) > 1:
        ordered = tuple(sorted(distances))
        if Volume(np.zeros((len(ordered), 1, 1), np.float32), ordered, 1.0).spacing is None:
            listed = ", ".join(f"{distance:g}" for distance in ordered[:4]) + (", ..." if len(ordered) > 4 else "")
            raise InputError(
                f"distance = {listed}: planes of a .tif are evenly spaced; write .ome.tif, which holds any, or .zarr"
            )
    return path


def write_volume(path: str | Path, volume: Volume) -> None:
    """Write a volume with its voxel sizes: TIFF for ImageJ, OME-TIFF or Zarr.

    Both TIFF state lengths in micrometres, Zarr in millimetres.

    Parameters
    ----------
    path : path
        A name that ends in ``.tif`` or ``.tiff``, which ImageJ reads as a hyperstack; in ``.ome.tif`` or ``.ome.tiff``,
        where planes may be unevenly spaced; or in ``.zarr``, which xarray reads and needs the package zarr.
    volume : Volume
        The volume, which is written as float32.
    """
    path = require_volume_path(path, volume.distances)
    if path.suffix.lower() == ".zarr":
        write_labelled_data(path, volume.to_xarray().to_dataset())
        return
    values = volume.values
    axes = "ZYX"
    if values.ndim == 4:
        values = np.moveaxis(values, -1, 1)
        axes = "ZCYX"
    size = 1000 * volume.voxel_size
    spacing = volume.spacing and 1000 * volume.spacing
    with atomic_output(path) as temporary:
        metadata: Named = {"axes": axes}
        if _is_ome(path):
            for axis in "XY":
                metadata |= {f"PhysicalSize{axis}": size, f"PhysicalSize{axis}Unit": "µm"}
            if spacing is not None:
                metadata |= {"PhysicalSizeZ": spacing, "PhysicalSizeZUnit": "µm"}
            channels = volume.values.shape[3] if volume.values.ndim == 4 else 1
            positions = [1000 * distance for distance in volume.distances for _ in range(channels)]
            metadata["Plane"] = {"PositionZ": positions, "PositionZUnit": ["µm"] * len(positions)}
            metadata["Description"] = json.dumps(volume.attributes)
            tifffile.imwrite(temporary, values, ome=True, photometric="minisblack", metadata=metadata)
        else:
            about = {"distances": list(volume.distances), **volume.attributes}
            metadata |= {"unit": "um", "Info": json.dumps(about)}
            if spacing is not None:
                metadata["spacing"] = spacing
            resolution = (1 / size, 1 / size)
            tifffile.imwrite(temporary, values, imagej=True, resolution=resolution, metadata=metadata)


def _is_ome(path: Path) -> bool:
    return path.name.lower().endswith((".ome.tif", ".ome.tiff"))


def _interpolated(image: Floats, axis: int, width: float, count: int) -> Floats:
    """Return voxels along one axis, interpolated from bins `width` voxels wide; NaN beyond the bins."""
    bins = image.shape[axis]
    position = (np.arange(count) - (count - 1) / 2) / width + (bins - 1) / 2
    outside = np.abs(position - (bins - 1) / 2) > bins / 2 + 1e-6
    position = np.clip(np.where(np.abs(position - np.rint(position)) < 1e-6, np.rint(position), position), 0, bins - 1)
    low = np.floor(position).astype(np.int64)
    share = np.expand_dims((position - low).astype(np.float32), tuple(range(1, image.ndim - axis)))
    below, above = (np.take(image, np.minimum(some, bins - 1), axis) for some in (low, low + 1))
    # A bin that has no part in a voxel may be NaN.
    result = np.where(share > 0, (1 - share) * below + share * above, below)
    result[(slice(None),) * axis + (outside,)] = np.nan
    return np.asarray(result, np.float32)
