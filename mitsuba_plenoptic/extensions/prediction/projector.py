"""The light field of planes, as a linear function of their elements, and the transpose.

Pictures of elements behind the regular array are put together lens by lens, as one matrix product for each displacement
between element and lens. The pixels of the real, warped array take their values from its lens's cell by cubic
interpolation (Keys 1981, IEEE Trans. Acoust. Speech Signal Process. 29, 1153), and are weighted so that an even scene
gives the camera's white picture: so the pupil over the field, unequal lenses and the light's apodisation are right.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import sparse

from ...linear import LinearMap
from ...runtime import Array, require_memory
from .array_part import ArrayPart
from .point_patterns import Plane


class SceneProjection(LinearMap):
    """Linear map from elements (rows, columns, elements of a bin) to a part's pixels: direct light, and glow.

    The glow is the mean light of a pixel's lens, of which stray light is a fraction. Lenses beyond the part's border by
    `reach` have elements, too, as their light falls into the part.
    """

    def __init__(self, part: ArrayPart, planes: Sequence[Plane]):
        self.part = part
        # Planes with the widest blur come first: a lens far away sees the first planes only.
        self.planes = sorted(planes, key=lambda plane: -plane.pictures.shape[0])
        self.reach = self.planes[0].pictures.shape[1] // part.along // 2
        columns, rows = part.lenses
        elements = sum(plane.across**2 for plane in self.planes)
        super().__init__((rows + 2 * self.reach, columns + 2 * self.reach, elements), (2, len(part.pixel)))
        pictures = sum(plane.pictures.size for plane in planes)
        require_memory(
            300.0 * len(part.pixel) + 4.0 * pictures + 32.0 * self.shape[1],
            f"scene of {self.source_shape[0]} x {self.source_shape[1]} bins with {elements} elements each",
        )
        self._kernels = self._made_kernels()
        self._to_pixels = self._interpolation()
        self._to_cells = self._to_pixels.T.tocsr()
        self._weight = np.ones(len(part.pixel), np.float32)
        # Interpolation at sharp borders goes below 0.
        even = np.maximum(self.direct(np.ones(self.source_shape, np.float32)), 0)
        white = np.maximum(part.white, 0) * (even.mean() / part.white.mean())
        # Light that is added to both white pictures before they are divided, over that of bright pixels.
        dim = 0.02 * np.quantile(even, 0.99)
        self._weight = ((white + dim) / (even + dim)).astype(np.float32)

    def _made_kernels(self) -> dict[tuple[int, float], Array]:
        """Return the matrices from a bin's elements to a lens's pixels, by the lens's rows down and pitches right."""
        kernels = {}
        for down in range(-self.reach, self.reach + 1):
            aside = np.ptp(self.part.pixels.shift) * (down % 2)
            for right in np.arange(-self.reach + aside, self.reach + 1 - aside).tolist():
                blocks = [self._block(plane, down, right) for plane in self.planes]
                lit = [index for index, block in enumerate(blocks) if block.any()]
                if lit:
                    # Dark planes between them are kept.
                    kernels[down, right] = np.ascontiguousarray(np.concatenate(blocks[: lit[-1] + 1]))
        return kernels

    def _block(self, plane: Plane, down: int, right: float) -> Array:
        """Return a plane's light (elements, pixels) in one lens, 0 for hardly any."""
        part = self.part
        half = plane.pictures.shape[1] // part.along // 2
        first = (half + down) * part.down, round((half + right) * part.along)
        size = part.down + 2 * part.margin, part.along
        block = plane.pictures[tuple(slice(max(low, 0), low + count) for low, count in zip(first, size, strict=True))]
        # Light of a plane's elements in a lens's pixels, over their whole light, that is left out.
        if max(abs(down), abs(right)) > half or block.sum() <= 1e-4 * plane.pictures.sum():
            return np.zeros((plane.across**2, size[0] * size[1]), np.float32)
        return block.reshape(size[0] * size[1], -1).T

    def _interpolation(self) -> sparse.csr_matrix:
        """Return the matrix from the cells' values, lens by lens, to the pixels."""
        part = self.part
        side = part.along
        height = part.down + 2 * part.margin
        x, y = ((part.within + 0.5) * [side, part.down] + [-0.5, part.margin - 0.5]).T
        low = (np.floor(x).astype(int), np.floor(y).astype(int))
        entries = []
        columns = []
        for down in (-1, 0, 1, 2):
            for right in (-1, 0, 1, 2):
                # At a cell's border its last value continues.
                column = (low[0] + right).clip(0, side - 1)
                row = (low[1] + down).clip(0, height - 1)
                columns.append((part.lens_of * height + row) * side + column)
                entries.append(_keys(x - low[0] - right) * _keys(y - low[1] - down))
        count = len(part.pixel)
        shape = count, part.lenses[0] * part.lenses[1] * height * side
        index = np.arange(0, 16 * count + 1, 16)
        numbers = np.stack(columns, axis=1).ravel().astype(np.int32)
        return sparse.csr_matrix((np.stack(entries, axis=1).ravel().astype(np.float32), numbers, index), shape=shape)

    def _windows(self, down: int, right: float) -> Iterator[tuple[slice, tuple[slice, slice]]]:
        """Give rows of the part's lenses, and the bins from which these lenses are displaced."""
        columns, rows = self.part.lenses
        shift = self.part.pixels.shift
        period = 2 if shift.any() else 1
        for first in range(period):
            # Shifted rows have other displacements than those between them.
            left = self.reach + round(shift[first] - shift[(first - down) % period] - right)
            top = self.reach - down + first
            yield slice(first, rows, period), (slice(top, top + rows - first, period), slice(left, left + columns))

    def _cells(self, scene: Array) -> Array:
        """Return the light in the cells (lenses, pixels) of the regular array."""
        columns, rows = self.part.lenses
        light = np.zeros((rows, columns, next(iter(self._kernels.values())).shape[1]), np.float32)
        for step, kernel in self._kernels.items():
            for lenses, bins in self._windows(*step):
                elements = np.ascontiguousarray(scene[bins][:, :, : len(kernel)]).reshape(-1, len(kernel))
                light[lenses] += (elements @ kernel).reshape(-1, *light.shape[1:])
        return light.reshape(rows * columns, -1)

    def _record(self, cells: Array) -> Array:
        """Return the pixels' light from that in the cells of the regular array."""
        return self._weight * (self._to_pixels @ cells.ravel())

    def direct(self, scene: Array) -> Array:
        """Return the pixels' light of a scene's elements, without stray light."""
        return self._record(self._cells(scene))

    def forward(self, scene: Array, /) -> Array:
        """Return the pixels' direct light, and their glow, (2, pixels)."""
        cells = self._cells(scene)
        glow = np.broadcast_to(cells.mean(1, keepdims=True), cells.shape)
        return np.stack([self._record(cells), self._record(glow)])

    def adjoint(self, image: Array, /) -> Array:
        """Return the transpose of `forward`, applied to values of the direct light and of the glow."""
        columns, rows = self.part.lenses
        cells, even = ((self._to_cells @ (self._weight * pixels)).reshape(rows * columns, -1) for pixels in image)
        cells += even.mean(1, keepdims=True)
        cells = cells.reshape(rows, columns, -1)
        scene = np.zeros(self.source_shape, np.float32)
        for step, kernel in self._kernels.items():
            for lenses, bins in self._windows(*step):
                back = np.ascontiguousarray(cells[lenses]).reshape(-1, kernel.shape[1]) @ kernel.T
                scene[bins][:, :, : len(kernel)] += back.reshape(-1, columns, len(kernel))
        return scene

    def split(self, scene: Array) -> list[Array]:
        """Return each plane's elements as an image (rows, columns) in the directions of the picture."""
        rows, columns, _ = self.source_shape
        ends = np.cumsum([plane.across**2 for plane in self.planes])[:-1]
        return [
            self._aside(
                some.reshape(rows, columns, plane.across, plane.across).transpose(0, 2, 1, 3), plane, 1
            ).reshape(rows * plane.across, columns * plane.across)
            for some, plane in zip(np.split(scene, ends, axis=2), self.planes, strict=True)
        ]

    def join(self, images: Sequence[Array]) -> Array:
        """Return the elements of planes' images, as `split` made them."""
        rows, columns, _ = self.source_shape
        return np.concatenate(
            [
                self._aside(image.reshape(rows, plane.across, columns, plane.across), plane, -1)
                .transpose(0, 2, 1, 3)
                .reshape(rows, columns, plane.across**2)
                for image, plane in zip(images, self.planes, strict=True)
            ],
            axis=2,
        )

    def _aside(self, image: Array, plane: Plane, sign: int) -> Array:
        """Return an image (rows, across, columns, across) with shifted rows moved half a bin along, or back by -1."""
        shift = self.part.pixels.shift
        if not shift.any():
            return image
        image = image.copy()
        bins = image[int(shift[self.reach % 2] == 0) :: 2]
        bins[:] = np.roll(bins.reshape(*bins.shape[:2], -1), sign * plane.across // 2, -1).reshape(bins.shape)
        return image


def _keys(distance: Array) -> Array:
    """Return the weights of cubic interpolation at distances in samples."""
    t = np.abs(distance)
    near = 1.5 * t**3 - 2.5 * t**2 + 1
    far = -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2
    return np.where(t <= 1, near, np.where(t < 2, far, 0))
