"""A part of a real picture: its lenses, its pixels in their lenses' micro-images, and the white light of each pixel."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property

import numpy as np

from ...camera import PlenopticCamera
from ...detector import SHARP
from ...errors import refuse_if
from ...runtime import Array, Named, Pair, Shape
from ..calibrate.array_fit import ArrayFit, places
from ..calibrate.field_fit import FieldNumbers, pixels_of_cells
from ..calibrate.micro_image import NUMBERS, MicroImageModel, PupilNumbers
from ..calibrate.white_fit import WhiteFit


@dataclass(frozen=True)
class CameraModel:
    """A camera as it is fitted to a white picture, with the model of its micro-images.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera, with a film of the picture's size.
    wavelength : float or None
        Wavelength in nanometres; None for rays.
    array : ArrayFit
        Lattice and warp.
    field : FieldNumbers
        The pupil over the field, blur and stray light.
    lens : (n, 2) array
        Indices along and across the rows of the micro-images on the picture, half steps along shifted rows.
    brightness : (n,) array
        Light in the middle of their white micro-images, over the mean.
    """

    camera: PlenopticCamera
    wavelength: float | None
    array: ArrayFit
    field: FieldNumbers
    lens: Array
    brightness: Array

    @classmethod
    def fitted(cls, fit: WhiteFit) -> CameraModel:
        """Return the model of a fit to a white picture."""
        bright = fit.brightness / np.nanmean(fit.brightness)
        return cls(fit.camera, fit.wavelength, fit.array, fit.field, fit.lens, bright)

    def to_plain(self) -> Named:
        """Return the model as plain values, for files."""
        array = {name: np.asarray(value).tolist() for name, value in asdict(self.array).items()}
        field = {
            "middle": self.field.middle.tolist(),
            "scale": self.field.scale,
            "coefficients": {name: values.tolist() for name, values in self.field.coefficients.items()},
        }
        lens = {"lens": self.lens.tolist(), "brightness": self.brightness.tolist()}
        return {"camera": self.camera.to_dict(), "wavelength": self.wavelength, "array": array, "field": field, **lens}

    @classmethod
    def of(cls, plain: Named) -> CameraModel:
        """Return the model that `to_plain` made plain."""
        values = plain["array"]
        array = ArrayFit(
            tuple(values["pitches"]),
            values["rotation"],
            tuple(values["offset"]),
            np.array(values["warp"]),
            np.array(values["nearest"]),
        )
        camera = PlenopticCamera.from_dict(plain["camera"])
        field = FieldNumbers.of(
            np.array(plain["field"]["middle"]),
            plain["field"]["scale"],
            {name: np.array(some) for name, some in plain["field"]["coefficients"].items()},
        )
        lens = np.array(plain["lens"])
        return cls(camera, plain["wavelength"], array, field, lens, np.array(plain["brightness"]))

    @property
    def pitch(self) -> Array:
        """Distances of micro-images along and across the rows, in pixels."""
        lattice = self.camera.lattice
        pitches = np.array([lattice.pitches[0], lattice.row_distance])
        return pitches * self.camera.image_growth / self.camera.pixel_size

    def places(self, lens: Array) -> Array:
        """Return the places (n, 2) in pixels of the micro-images of lenses with indices (n, 2)."""
        return places(self.array, lens.astype(np.float64), self.camera)

    def within(self, offset: Array) -> Array:
        """Return places in cells, in pitches along and across the rows, of offsets in pixels from lenses' places."""
        return np.stack(self.camera.lattice.to_frame(*offset.T), axis=-1) / self.pitch


