r"""Particles in a volume, the light sheet that shines on them, and the window through which a camera looks at them.

Rays obey Snell's law at the window: :math:`n \sin\theta = n_0 \sin\theta_0`, with the index :math:`n_0` of the
immersion before an objective, and 1 before other lenses. Those near its normal come from :math:`z_w + (z - z_w) n_0 /
n`, where the camera sees a particle at z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...camera import PlenopticCamera
from ...errors import (
    put_checked,
    refuse_if,
    require_choice,
    require_length,
    require_number,
    require_numbers,
    suggest_keywords,
    warn,
)
from ...runtime import MILLIMETRES, POINTS, Doubles, Flags, as_array

MOST = 10**7
"""Particles at most."""

MOST_SHADOW = 0.1
"""Part of the volume's front that the particles' cross-sections cover, at most: they do not hide each other."""

PLACE = partial(require_numbers, count=3, minimum=-1e9, maximum=1e9)
"""Rule of a place, direction or velocity."""

_MEDIUM = partial(require_number, minimum=1, maximum=5)
"""Rule of a refractive index."""


as_points = partial(as_array, dims=POINTS, rule="they must be numbers, (n, 3)", units=MILLIMETRES, shape=(None, 3))
"""Rule of points (n, 3)."""


@suggest_keywords
@dataclass(frozen=True)
class Window:
    """A thin plane window, square to the axis, between a camera and a fluid; by default there is none.

    Parameters
    ----------
    distance : float
        Position z of the window in mm of the camera frame.
    medium : float, optional
        Refractive index of the fluid behind it. Default: as before it.
    """

    distance: float = 0.0
    medium: float | None = None

    def __post_init__(self) -> None:
        put_checked(self, distance=require_number, medium=_MEDIUM)

    def ratio(self, camera: PlenopticCamera) -> float:
        """Return the refractive index before the window over that behind it."""
        if self.medium is None:
            return 1.0
        lens = camera.objective
        before, nearest, aperture = (lens.immersion, lens.nearest, lens.numerical_aperture) if lens else (1.0, 0.0, 0.0)
        refuse_if(
            self.distance < nearest or self.medium <= aperture,
            f"{self}: its distance must be before the lens, at least {nearest:g}, and its medium above {aperture:g}",
        )
        return before / self.medium

    def seen(self, z: Any, camera: PlenopticCamera) -> Any:
        """Return the z in mm at which a camera sees points at z."""
        return z + np.maximum(z - self.distance, 0) * (self.ratio(camera) - 1)

    def apparent(self, points: ArrayLike, camera: PlenopticCamera, wavelength: float) -> Doubles:
        """Return where a camera sees points, and warn where the window's aberration blurs them.

        Parameters
        ----------
        points : array (n, 3)
            Positions in mm.
        camera, wavelength : PlenopticCamera, float
            The camera, and the wavelength in vacuum, in nanometres.
        """
        x, y, z = as_points("points", points).T
        seen = self.seen(z, camera)
        lens = camera.objective
        # Angles before the window, of the chief ray and of the pupil's radius.
        chief, cone = (0, lens.half_angle) if lens else (np.hypot(x, y) / seen, camera.aperture_radius / seen)
        ratio = self.ratio(camera)
        factor = (lens.immersion if lens else 1) * ratio * abs(1 - ratio**2) / 8 * 1e6 / wavelength
        waves = factor * (np.maximum(z - self.distance, 0) * ((chief + cone) ** 4 - chief**4)).max(initial=0)
        # 1 / 14: Waves up to which a point stays sharp, by Maréchal.
        if waves > 1 / 14:
            warn(
                f"window = {self.distance:g}: its aberration is {waves:.1g} waves, above a fourteenth, and left out: "
                "images are sharp, and where rays near the window's normal have them"
            )
        return np.stack([x, y, seen], -1)


@suggest_keywords
@dataclass(frozen=True)
class ParticleVolume:
    """The box in which particles are recorded, in millimetres of the camera frame.

    Parameters
    ----------
    lower, upper : (float, float, float)
        Corners: x, y and z: the distance from the main lens, or the depth beyond a microscope's native object plane.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def __post_init__(self) -> None:
        put_checked(self, lower=PLACE, upper=PLACE)
        refuse_if(
            (self.size <= 0).any(),
            f"lower = {self.lower}, upper = {self.upper}: the volume is empty; upper must be beyond lower",
        )

    @property
    def size(self) -> Doubles:
        """Extent along x, y and z."""
        return np.subtract(self.upper, self.lower)

    @property
    def centre(self) -> tuple[float, ...]:
        """Centre of the volume."""
        return tuple((0.5 * np.add(self.lower, self.upper)).tolist())

    def contains(self, points: Doubles) -> Flags:
        """Return whether points (..., 3) are within the volume, its lower faces included."""
        return np.asarray(((points >= self.lower) & (points < self.upper)).all(-1))

    def before(self, camera: PlenopticCamera, window: Window) -> None:
        """Refuse a volume that is not in front of a camera's main lens, or is seen in its focal plane."""
        nearest = camera.lens_data.nearest
        rule = f"before the objective, beyond z = {nearest or 0:.4g} (in mm, from the native object plane)"
        if nearest is None:
            nearest = camera.focal_length
            rule = f"in front of the main lens, which forms images of what is beyond its focus at {nearest:g} only"
        near = self.lower[2]
        near = window.seen(near, camera) if near > nearest else near
        refuse_if(near <= nearest, f"lower = {self.lower}: z = {near:g}: particles must be {rule}")

    def lenses(self, camera: PlenopticCamera, window: Window) -> float:
        """Return the number of microlenses on which the middle plane of the volume is imaged."""
        per_pitch = (camera.row_pitch / camera.bin_size(window.seen(self.centre[2], camera))) ** 2
        return float(self.size[0] * self.size[1] * per_pitch / camera.lattice.lens_area)


