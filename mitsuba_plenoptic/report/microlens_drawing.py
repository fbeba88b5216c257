"""A drawing of a microlens: its optical path, its section with rays, and the spot on the detector."""

import numpy as np
from matplotlib.axes import Axes

from ..camera import PlenopticCamera
from ..errors import require_wavelength
from ..optics import in_millimetres
from ..prescription import LINE_D
from ..runtime import Doubles
from .plots import INK, Plot, ruled, styled

_SAMPLES = 256
"""Samples across a lens."""


@styled
def microlens_figure(camera: PlenopticCamera, wavelength: float | None = None) -> Plot:
    """Return a figure of a microlens on the axis of a camera.

    Parameters
    ----------
    wavelength : float, optional
        Wavelength in nanometres. Default: that of the line d.
    """
    wavelength = LINE_D if wavelength is None else require_wavelength(wavelength)
    reach = camera.lattice.cell_reach
    along = (np.arange(_SAMPLES) + 0.5) / _SAMPLES * 2 * reach - reach
    u, v = np.meshgrid(along, along)
    inside = camera.lattice.in_aperture(*camera.lattice.from_frame(u, v))
    waves = camera.microlens.waves(u, v, wavelength)
    plot = Plot(11.2, 3.7)
    lens, section, light = plot.subplots(1, 3, width_ratios=(1.2, 1.2, 1))
    ends = 1e3 * along[0], 1e3 * along[-1]
    phase = np.where(inside, waves - waves[inside].max(), np.nan)
    mesh = lens.imshow(phase, origin="lower", extent=(*ends, *ends), cmap="viridis")
    ruled(lens, "phase of the lens", "um from its centre")
    plot.colour_bar(mesh, lens, "waves")
    _section(section, camera, wavelength)
    _spot(light, camera, np.where(inside, np.exp(2j * np.pi * waves), 0), along, wavelength)
    return plot


def _section(axes: Axes, camera: PlenopticCamera, wavelength: float) -> None:
    """Draw a section of the lens, with rays parallel to the axis to half the detector distance beyond the detector."""
    half = camera.lattice.aperture_width / 2
    start = np.linspace(-1, 1, 15) * half * 0.98
    deflection = camera.microlens.slopes(start, 0 * start)[0] * camera.microlens.strength(wavelength)
    sine = deflection / camera.mla_medium
    slope = sine / np.sqrt(1 - np.minimum(sine * sine, 0.999))
    z = camera.detector_distance
    ends = np.array([-0.3 * z, 0.0, 1.5 * z])
    heights = np.stack([start, start, start + slope * ends[2]])
    axes.plot(1e3 * ends, 1e3 * heights, color="#c1443c", linewidth=0.7)
    axes.plot([0, 0], [-1e3 * half, 1e3 * half], color=INK, linewidth=2)
    axes.axvline(1e3 * z, color=INK, linewidth=0.8, linestyle="--")
    axes.set_ylim(-1.1e3 * half, 1.1e3 * half)
    medium = f", in a medium of index {camera.mla_medium:g}" if camera.mla_medium != 1 else ""
    ruled(axes, f"parallel rays to the detector{medium}", "um behind the array", "um from its centre")


def _spot(axes: Axes, camera: PlenopticCamera, field: Doubles, along: Doubles, wavelength: float) -> None:
    """Draw the square root of the detector intensity for parallel light, from Fresnel's integral."""
    scale = in_millimetres(wavelength) * camera.reduced_distance
    reach = max(4 * scale / camera.lattice.aperture_width, 1.5 * camera.pixel_size)
    positions = np.linspace(-reach, reach, 161)
    chirp = np.exp(1j * np.pi * along**2 / scale)
    wave = np.exp(-2j * np.pi * np.outer(positions, along) / scale) * chirp
    spot = np.abs(wave @ field @ wave.T)
    axes.imshow(spot, origin="lower", extent=(-1e3 * reach, 1e3 * reach) * 2, cmap="magma")
    ruled(axes, f"amplitude on the detector, {wavelength:.4g} nm", "um")
