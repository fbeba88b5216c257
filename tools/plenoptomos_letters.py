"""Letters refocused by plenoptomos (cicwi/plenoptomos, GPL 3), for the bench case ``real.letters``.

Run it by a Python that has plenoptomos, astra-toolbox and h5py::

    PYTHONPATH=plenoptomos python tools/plenoptomos_letters.py plenoptomos/examples/data letters.npz --distance 385

It calls the published functions as the program's own example does. ASTRA projects on CUDA alone: without a card the
same rays through the same geometry are interpolated between pixels here, and the file says so.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import astra
import numpy as np
import plenoptomos as pleno
import scipy.sparse

if not hasattr(np, "int"):
    np.int = int  # the program was written before NumPy 1.24

PITCH = (48.2, 48.2273)
OFFSET = (46.5125, 30.5504)
"""What the example expects of the calibration of these pictures, in pixels."""


class Projections:
    """Parallel projections of one plane of voxels along the rays of a geometry of ASTRA, as a sparse matrix."""

    def __init__(self, geometry, volume):
        rows, columns, slices = volume["GridRowCount"], volume["GridColCount"], volume["GridSliceCount"]
        assert slices == 1, "planes are refocused one by one"
        box = volume["option"]
        low = np.array([box["WindowMinX"], box["WindowMinY"], box["WindowMinZ"]])
        high = np.array([box["WindowMaxX"], box["WindowMaxY"], box["WindowMaxZ"]])
        sizes = (high - low) / (columns, rows, 1)
        height, width = geometry["DetectorRowCount"], geometry["DetectorColCount"]
        v, u = np.indices((height, width)).reshape(2, 1, -1)
        parts = []
        for ray, middle, along, down in geometry["Vectors"].reshape(-1, 4, 3):
            place = middle[:, None] + along[:, None] * (u - (width - 1) / 2) + down[:, None] * (v - (height - 1) / 2)
            place = place.reshape(3, -1)
            at = place + ray[:, None] * (((low[2] + high[2]) / 2 - place[2]) / ray[2])
            x, y = ((at[k] - low[k]) / sizes[k] - 0.5 for k in (0, 1))
            length = sizes[2] / abs(ray[2]) * np.linalg.norm(ray)
            column, row = np.floor(x).astype(int), np.floor(y).astype(int)
            for right, below in np.ndindex(2, 2):
                weight = length * abs(1 - right - (x - column)) * abs(1 - below - (y - row))
                i, j = column + right, row + below
                inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
                entry = np.flatnonzero(inside)
                parts.append((weight[inside], len(parts) // 4 * height * width + entry, (j * columns + i)[inside]))
        values, pixels, voxels = (np.concatenate(values) for values in zip(*parts, strict=True))
        count = len(geometry["Vectors"])
        self.matrix = scipy.sparse.csr_array(
            (values.astype(np.float32), (pixels, voxels)), shape=(count * height * width, rows * columns)
        )
        self.adjoint = self.matrix.T.tocsr()
        self.shape = count, height, width

    def forward(self, volume, result):
        """Write the projections (rows, views, columns) of a plane."""
        result[...] = (self.matrix @ volume.ravel()).reshape(self.shape).transpose(1, 0, 2)

    def back(self, volume, result):
        """Write the plane onto which projections are spread, the transpose of `forward`."""
        volume[...] = (self.adjoint @ result.transpose(1, 0, 2).ravel()).reshape(volume.shape)


def without_cuda():
    """Let plenoptomos project by `Projections`."""
    astra.create_projector = lambda kind, geometry, volume, options: Projections(geometry, volume)
    astra.projector.delete = lambda projector: None
    astra.experimental.direct_FP3D = lambda projector, volume, result: projector.forward(volume, result)
    astra.experimental.direct_BP3D = lambda projector, volume, result: projector.back(volume, result)


def main():
    """Refocus the letters to each distance by the program's three methods, and store the pictures and times."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--distance", type=float, action="append", required=True)
    parser.add_argument("--up-sampling", type=int, default=1)
    options = parser.parse_args()
    cuda = astra.use_cuda()
    if not cuda:
        without_cuda()
    name = str(options.data / "letters_ULF_M1")
    with tempfile.TemporaryDirectory() as folder:
        first, second = (str(Path(folder) / f"{stage}.vox") for stage in ("raw", "calibrated"))
        pleno.data_format.create_vox_from_raw(
            f"{name}.png", f"{name}.ini", raw_det_white=f"{name}_white.png", raw_det_dark=f"{name}_dark.png",
            out_file=first,
        )  # fmt: skip
        pleno.data_format.calibrate_raw_image(
            first, vox_file_out=second, pitch=np.array(PITCH), offset=np.array(OFFSET)
        )
        field = pleno.data_format.load(second)
    focus = field.camera.get_focused_distance()
    # Divided by white, as pictures here are.
    spread = pleno.psf.PSFApply2D(psf_d=pleno.psf.PSF(field.camera, coordinates="vu", airy_rings=1))
    least = pleno.solvers.CP_tv(data_term="l2", lambda_tv=1e-1, axes=(-2, -1))
    methods = {
        "bpj": {"algorithm": "bpj"},
        "sirt": {"algorithm": "sirt", "iterations": 3},
        "cp_ls_tv": {"algorithm": least, "iterations": 50, "psf": spread},
    }
    results = {"cuda": cuda, "focus": focus, "up_sampling": options.up_sampling}
    for distance in options.distance:
        alpha = field.camera.get_alphas(
            np.array([distance / focus]), beam_geometry_in="cone", beam_geometry_out="parallel"
        )
        for method, arguments in methods.items():
            start = time.process_time()
            try:
                images = pleno.tomo.compute_refocus_iterative(
                    field.clone(), focus * alpha, beam_geometry="parallel", up_sampling=options.up_sampling, **arguments
                )
            except Exception as error:  # the program's own limits are a result, too
                print(f"{method} at {distance:g} mm: {type(error).__name__}: {error}")
                continue
            results[f"{method}_{distance:g}"] = images[0]
            results[f"{method}_{distance:g}_seconds"] = time.process_time() - start
    np.savez(options.output, **results)
    print({key: value if np.ndim(value) == 0 else value.shape for key, value in results.items()})


if __name__ == "__main__":
    main()
