"""The base of the integrators of wave captures: wavelengths, films, and what all of them refuse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..errors import (
    InputError,
    refuse_if,
    refusing,
    require_number,
    require_wavelength,
    short_repr,
)
from ..optics import colour
from ..optics.spectrum import (
    MOST_WAVELENGTHS,
    RGB_WAVELENGTHS,
    WAVELENGTHS,
    Responses,
    Spectrum,
    Table,
    interpolated,
    read_responses,
)
from ..runtime import drjit_array, require_unfrozen
from ..scene.radiance import require_medium_seen
from ..waves.signed_colours import SignedColours
from .properties import read_count, read_number, read_plain, require_read


def put(film: Any, image: NDArray[np.float32], channels: int) -> None:
    """Fill a film with an image (rows, columns, channels), whose channels after the first `channels` are noise."""
    extra = image.shape[2] - channels
    film.prepare([f"noise.{channel}" for channel in range(extra)])
    film.put_block(mi.ImageBlock(drjit_array(mi.TensorXf, _block(image, channels)), film.crop_offset()))


def develop(film: Any, image: NDArray[np.float32]) -> Any:
    """Return an image (rows, columns, channels) as the film develops it, which is a linear operation."""
    put(film, image, image.shape[2])
    return film.develop()


def develop_back(film: Any, gradient: Any, shape: tuple[int, int, int]) -> NDArray[np.float32]:
    """Return the transpose of `develop` applied to a gradient; `shape` is the image's (rows, columns, channels)."""
    block = drjit_array(mi.TensorXf, _block(np.zeros(shape, np.float32), shape[2]))
    dr.enable_grad(block)
    film.prepare([])
    film.put_block(mi.ImageBlock(block, film.crop_offset()))
    developed = film.develop()
    dr.backward(dr.sum(developed * gradient, axis=None))
    colours = np.array(dr.grad(block))[..., :3]
    return np.asarray(colours if shape[2] == 3 else colours.sum(axis=2, keepdims=True), np.float32)


def _block(image: NDArray[np.float32], channels: int) -> NDArray[np.float32]:
    """Return a block with the channels red, green, blue, a weight of 1, and the extra channels."""
    block = np.ones((*image.shape[:2], 4 + image.shape[2] - channels), dtype=np.float32)
    block[..., :3] = image[..., :channels]
    block[..., 4:] = image[..., channels:]
    return block


NAME = "plenoptic_wave"

DEFAULT_WAVELENGTH = 633.0

SRGB = "srgb"

BAND_NODES = 8
"""Default count of wavelengths of a band; point spreads may be computed at fewer."""

SHARED = 32
"""Count of wavelengths of a band whose light is distributed to the nodes of signed rays."""


