"""Particles in a volume, and the light sheet that shines on them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...errors import put, refuse_if, require_choice, require_length, require_number, require_numbers, suggest_keywords
from ...runtime import Doubles

Record = TypeVar("Record")

MOST = 10**7
"""Particles at most."""

MOST_SHADOW = 0.1
"""Part of the volume's front that the particles' cross-sections cover, at most: they do not hide each other."""

PROFILES = ("even", "gaussian")


@suggest_keywords
@dataclass(frozen=True)
class ParticleVolume:
    """The box in which particles are recorded, in millimetres of the camera frame.

    Parameters
    ----------
    lower, upper : (float, float, float)
        Corners: x, y and z: the distance from the main lens, or the depth beyond a microscope's native object plane.

    Raises
    ------
    InputError
        If the box has no extent along an axis.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            put(self, **{name: require_numbers(name, getattr(self, name), count=3, minimum=-1e9, maximum=1e9)})
        empty = any(low >= high for low, high in zip(self.lower, self.upper, strict=True))
        refuse_if(empty, f"lower = {self.lower}, upper = {self.upper}: the volume is empty; upper must be beyond lower")

    @property
    def size(self) -> Doubles:
        """Extent along x, y and z."""
        return np.array(self.upper) - np.array(self.lower)

    @property
    def centre(self) -> tuple[float, ...]:
        """Centre of the volume."""
        return tuple((0.5 * np.add(self.lower, self.upper)).tolist())

    def contains(self, points: Doubles) -> NDArray[np.bool_]:
        """Return whether points (..., 3) are within the volume, its lower faces included."""
        return np.asarray(((points >= self.lower) & (points < self.upper)).all(-1))

    def before(self, camera: PlenopticCamera) -> None:
        """Refuse a volume that is not in front of a camera's main lens, or reaches its focal plane."""
        near = self.lower[2]
        far = self.upper[2]
        nearest = camera.lens_data.nearest
        if nearest is not None:
            refuse_if(
                near <= nearest,
                f"lower = {self.lower}: z = {near:g}: particles must be before the objective, beyond z = {nearest:.4g} "
                "(in mm, from the native object plane)",
            )
            return
        refuse_if(near <= 0, f"lower = {self.lower}: z = {near:g}: particles must be in front of the main lens")
        refuse_if(
            near <= camera.focal_length,
            f"lower = {self.lower}, upper = {self.upper}: z = {near:g} to {far:g}: the main lens forms images of what "
            f"is beyond its focus at {camera.focal_length:g} only",
        )

    def lenses(self, camera: PlenopticCamera) -> float:
        """Return the number of microlenses on which the middle plane of the volume is imaged."""
        per_pitch = (camera.mla_pitch / camera.bin_size(self.centre[2])) ** 2
        return float(self.size[0] * self.size[1] * per_pitch / camera.lattice.lens_area)