def _direction(name: str, value: Any) -> tuple[float, ...]:
    """Return a direction as a unit vector."""
    vector = np.array(PLACE(name, value))
    refuse_if(not vector.any(), f"{name} = {value}: it must not be 0")
    return tuple((vector / np.linalg.norm(vector)).tolist())


@suggest_keywords
@dataclass(frozen=True)
class LightSheet:
    """A sheet of unpolarised light that shines on particles, or light everywhere.

    Parameters
    ----------
    direction : (float, float, float)
        Direction in which the light travels in the fluid, in the camera frame. Default: across the axis, along x.
    thickness : float, optional
        Thickness of the sheet in mm. Default: light everywhere.
    normal : (float, float, float)
        Normal of the sheet. Default: the axis.
    centre : (float, float, float), optional
        A point in the middle of the sheet. Default: the centre of the volume.
    profile : {"even", "gaussian"}
        Irradiance across the sheet: 1 within its thickness, or a normal curve which falls to 1/e^2 at its bounds.
    """

    direction: tuple[float, ...] = (1.0, 0.0, 0.0)
    thickness: float | None = None
    normal: tuple[float, ...] = (0.0, 0.0, 1.0)
    centre: tuple[float, ...] | None = None
    profile: str = "even"

    def __post_init__(self) -> None:
        profile = partial(require_choice, choices=("even", "gaussian"))
        put_checked(
            self, direction=_direction, thickness=require_length, normal=_direction, centre=PLACE, profile=profile
        )
        refuse_if(
            self.thickness is not None and abs(float(np.dot(self.direction, self.normal))) > 1e-6,
            f"direction = {self.direction}, normal = {self.normal}: light travels along its sheet, across normal",
        )

    def irradiance(self, points: Doubles, volume: ParticleVolume) -> Doubles:
        """Return the irradiance at points (..., 3), over that in the middle of the sheet."""
        if self.thickness is None:
            return np.ones(points.shape[:-1])
        aside = (points - np.array(self.centre or volume.centre)) @ np.array(self.normal) / (self.thickness / 2)
        return np.exp(-2 * aside**2) if self.profile == "gaussian" else (np.abs(aside) <= 1).astype(float)