@dataclass(frozen=True, eq=False)
class PartPixels:
    """Lenses whose micro-images lie in a rectangle of a picture, in rows and columns, and their pixels.

    Attributes
    ----------
    lens : (n, 2) array
        Indices along and across the rows of all lenses, row by row, as in `CameraModel`.
    lenses : (int, int)
        Lenses along and across the rows.
    shift : (rows,) array
        Pitches by which rows are shifted, 0 or 1/2.
    pixel : (m,) array
        Numbers of the pixels in the flat picture.
    lens_of : (m,) array
        The lens in whose cell each pixel is.
    """

    lens: Array
    lenses: Shape
    shift: Array
    pixel: Array
    lens_of: Array

    @classmethod
    def of(cls, model: CameraModel, box: tuple[float, float, float, float]) -> PartPixels:
        """Return the pixels of a camera's lenses within left, top, right and bottom, in pixels."""
        centres = model.places(model.lens)
        inside = ((centres > box[:2]) & (centres < box[2:])).all(1)
        refuse_if(not inside.any(), "part: no micro-image lies in it")
        first, last = (find(np.floor(model.lens[inside]), axis=0).astype(int) for find in (np.min, np.max))
        across, down = (last - first + 1).tolist()
        # Rows are shifted by half a pitch where indices are not whole.
        odd = model.lens[(model.lens[:, 0] % 1 == 0.5), 1] % 2
        shift = 0.5 * ((first[1] + np.arange(down)) % 2 == odd[:1]) if len(odd) else np.zeros(down)
        rows, columns = (index.ravel() for index in np.mgrid[:down, :across])
        lens = first + np.stack([columns + shift[rows], rows], axis=-1)
        size = model.camera.resolution
        of_lens, column, row = pixels_of_cells(model.camera, model.places(lens), np.ones(size[::-1], bool))
        # Cells of a warped array overlap by parts of a pixel.
        pixel, only = np.unique(row * size[0] + column, return_index=True)
        return cls(lens, (across, down), shift, pixel, of_lens[only])


class ArrayPart:
    """A camera's view of a part: places of its pixels in the cells of lenses, and their white light.

    Parameters
    ----------
    model : CameraModel
        The camera and the places of its micro-images.
    pixels : PartPixels
        The pixels, the same for all cameras that are compared.

    Attributes
    ----------
    place : (n, 2) array
        Places of all lenses in pixels, row by row.
    within : (m, 2) array
        Place of each pixel in its cell, in pitches along the rows and in rows' distances across them.
    along, down, margin : int
        Of the regular array: pixels, as small as the picture's or smaller, from lens to lens along rows and from row to
        row, and pixels of a cell beyond these. Half a pitch is whole pixels, too, where rows are shifted by it.
    """

    def __init__(self, model: CameraModel, pixels: PartPixels):
        self.model = model
        self.pixels = pixels
        self.lenses = pixels.lenses
        self.pixel = pixels.pixel
        self.lens_of = pixels.lens_of
        self.place = model.places(pixels.lens)
        row, column = np.divmod(self.pixel, model.camera.resolution[0])
        self._offset = np.stack([column, row], axis=-1) - self.place[self.lens_of]
        self.within = model.within(self._offset)
        self.along, self.down = (int(size) for size in np.ceil(model.pitch.round(2)))
        self.along += self.along % 2 if pixels.shift.any() else 0
        lattice = model.camera.lattice
        self.margin = int(
            np.ceil(round(max(v for _, v in lattice.unit_corners) / lattice.row_ratio - 0.5, 6) * self.down)
        )
        brightness = {tuple(lens): light for lens, light in zip(model.lens.tolist(), model.brightness, strict=True)}
        self._bright = np.array([brightness.get(tuple(lens), 1.0) for lens in pixels.lens.tolist()])

    @property
    def middle(self) -> Pair:
        """Place of the middle of the part on the array, in millimetres in the camera frame."""
        camera = self.model.camera
        from_axis = self.place.mean(0) - (np.array(camera.resolution) - 1) / 2
        x, y = (from_axis * camera.pixel_size / camera.image_growth).tolist()
        return x, y

    @property
    def numbers(self) -> PupilNumbers:
        """Numbers of the pupil in the middle of the part."""
        return PupilNumbers(*self.model.field.values(self.place.mean(0)[None])[0])

    @cached_property
    def white(self) -> Array:
        """Light of each pixel of an evenly white scene, without stray light, over that in the middle of lenses."""
        camera = self.model.camera.replace(mla_transmissions=None, mla_warp=(), **SHARP)
        micro = MicroImageModel(camera, self.model.wavelength)
        numbers = self.model.field.values(self.place)
        numbers[:, NUMBERS.index("stray")] = 0.0
        order = np.argsort(self.lens_of)
        ends = np.searchsorted(self.lens_of[order], np.arange(1, len(numbers)))
        light = np.empty(len(self.pixel))
        for pixels, pupil in zip(np.split(order, ends), numbers, strict=True):
            light[pixels] = micro.at(micro.samples(PupilNumbers(*pupil)), *self._offset[pixels].T)
        return light * self._bright[self.lens_of]