@dataclass(frozen=True)
class Colours:
    """Wavelengths and responses of the channels of wave captures."""

    # Wavelength of each channel of light in nanometres; the default if responses are given.
    wavelengths: tuple[float, ...]
    # Whether the wavelengths are given, or the default.
    given: bool
    # Full width in nanometres of the band around each wavelength.
    bandwidth: float | None
    # ``srgb``, or the name of a file.
    responses: str | None
    # Content of the file, (rows, 1 + channels): each row has a wavelength and the response of each channel.
    table: NDArray[np.float64] | None
    # Count of wavelengths of the responses.
    count: int
    # Count of wavelengths at which diffraction is computed; None means as many as the accuracy needs.
    nodes: int | None

    def spectrum_for(self, channels: int, tables: Sequence[Table], count: int | None = None) -> Spectrum | None:
        """Return the spectrum of a film with `channels`; None if each channel of light has one wavelength.

        `tables` are spectra of the scene whose products with the responses must be integrated accurately. `count` is
        the number of wavelengths of each band, by default `nodes`.
        """
        if self.table is not None:
            columns = self.table.shape[1] - 1
            # A luminance film accepts three channels, too, but would add them up as if they were colours.
            refuse_if(
                columns not in (1, channels),
                f"responses = {self.responses}: {columns} channels, and the film has {channels}: use pixel_format rgb",
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
        """Return the responses in the form that signed-ray captures use."""
        spectrum, nodes = self.spectrum_for(channels, (), SHARED), self.nodes
        if spectrum is None:
            return SignedColours.lines(self.wavelengths)
        if not mi.is_spectral:
            return SignedColours(spectrum, self.bandwidth is not None, self.upsampling(spectrum), None, nodes)
        if self.table is not None:
            wavelengths, columns = self.table[:, 0], self.table[:, 1:].T
            columns = columns / np.trapezoid(columns, wavelengths, axis=1).reshape(-1, 1)
            at, ends = partial(interpolated, wavelengths, columns), wavelengths[[0, -1]].tolist()
            return SignedColours(spectrum, False, None, Responses(at, *ends), nodes)
        responses = colour.SRGB if self.bandwidth is None else self._band(self.bandwidth)
        return SignedColours(spectrum, False, None, responses, nodes)

    def _band(self, width: float) -> Responses:
        """Return the responses of the one channel of a band."""
        (centre,) = self.wavelengths
        return Responses(lambda at: np.full((1, len(at)), 1 / width), centre - width / 2, centre + width / 2)

    def upsampling(self, spectrum: Spectrum) -> NDArray[np.float64] | None:
        """Return the matrix (channels of light, wavelengths) from radiance to spectra; None in spectral variants."""
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
        # Sums over wavelengths approximate integrals; the matrix is corrected so that grey remains exactly grey.
        return np.asarray(np.linalg.solve(basis @ spectrum.matrix().astype(np.float64).T, basis))

    def parameters(self) -> dict[str, Any]:
        """Return the parameters by name, as for ``mi.load_dict``."""
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


def read_colours(props: Any) -> Colours:
    """Read wavelengths, bands and responses from a plugin's properties."""
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
            refuse_if(name in props, f"{NAME}: responses, {name}: give one of the two")
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
    """Read one wavelength, or one for each channel, for the active variant."""
    value = props.get("wavelength", None)
    if value is None:
        return RGB_WAVELENGTHS if mi.is_rgb else (DEFAULT_WAVELENGTH,)
    parts = value.split(",") if isinstance(value, str) else list(value) if hasattr(value, "__len__") else [value]
    with refusing(
        f"{NAME}: wavelength = {short_repr(value)}: it must be nanometres, or three of them separated by commas",
        ValueError,
    ):
        parts = [float(part) if isinstance(part, str) else part for part in parts]
    wavelengths = tuple(require_wavelength(part, f"{NAME}: wavelength") for part in parts)
    if len(wavelengths) == 1 and mi.is_rgb:
        wavelengths *= 3
    channels = 3 if mi.is_rgb else 1
    if len(wavelengths) != channels:
        there = f"variant {mi.variant()} has {channels} channel{'s' * (channels > 1)}"
        raise InputError(f"{NAME}: wavelength = {short_repr(value)}: {there}")
    return wavelengths


def asked_for(scene: Any, sensor: Any, seed: Any, spp: int) -> tuple[Any, int, int]:
    """Return the sensor, seed and sample count of a call of `mi.render`, which gives indices, arrays or zeros."""
    require_unfrozen("captures by waves")
    sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
    return sensor, int(seed[0]) if hasattr(seed, "__len__") else int(seed), spp or sensor.sampler().sample_count()


def make_base() -> type:
    """Define the base class of integrators with `record` and `parameters` for the active Mitsuba variant."""

    class RecordingIntegrator(mi.SamplingIntegrator):
        plugin: str

        def read_child(self, props: Any) -> None:
            """Keep the nested integrator, by default ``path``, and refuse parameters that nothing has read."""
            nested = [value for _, value in props.objects()]
            refuse_if(len(nested) > 1, f"{self.plugin}: {len(nested)} nested plugins: it takes one integrator")
            self.child = nested[0] if nested else mi.load_dict({"type": "path"})
            require_read(props, self.plugin)

        def render(
            self,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            """Render the capture; `spp` is the count of samples that `record` takes."""
            sensor, seed, spp = asked_for(scene, sensor, seed, spp)
            require_medium_seen(self.child, sensor)
            film = self.record(scene, sensor, seed=seed, spp=spp)
            return film.develop() if develop else None

        def to_string(self) -> str:
            """Return the description of the integrator that Mitsuba prints."""
            lines = [f"  {name} = {value}," for name, value in self.parameters().items()]
            return "\n".join([f"{type(self).__name__}[", *lines, f"  child = {self.child}", "]"])

    return RecordingIntegrator