@suggest_keywords
@dataclass(frozen=True)
class LightSheet:
    """A sheet of unpolarised light that shines on particles, or light everywhere.

    Parameters
    ----------
    direction : (float, float, float)
        Direction in which the light travels, in the camera frame. Default: across the axis, along x.
    thickness : float, optional
        Thickness of the sheet in mm. Default: light everywhere.
    normal : (float, float, float)
        Normal of the sheet. Default: the axis.
    centre : (float, float, float), optional
        A point in the middle of the sheet. Default: the centre of the volume.
    profile : {"even", "gaussian"}
        Irradiance across the sheet: 1 within its thickness, or a normal curve which falls to 1/e^2 at its bounds.

    Raises
    ------
    InputError
        If a direction is 0, or light does not travel in the sheet.
    """

    direction: tuple[float, ...] = (1.0, 0.0, 0.0)
    thickness: float | None = None
    normal: tuple[float, ...] = (0.0, 0.0, 1.0)
    centre: tuple[float, ...] | None = None
    profile: str = "even"

    def __post_init__(self) -> None:
        for name in ("direction", "normal"):
            vector = np.array(require_numbers(name, getattr(self, name), count=3, minimum=-1e9, maximum=1e9))
            length = float(np.linalg.norm(vector))
            refuse_if(length == 0, f"{name} = {getattr(self, name)}: it must not be 0")
            put(self, **{name: tuple((vector / length).tolist())})
        require_choice("profile", self.profile, PROFILES)
        if self.thickness is not None:
            put(self, thickness=require_length("thickness", self.thickness))
            refuse_if(
                abs(float(np.dot(self.direction, self.normal))) > 1e-6,
                f"direction = {self.direction}, normal = {self.normal}: light travels along its sheet, across normal",
            )
        if self.centre is not None:
            put(self, centre=require_numbers("centre", self.centre, count=3, minimum=-1e9, maximum=1e9))

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
        Particles in the volume over the microlenses on which its middle plane is imaged. Give this, `per_volume` or
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
        Refractive index of the fluid, in which the camera is, too. Default: water.

    Raises
    ------
    InputError
        If a value is out of range, or there is not exactly one density.
    """

    per_lens: float | None = None
    per_volume: float | None = None
    count: float | None = None
    diameter: float = 10.0
    spread: float = 0.0
    index: complex | None = 1.59
    medium: float = 1.333

    def __post_init__(self) -> None:
        stated = [name for name in ("per_lens", "per_volume", "count") if getattr(self, name) is not None]
        refuse_if(len(stated) != 1, f"per_lens, per_volume, count: give one of them, not {len(stated)}")
        put(self, **{stated[0]: require_number(stated[0], getattr(self, stated[0]), positive=True)})
        put(
            self,
            diameter=require_number("diameter", self.diameter, minimum=0.01, maximum=250),
            spread=require_number("spread", self.spread, minimum=0, maximum=1),
            medium=require_number("medium", self.medium, minimum=1, maximum=5),
        )
        if self.index is None:
            return
        index = complex(self.index)
        refuse_if(
            not 0.1 <= index.real <= 10 or not 0 <= index.imag <= 10,
            f"index = {self.index}: its real part must be from 0.1 to 10, and its imaginary part from 0 to 10",
        )
        refuse_if(index == self.medium, f"index = {self.index}: as that of the medium, so that nothing is scattered")

    def density(self, volume: ParticleVolume, camera: PlenopticCamera) -> float:
        """Return the number of particles in a cubic millimetre; refuse densities at which they hide each other."""
        contents = float(volume.size.prod())
        if self.per_volume is not None:
            density = self.per_volume
        elif self.count is not None:
            density = self.count / contents
        else:
            assert self.per_lens is not None
            density = self.per_lens * volume.lenses(camera) / contents
        # Of log-normal diameters the mean square is above that of the median.
        section = math.pi / 4 * (self.diameter * 1e-3) ** 2 * math.exp(2 * self.spread**2)
        shadow = density * section * float(volume.size[2])
        refuse_if(
            shadow > MOST_SHADOW,
            f"{density:.3g} particles in a cubic millimetre: they cover {shadow:.0%} of the view through the volume; "
            f"as none hides another one in images, {MOST_SHADOW:.0%} at most",
        )
        refuse_if(density * contents > MOST, f"{density * contents:.3g} particles in the volume: {MOST:.0e} at most")
        return density

    def diameters(self, count: int, random: np.random.Generator) -> Doubles:
        """Return random diameters in micrometres, (count,)."""
        return np.asarray(self.diameter * np.exp(self.spread * random.normal(size=count)))


def from_plain(kind: type[Record], values: dict[str, Any]) -> Record:
    """Return a record made of plain values, in which a complex number is a pair."""
    index = values.get("index")
    return kind(**values | ({"index": complex(*index)} if isinstance(index, (list, tuple)) else {}))
