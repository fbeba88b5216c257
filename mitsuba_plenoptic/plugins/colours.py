"""What a wave capture's film answers to: the integrator's parameters on wavelengths, bands and responses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..bounds import require_wavelength
from ..capture import colour
from ..capture.signed_colours import SignedColours
from ..errors import InputError, require_number, short_repr
from ..optics.spectrum import MOST_WAVELENGTHS, RGB_WAVELENGTHS, WAVELENGTHS, Responses, Spectrum, Table, read_responses
from .properties import read_count, read_number, read_plain


def put(film: Any, image: NDArray[np.float32], channels: int) -> None:
    """Fill a film with an image (rows, columns, channels), of which those beyond some are extra ones, of noise."""
    extra = image.shape[2] - channels
    film.prepare([f"noise.{channel}" for channel in range(extra)])
    film.put_block(mi.ImageBlock(mi.TensorXf(_block(image, channels)), film.crop_offset()))


def develop(film: Any, image: NDArray[np.float32]) -> Any:
    """Return what a film makes of an image (rows, columns, channels): it is linear in it."""
    put(film, image, image.shape[2])
    return film.develop()


def develop_back(film: Any, gradient: Any, shape: tuple[int, int, int]) -> NDArray[np.float32]:
    """Apply the transpose of `develop`.

    Shapes: `shape` (int, int, int).
    """
    block = mi.TensorXf(_block(np.zeros(shape, np.float32), shape[2]))
    dr.enable_grad(block)
    film.prepare([])
    film.put_block(mi.ImageBlock(block, film.crop_offset()))
    developed = film.develop()
    dr.backward(dr.sum(developed * gradient, axis=None))
    colours = np.array(dr.grad(block))[..., :3]
    return np.asarray(colours if shape[2] == 3 else colours.sum(axis=2, keepdims=True), np.float32)


def _block(image: NDArray[np.float32], channels: int) -> NDArray[np.float32]:
    """Return red, green, blue, a weight of 1, and what else there is."""
    block = np.ones((*image.shape[:2], 4 + image.shape[2] - channels), dtype=np.float32)
    block[..., :3] = image[..., :channels]
    block[..., 4:] = image[..., channels:]
    return block


NAME = "plenoptic_wave"

DEFAULT_WAVELENGTH = 633.0

SRGB = "srgb"

BAND_NODES = 8
"""Wavelengths of a band where their number is not given, of which fewer point spreads may be computed."""

SHARED = 32
"""Wavelengths of a band whose light is shared by nodes of signed rays."""


@dataclass(frozen=True)
class Colours:
    """Wavelengths and responses of the channels of wave captures."""

    # Of each channel of light in nanometres; with responses those of the default.
    wavelengths: tuple[float, ...]
    # Whether they are given, or those of the default.
    given: bool
    # Full width of the band around each.
    bandwidth: float | None
    # ``srgb``, or the name of a file.
    responses: str | None
    # What the file holds: a wavelength and each channel's response to a row; (rows, 1 + channels).
    table: NDArray[np.float64] | None
    # Wavelengths of responses.
    count: int
    # At how many wavelengths point spreads are computed.
    nodes: int | None

    def spectrum_for(self, channels: int, tables: Sequence[Table], count: int | None = None) -> Spectrum | None:
        """Return the spectrum of a film of so many channels; None if each channel of light has one wavelength.

        `tables` are spectra of the scene whose products with the responses must be integrated right, and `count` the
        wavelengths of each band; by default `nodes`.
        """
        if self.table is not None:
            columns = self.table.shape[1] - 1
            # A film of luminance takes three channels, too, but would add up what it does not know as colours.
            if columns not in (1, channels):
                raise InputError(
                    f"responses = {self.responses}: {columns} channels, and the film has {channels}: "
                    "use pixel_format rgb"
                )
            return Spectrum.sensor(self.table, self.count, tables)
        if self.bandwidth is not None:
            count, width = count or self.nodes or BAND_NODES, self.bandwidth
            return (
                Spectrum.smooth(*self._band(width), count, tables)
                if tables
                else Spectrum.bands(self.wavelengths, width, count)
            )
        if self.responses == SRGB or (mi.is_spectral and channels == 3 and not self.given):
            return colour.srgb(self.count, tables)
        return None

    def signed(self, channels: int) -> SignedColours:
        """Return what captures by signed rays need to know."""
        spectrum, nodes = self.spectrum_for(channels, (), SHARED), self.nodes
        if spectrum is None:
            return SignedColours.lines(self.wavelengths)
        if not mi.is_spectral:
            return SignedColours(spectrum, self.bandwidth is not None, self.upsampling(spectrum), None, nodes)
        if self.table is not None:
            wavelengths, columns = self.table[:, 0], self.table[:, 1:].T
            columns = columns / np.trapezoid(columns, wavelengths, axis=1).reshape(-1, 1)
            at, ends = partial(_between, wavelengths, columns), wavelengths[[0, -1]].tolist()
            return SignedColours(spectrum, False, None, Responses(at, *ends), nodes)
        responses = colour.SRGB if self.bandwidth is None else self._band(self.bandwidth)
        return SignedColours(spectrum, False, None, responses, nodes)

    def _band(self, width: float) -> Responses:
        """Return the responses of the one channel of a band."""
        (centre,) = self.wavelengths
        return Responses(lambda places: np.full((1, len(places)), 1 / width), centre - width / 2, centre + width / 2)

    def upsampling(self, spectrum: Spectrum) -> NDArray[np.float64] | None:
        """Return the matrix (channels of light, wavelengths) from radiance to spectra; None if it has one already."""
        if mi.is_spectral:
            return None
        if self.bandwidth is not None:
            each = len(spectrum.wavelengths) // len(self.wavelengths)
            return np.asarray(np.kron(np.eye(len(self.wavelengths)), np.ones(each)), np.float64)
        if not mi.is_rgb:
            return np.ones((1, len(spectrum.wavelengths)))
        colour.require_upsampled(spectrum)
        basis = colour.upsampling(spectrum.wavelengths)
        if self.responses != SRGB:
            return basis
        # Their sums are no integrals to the last digit; what is grey shall stay so.
        return np.asarray(np.linalg.solve(basis @ spectrum.matrix().astype(np.float64).T, basis))

    def total_nodes(self) -> int | None:
        """Return at how many wavelengths of the spectrum point spreads are computed; None: as many as they need."""
        return None if self.nodes is None else self.nodes * (1 if self.bandwidth is None else len(self.wavelengths))

    def parameters(self) -> dict[str, Any]:
        """Return them by name, as ``mi.load_dict`` takes them."""
        made: dict[str, Any] = {}
        if self.responses is None and (self.given or not mi.is_spectral):
            made["wavelength"] = ", ".join(f"{wavelength:g}" for wavelength in self.wavelengths)
        elif self.responses is not None:
            made |= {"responses": self.responses, "wavelength_count": self.count}
        if self.bandwidth is not None:
            made["bandwidth"] = self.bandwidth
        if self.nodes is not None:
            made["nodes"] = self.nodes
        return made


def _between(
    wavelengths: NDArray[np.float64], columns: NDArray[np.float64], places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return values between the rows of a table."""
    return np.stack([np.interp(places, wavelengths, column) for column in columns])


