"""Captures, a plenoptic camera's recorded images with the camera, as OpenEXR files or raw pictures.

Raw pictures of 16 bits hold the digital numbers of a detector. Camera and detector are stored in the tag
ImageDescription of TIFF (Adobe, "TIFF", revision 6.0), or in a text chunk of PNG (W3C, "Portable Network Graphics",
third edition); other programs show the numbers and ignore these.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from ..camera import PlenopticCamera, require_camera
from ..choices import MODELS, RAW_SUFFIXES, AnyMosaic
from ..errors import (
    NO_RECORD,
    InputError,
    argument,
    naming,
    put,
    refuse_if,
    refusing,
    require_choice,
    require_number,
    require_wavelength,
    short_repr,
    suggest_keywords,
)
from ..extension import Displayed, format_of, place
from ..runtime import Array, Named, Numbers, as_pixels, atomic_output, of_one_file, require_writable
from .exr import ATTRIBUTE, read_attributes, read_exr, read_pixels, write_exr
from .versions import require_seal, sealed

if TYPE_CHECKING:
    from .pictures import StoredPicture


@suggest_keywords
@dataclass(frozen=True, eq=False, repr=False)
class Capture(Displayed):
    """The image recorded by the detector of a plenoptic camera.

    Parameters
    ----------
    image : (rows, columns[, 1 or 3]) array
        Pixel values, mean radiance over the aperture of the pixel's lens; stored as float32. All are finite and at most
        1e30 in magnitude: a capture with NaN or infinity cannot be made.
    camera : PlenopticCamera
        The camera; its `shape` is the image's.
    wavelength : float or tuple of three floats, optional
        Wavelength in nanometres, 200 to 2500, one for all channels or one for each; None for a ray capture.
    model : {"ray", "wave"}
        Model by which light was propagated.
    metadata : dict
        Facts on the making: scene, seed, samples, software versions. Plain JSON values.
    noise : array like the image, optional
        Standard deviation of each pixel from the samples of which it is made, as `render_capture` estimates it; stored
        as float32. Single pixels are uncertain, by 18 % or more.
    """

    image: np.ndarray
    camera: PlenopticCamera
    wavelength: float | Numbers | None = None
    model: str = "ray"
    metadata: dict[str, Any] = field(default_factory=dict)
    noise: np.ndarray | None = None

    def __post_init__(self) -> None:
        require_camera(self.camera)
        image = as_pixels("image", self.image, np.float32)
        refuse_if(
            image.ndim not in (2, 3) or image.shape[:2] != self.camera.shape,
            f"image of shape {image.shape}: the camera records {self.camera.shape[0]} rows and "
            f"{self.camera.shape[1]} columns",
        )
        channels = image.shape[2] if image.ndim == 3 else 1
        refuse_if(channels not in (1, 3), f"image of shape {image.shape}: a capture has 1 channel or 3")
        put(self, image=image)
        require_choice("model", self.model, MODELS)
        if isinstance(self.wavelength, (tuple, list)):
            refuse_if(
                len(self.wavelength) != channels,
                f"wavelength = {short_repr(self.wavelength)}: the image has {channels} channels",
            )
            put(self, wavelength=tuple(require_wavelength(value) for value in self.wavelength))
        elif self.wavelength is not None:
            put(self, wavelength=require_wavelength(self.wavelength))
        if not isinstance(self.metadata, dict):
            raise InputError(f"metadata = {short_repr(self.metadata)}: it must be a dictionary")
        if self.noise is not None:
            noise = as_pixels("noise", self.noise, np.float32)
            refuse_if(noise.shape != image.shape, f"noise of shape {noise.shape}: it must be as the image")
            if noise.min(initial=0) < 0:
                raise InputError(f"noise: {np.count_nonzero(noise < 0)} of its pixels are negative")
            put(self, noise=noise)

    def __repr__(self) -> str:
        """Return a description of the capture in one line."""
        rows, columns = self.camera.shape
        colours = " x 3" if self.image.ndim == 3 else ""
        light = "" if self.wavelength is None else f", {short_repr(self.wavelength)} nm"
        noise = "" if self.noise is None else f", noise {self.relative_noise:.2%}"
        return (
            f"Capture({columns} x {rows}{colours} pixels by {self.model}s{light}, mean {self.image.mean():.4g}{noise})"
        )

    def view(self, *others: Any, title: str = "") -> Any:
        """Make an interactive page of the capture, which notebooks show; `mitsuba_plenoptic.view` with the capture.

        Parameters
        ----------
        *others : Capture, Reconstruction, xarray.DataArray or xarray.Dataset
            A capture to compare it with, focal stacks, reconstructions and a depth map.
        title : str
            Headline of the page. Default: the scene and the camera.

        Returns
        -------
        Viewer
            ``save(path)`` writes the page.
        """
        import mitsuba_plenoptic

        return mitsuba_plenoptic.view(self, *others, title=title)

    @property
    def relative_noise(self) -> float | None:
        """Root mean square of the noise over the mean of the pixels; None for unknown noise."""
        if self.noise is None:
            return None
        mean = float(self.image.mean(dtype=np.float64))
        return float(np.sqrt(np.mean(np.square(self.noise, dtype=np.float64)))) / mean if mean else 0.0


CaptureLike = Capture | NDArray[Any] | str | Path
"""A capture, its pixels, or its file."""

EXPOSED = "exposure"
RECORDED = "raw"
"""Entries of a capture's metadata on its detector: a simulated one, and that of a real camera."""