@suggest_keywords
@dataclass(frozen=True)
class Seeding:
    """How many particles there are, of which sizes and of which material.

    Parameters
    ----------
    per_lens : float, optional
        Particles in the volume over the microlenses on which its middle plane is imaged; give this, `per_volume` or
        `count`.
    per_volume : float, optional
        Particles in a cubic millimetre.
    count : float, optional
        Mean number of particles in the volume.
    diameter : float
        Median diameter in micrometres.
    spread : float
        Standard deviation of the logarithm of diameters, which are log-normal.
    index : complex, optional
        Refractive index of the particles, with a positive imaginary part where they absorb. Default: polystyrene. With
        None they are fluorescent beads, whose light is the same in all directions and proportional to their volume.
    medium : float
        Refractive index of the fluid. Default: water.
    window : float, optional
        Position z in mm, in the camera frame, of the plane window through which the camera looks at the fluid, from
        air or an objective's immersion. Default: the near face of the volume.
    """

    per_lens: float | None = None
    per_volume: float | None = None
    count: float | None = None
    diameter: float = 10.0
    spread: float = 0.0
    index: complex | None = 1.59
    medium: float = 1.333
    window: float | None = None

    def __post_init__(self) -> None:
        stated = 3 - [self.per_lens, self.per_volume, self.count].count(None)
        refuse_if(stated != 1, f"per_lens, per_volume, count: give one of them, not {stated}")
        density = partial(require_number, positive=True)
        put_checked(
            self,
            per_lens=density,
            per_volume=density,
            count=density,
            diameter=partial(require_number, minimum=0.01, maximum=250),
            spread=partial(require_number, minimum=0, maximum=1),
            index=_index,
            medium=_MEDIUM,
            window=require_number,
        )
        refuse_if(
            self.index == self.medium, f"index = {self.index}: as that of the medium, so that nothing is scattered"
        )

    def density(self, volume: ParticleVolume, lenses: float) -> float:
        """Return the number of particles in a cubic millimetre; refuse densities at which they hide each other."""
        contents = float(volume.size.prod())
        count = self.count or (self.per_volume or 0) * contents or (self.per_lens or 0) * lenses
        density = count / contents
        # Of log-normal diameters the mean square is above that of the median.
        section = math.pi / 4 * (self.diameter * 1e-3) ** 2 * math.exp(2 * self.spread**2)
        shadow = density * section * float(volume.size[2])
        refuse_if(
            shadow > MOST_SHADOW,
            f"{density:.3g} particles in a cubic millimetre: they cover {shadow:.0%} of the view through the volume; "
            f"as none hides another one in images, {MOST_SHADOW:.0%} at most",
        )
        refuse_if(count > MOST, f"{count:.3g} particles in the volume: {MOST:.0e} at most")
        return density

    def diameters(self, count: int, random: np.random.Generator) -> Doubles:
        """Return random diameters in micrometres, (count,)."""
        return self.diameter * np.exp(self.spread * random.normal(size=count))


def _index(name: str, value: Any) -> complex | None:
    """Return a refractive index, None for beads; files hold its real and imaginary part."""
    if value is None:
        return None
    parts = value if isinstance(value, (list, tuple)) else (getattr(value, "real", value), getattr(value, "imag", 0))
    index = complex(*require_numbers(name, parts, count=2))
    refuse_if(
        not 0.1 <= index.real <= 10 or not 0 <= index.imag <= 10,
        f"{name} = {value}: its real part must be from 0.1 to 10, and its imaginary part from 0 to 10",
    )
    return index
