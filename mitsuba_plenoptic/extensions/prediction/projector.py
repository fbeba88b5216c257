"""The light field of a volume, as a linear function of its voxels, and the transpose.

Pictures of voxels behind the regular array are put together lens by lens, as one matrix product for each displacement
between voxel and lens. The pixels of the real, warped array take their values from its lens's cell by cubic
interpolation (Keys 1981, IEEE Trans. Acoust. Speech Signal Process. 29, 1153), and are weighted so that an even volume
gives the camera's white picture: so the pupil over the field, unequal lenses and the light's apodisation are right.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from ...linear import LinearMap
from ...runtime import require_memory
from .array_part import ArrayPart
from .point_patterns import Plane, pixels_across

_DARK = 1e-4
"""Light of a plane's voxels in a lens's pixels, over their whole light, that is left out."""

_DIM = 0.02
"""Light that is added to both white pictures before they are divided, over that of bright pixels."""


class VolumeProjection(LinearMap):
    """Linear map from voxels (rows, columns, voxels of a lens) to a part's pixels: their direct light, and their glow.

    The glow is the mean light of a pixel's lens, of which stray light is a fraction. Lenses beyond the part's border by
    `reach` have voxels, too, as their light falls into the part.
    """

    def __init__(self, part: ArrayPart, planes: Sequence[Plane]) -> None:
        self.part, self._across = part, pixels_across(part)
        # Planes with the widest blur come first: a lens far away sees the first planes only.
        self.planes = sorted(planes, key=lambda plane: -plane.pictures.shape[0])
        self.reach = self.planes[0].pictures.shape[0] // self._across // 2
        columns, rows = part.lenses
        voxels = sum(plane.across**2 for plane in self.planes)
        super().__init__((rows + 2 * self.reach, columns + 2 * self.reach, voxels), (2, len(part.pixel)))
        pictures = sum(plane.pictures.size for plane in planes)
        require_memory(
            300.0 * len(part.pixel) + 4.0 * pictures + 32.0 * self.shape[1],
            f"volume of {self.source_shape[0]} x {self.source_shape[1]} lenses with {voxels} voxels each",
        )
        self._kernels = self._made_kernels()
        self._to_pixels = self._interpolation()
        self._to_cells = self._to_pixels.T.tocsr()
        self._weight = np.ones(len(part.pixel), np.float32)
        # Interpolation at sharp borders goes below 0.
        even = np.maximum(self.direct(np.ones(self.source_shape, np.float32)), 0)
        white = np.maximum(part.white, 0) * (even.mean() / part.white.mean())
        dim = _DIM * np.quantile(even, 0.99)
        self._weight = ((white + dim) / (even + dim)).astype(np.float32)

    def _made_kernels(self) -> dict[tuple[int, int], np.ndarray]:
        """Return the matrices from the voxels of a lens to another one's pixels, by displacement across and along."""
        side = self._across
        kernels = {}
        for down in range(-self.reach, self.reach + 1):
            for right in range(-self.reach, self.reach + 1):
                blocks = [self._block(plane, down, right) for plane in self.planes]
                lit = [index for index, block in enumerate(blocks) if block is not None]
                if lit:
                    # Dark planes between them are kept.
                    some = [
                        np.zeros((plane.across**2, side * side), np.float32) if block is None else block
                        for plane, block in zip(self.planes[: lit[-1] + 1], blocks, strict=False)
                    ]
                    kernels[down, right] = np.ascontiguousarray(np.concatenate(some))
        return kernels

    def _block(self, plane: Plane, down: int, right: int) -> np.ndarray | None:
        """Return a plane's light (voxels, pixels) in one lens, None for hardly any."""
        side = self._across
        half = plane.pictures.shape[0] // self._across // 2
        if max(abs(down), abs(right)) > half:
            return None
        rows, columns = (slice((half + step) * side, (half + step + 1) * side) for step in (down, right))
        block = plane.pictures[rows, columns].reshape(side * side, -1)
        return block.T if block.sum() > _DARK * plane.pictures.sum() else None

    def _interpolation(self) -> sparse.csr_matrix:
        """Return the matrix from the cells' values, lens by lens, to the pixels."""
        side = self._across
        part = self.part
        x, y = ((part.within + 0.5) * side - 0.5).T
        low = (np.floor(x).astype(int), np.floor(y).astype(int))
        entries = []
        columns = []
        for down in (-1, 0, 1, 2):
            for right in (-1, 0, 1, 2):
                # At a cell's border its last value continues.
                column = (low[0] + right).clip(0, side - 1)
                row = (low[1] + down).clip(0, side - 1)
                columns.append((part.lens_of * side + row) * side + column)
                entries.append(_keys(x - low[0] - right) * _keys(y - low[1] - down))
        count = len(part.pixel)
        shape = count, part.lenses[0] * part.lenses[1] * side * side
        index = np.arange(0, 16 * count + 1, 16)
        numbers = np.stack(columns, axis=1).ravel().astype(np.int32)
        return sparse.csr_matrix((np.stack(entries, axis=1).ravel().astype(np.float32), numbers, index), shape=shape)

    def _windows(self, step: tuple[int, int]) -> tuple[slice, slice]:
        """Return the lenses whose voxels lie at a displacement from the part's lenses."""
        columns, rows = self.part.lenses
        top = self.reach - step[0]
        left = self.reach - step[1]
        return slice(top, top + rows), slice(left, left + columns)

    def _cells(self, volume: np.ndarray) -> np.ndarray:
        """Return the light in the cells (lenses, pixels) of the regular array."""
        columns, rows = self.part.lenses
        light = np.zeros((rows * columns, self._across**2), np.float32)
        for step, kernel in self._kernels.items():
            voxels = volume[self._windows(step)][:, :, : len(kernel)]
            light += np.ascontiguousarray(voxels).reshape(rows * columns, -1) @ kernel
        return light

    def _record(self, cells: np.ndarray) -> np.ndarray:
        """Return the pixels' light from that in the cells of the regular array."""
        return np.asarray(self._weight * (self._to_pixels @ cells.ravel()))

    def direct(self, volume: np.ndarray) -> np.ndarray:
        """Return the pixels' light of voxels, without stray light."""
        return self._record(self._cells(volume))

    def forward(self, volume: np.ndarray, /) -> np.ndarray:
        """Return the pixels' direct light, and their glow, (2, pixels)."""
        cells = self._cells(volume)
        glow = np.broadcast_to(cells.mean(1, keepdims=True), cells.shape)
        return np.stack([self._record(cells), self._record(glow)])

    def adjoint(self, image: np.ndarray, /) -> np.ndarray:
        """Return the transpose of `forward`, applied to values of the direct light and of the glow."""
        columns, rows = self.part.lenses
        cells, even = ((self._to_cells @ (self._weight * pixels)).reshape(rows * columns, -1) for pixels in image)
        cells += even.mean(1, keepdims=True)
        volume = np.zeros(self.source_shape, np.float32)
        for step, kernel in self._kernels.items():
            volume[self._windows(step)][:, :, : len(kernel)] += (cells @ kernel.T).reshape(rows, columns, -1)
        return volume

    def split(self, volume: np.ndarray) -> list[np.ndarray]:
        """Return each plane's voxels as an image (rows, columns) in the directions of the picture."""
        rows, columns, _ = self.source_shape
        ends = np.cumsum([plane.across**2 for plane in self.planes])[:-1]
        return [
            some.reshape(rows, columns, plane.across, plane.across)
            .transpose(0, 2, 1, 3)
            .reshape(rows * plane.across, columns * plane.across)
            for some, plane in zip(np.split(volume, ends, axis=2), self.planes, strict=True)
        ]

    def join(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Return the voxels of planes' images, as `split` made them."""
        rows, columns, _ = self.source_shape
        return np.concatenate(
            [
                image.reshape(rows, plane.across, columns, plane.across)
                .transpose(0, 2, 1, 3)
                .reshape(rows, columns, plane.across**2)
                for image, plane in zip(images, self.planes, strict=True)
            ],
            axis=2,
        )


def _keys(distance: np.ndarray) -> np.ndarray:
    """Return the weights of cubic interpolation at distances in samples."""
    t = np.abs(distance)
    near = 1.5 * t**3 - 2.5 * t**2 + 1
    far = -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2
    return np.where(t <= 1, near, np.where(t < 2, far, 0))