def recording_of(capture: Capture) -> Named:
    """Return the record of the detector in a capture's metadata, empty if there is none."""
    recording = capture.metadata.get(EXPOSED, capture.metadata.get(RECORDED))
    return recording if isinstance(recording, dict) else {}


def mosaic_of(capture: Capture) -> str | None:
    """Return the colour-filter mosaic of a capture, None without a mosaic or after demosaicking."""
    mosaic = recording_of(capture).get("mosaic") if capture.image.ndim == 2 else None
    return mosaic if mosaic in get_args(AnyMosaic) else None


def require_demosaiced(capture: Capture) -> None:
    """Refuse a capture with a mosaic of colours, for computations that treat all pixels alike."""
    mosaic = mosaic_of(capture)
    refuse_if(mosaic is not None, f"mosaic = {mosaic}: each pixel of the capture has one colour; demosaic it first")


def read_if_path(capture: Any, camera: PlenopticCamera | None = None) -> Any:
    """Return a capture, read from its file where a path is given."""
    return read_capture(capture, camera=camera) if isinstance(capture, (str, Path)) else capture


def write_capture(path: str | Path, capture: Capture) -> None:
    """Write a capture as float32 OpenEXR: channel Y, or R, G and B, with all other data in the header.

    The noise, if it has any, is a layer of the same file: noise.Y, or noise.R, noise.G and noise.B.

    The header attribute ``mitsuba_plenoptic`` is a JSON object with ``camera``, ``wavelength``, ``model``,
    ``metadata`` and ``version``. Any EXR viewer shows the image. An existing file is replaced only by a complete one.

    Parameters
    ----------
    capture : Capture
        The capture to write.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> mp.write_capture("raw.exr", mp.example("letters-ray"))
    """
    refuse_if(not isinstance(capture, Capture), f"capture of type {type(capture).__name__}: it must be a Capture")
    window = {"offset": capture.camera.crop_offset, "full_size": capture.camera.resolution}
    write_exr(path, capture.image, _record(capture, "capture"), noise=capture.noise, **window)


def _record(capture: Capture, kind: str) -> Named:
    """Return all data of a capture except its pixels, as stored in files."""
    return {
        "kind": kind,
        "camera": capture.camera.to_dict(),
        "wavelength": capture.wavelength,
        "model": capture.model,
        "metadata": capture.metadata,
    }


def _capture_of(record: Named, image: Array, noise: Array | None = None) -> Capture:
    """Return a capture from its pixels and the record of its other data."""
    return Capture(
        image,
        PlenopticCamera.from_dict(record["camera"]),
        record.get("wavelength"),
        record.get("model", ""),
        record.get("metadata", {}),
        noise,
    )


@of_one_file
def read_capture(
    path: str | Path, *, camera: PlenopticCamera | None = None, linear: bool = False, black_level: float = 0
) -> Capture:
    """Return the capture in a file, or in a picture of another program with its camera.

    Files are those of `write_capture` and `write_raw`, the latter in the units of the capture that was exposed; raw
    pictures of other cameras that extensions read; and, with `camera`, pictures of other programs, ``.png``, ``.tiff``
    or ``.exr``, grey or of three colours.

    Parameters
    ----------
    camera : PlenopticCamera, optional
        The camera, instead of the one that the file states.
    linear : bool
        Whether whole numbers in a picture of another program are proportional to light, as in raw data, instead of
        encoded in sRGB; floating-point numbers always are.
    black_level : float
        Number without light in such a picture.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> mp.write_capture("raw.exr", mp.example("letters-ray"))
    >>> mp.read_capture("raw.exr").camera.lens_count
    (48, 48)
    """
    path, suffix = Path(path), Path(path).suffix.lower()
    picture = None
    if suffix in RAW_SUFFIXES:
        from .pictures import read_numbers

        picture = read_numbers(path)
    foreign = picture is not None and not states_detector(picture)
    rule = "it is for raw pictures of other programs that are linear"
    refuse_if(black_level and not (foreign and linear), f"black_level = {black_level}: {rule}")
    if picture is not None and foreign:
        rule = f"it states no camera and detector; such a raw picture needs its {argument('camera')}"
        refuse_if(camera is None, f"{path}: {rule}")
        with refusing(f"{path}: it cannot be read as a picture:"):
            return Capture(picture.values(linear, black_level), require_camera(camera))
    if picture is not None:
        capture = raw_capture(path, picture)
    elif of_extension := format_of(suffix, "capture", str(path)):
        capture = place(*of_extension)(path)
    elif camera is not None and not read_attributes(path):
        pixels = read_pixels(path, require_camera(camera))
        with naming(path):
            capture = Capture(pixels, camera)
    else:
        image, noise, record = read_exr(path)
        with naming(path):
            refuse_if(record.get("kind") != "capture", f"it holds a {short_repr(record.get('kind'))}, not a capture")
            refuse_if(not isinstance(record.get("camera"), dict), "its header has no camera")
            capture = _capture_of(record, image, noise)
    return capture if camera is None else replace(capture, camera=camera)