def read_colours(props: Any) -> Colours:
    """Take wavelengths, bands and responses from a plugin's properties."""
    responses = read_plain(props, "responses", None)
    bandwidth = read_number(props, NAME, "bandwidth", None)
    count = read_count(props, NAME, "wavelength_count", WAVELENGTHS, maximum=MOST_WAVELENGTHS)
    nodes = read_count(props, NAME, "nodes", 0, maximum=MOST_WAVELENGTHS) if "nodes" in props else None
    wavelengths = _read_wavelengths(props)
    table = None
    if responses is not None:
        if not isinstance(responses, str):
            raise InputError(f"{NAME}: responses = {short_repr(responses)}: it must be srgb or the name of a file")
        for name in ("wavelength", "bandwidth"):
            if name in props:
                raise InputError(f"{NAME}: responses, {name}: give one of the two")
        if responses != SRGB:
            responses = str(mi.file_resolver().resolve(responses))
            table = read_responses(responses)
            Spectrum.sensor(table, count)
            if table.shape[1] - 1 not in (1, 3):
                raise InputError(f"{NAME}: responses = {responses}: {table.shape[1] - 1} channels: it must be 1 or 3")
        elif not (mi.is_rgb or mi.is_spectral):
            raise InputError(
                f"{NAME}: responses = srgb: variant {mi.variant()} has no colours; use an rgb or spectral one"
            )
    elif "wavelength_count" in props and not mi.is_spectral:
        raise InputError(f"{NAME}: wavelength_count = {count}: of use with responses only")
    if bandwidth is not None:
        for wavelength in wavelengths:
            require_number(f"{NAME}: bandwidth", bandwidth, maximum=wavelength)
    elif nodes is not None and responses is None and not mi.is_spectral:
        raise InputError(f"{NAME}: nodes = {nodes}: of use with bandwidth or responses only")
    return Colours(wavelengths, "wavelength" in props, bandwidth, responses, table, count, nodes)


def _read_wavelengths(props: Any) -> tuple[float, ...]:
    """Take one wavelength, or one a channel, for the active variant."""
    value = props.get("wavelength", None)
    if value is None:
        return RGB_WAVELENGTHS if mi.is_rgb else (DEFAULT_WAVELENGTH,)
    parts = value.split(",") if isinstance(value, str) else list(value) if hasattr(value, "__len__") else [value]
    try:
        parts = [float(part) if isinstance(part, str) else part for part in parts]
    except ValueError:
        raise InputError(
            f"{NAME}: wavelength = {short_repr(value)}: it must be nanometres, or three of them separated by commas"
        ) from None
    wavelengths = tuple(require_wavelength(part, f"{NAME}: wavelength") for part in parts)
    if len(wavelengths) == 1 and mi.is_rgb:
        wavelengths *= 3
    channels = 3 if mi.is_rgb else 1
    if len(wavelengths) != channels:
        there = f"variant {mi.variant()} has {channels} channel{'s' * (channels > 1)}"
        raise InputError(f"{NAME}: wavelength = {short_repr(value)}: {there}")
    return wavelengths