def write_raw(path: str | Path, capture: Capture) -> None:
    """Write an exposed capture as the digital numbers of its detector, in 16 bits.

    Parameters
    ----------
    path : path
        File to write; the name ends in ``.png``, ``.tif`` or ``.tiff``.
    capture : Capture
        A capture from `expose`: a mosaic, grey, or, in TIFF files, of three channels.

    Raises
    ------
    InputError
        If the capture was not exposed, its values are no digital numbers of its detector, a PNG would have three
        channels, or the file cannot be written.
    """
    path = require_writable(path, ".png", ".tif", ".tiff")
    numbers = digital_numbers(capture)
    text = json.dumps({ATTRIBUTE: sealed(_record(capture, "raw"), [{"": numbers}])})
    if path.suffix.lower() == ".png":
        refuse_if(numbers.ndim == 3, f"{path}: raw pictures of three channels are written as .tiff")
        information = PngInfo()
        information.add_text(ATTRIBUTE, text)
        with atomic_output(path) as temporary:
            Image.fromarray(numbers).save(temporary, format="PNG", pnginfo=information)
        return
    with atomic_output(path) as temporary:
        photometric = "rgb" if numbers.ndim == 3 else "minisblack"
        tifffile.imwrite(temporary, numbers, photometric=photometric, description=text, metadata=None)


def raw_capture(path: Path, picture: StoredPicture) -> Capture:
    """Return the capture in a picture of `write_raw`."""
    with refusing(f"{path}: it states no camera and detector; a raw picture needs its camera", *NO_RECORD):
        about = json.loads(picture.text)[ATTRIBUTE]
        records = about["camera"], about["metadata"]["exposure"]
        if not all(isinstance(entry, dict) for entry in records):
            raise TypeError("camera and exposure are no objects")
    with naming(path):
        require_seal(about, [{"": picture.numbers.astype(picture.numbers.dtype.name)}])
        refuse_if(picture.white != 65535, "it states a detector of 16 bits: another program changed it")
        gain, black, dark, unit = response_of(about["metadata"]["exposure"])
        image = (((picture.numbers.astype(np.float64) - black) / gain - dark) / unit).astype(np.float32)
        return _capture_of(about, image)


def states_detector(picture: StoredPicture) -> bool:
    """Return whether a picture states camera and detector, as one of `write_raw`."""
    return f'"{ATTRIBUTE}"' in picture.text


def digital_numbers(capture: Capture) -> NDArray[np.uint16]:
    """Return the digital numbers that a detector recorded for an exposed capture."""
    exposure = capture.metadata.get(EXPOSED)
    if not isinstance(exposure, dict):
        raise InputError("capture: no detector has recorded it; expose it first")
    gain, black, dark, unit = response_of(exposure)
    exact = (capture.image.astype(np.float64) * unit + dark) * gain + black
    numbers = np.rint(exact)
    # Single precision separates a number of 16 bits from its neighbours.
    refuse_if(
        np.abs(exact - numbers).max(initial=0) > 0.1 or numbers.min(initial=0) < 0 or numbers.max(initial=0) > 65535,
        "capture: its values are no digital numbers of its detector; write it as .exr",
    )
    return numbers.astype(np.uint16)


def response_of(exposure: Named) -> tuple[float, float, float, float]:
    """Return gain, black level, dark electrons, and electrons at pixel value 1, from the record of `expose`."""
    for name in ("gain", "black_level", "dark_electrons", "quantum_efficiency", "photons"):
        refuse_if(name not in exposure, f"exposure: {name}: it is missing")
    gain, efficiency, photons = (
        require_number(name, exposure[name], positive=True) for name in ("gain", "quantum_efficiency", "photons")
    )
    black, dark = (require_number(name, exposure[name], minimum=0) for name in ("black_level", "dark_electrons"))
    return gain, black, dark, efficiency * photons
