"""The point spread of a scene point by rays: samples of the pupil, followed to the detector."""

import math
from dataclasses import replace

import numpy as np

from ..camera import PlenopticCamera, Use, require_support
from ..fields import OpticalSystem, has_response
from ..lenses import ClosedLens, FourierLens
from ..optics import second_leg
from ..rays import Passage, Walk
from ..runtime import Doubles

_TOGETHER = 2**18


def ray_spread(
    camera: PlenopticCamera, point: Doubles, pupil_samples: Doubles, wavelength: float | None = None
) -> Doubles:
    """Return the fractions (rows, columns) of the light of a point (3,) through the pupil that rays bring to pixels.

    The point radiates evenly in all directions, as that of waves does. Samples (n, 2) are in radii of the pupil. The
    detector's blur is left out. Without a wavelength glasses refract as they do at the line d.
    """
    require_support(camera, Use.RAY_SPREADS)
    system = OpticalSystem.by_design(camera)
    if wavelength is not None:
        system = OpticalSystem(camera.at_wavelength(wavelength), wavelength)
    camera, lens = system.camera, system.waves_of(point[None])
    light = lens.bind(point[None])
    walk = Walk.of(camera, lens) if camera.has_array else None
    if walk is not None and wavelength is not None and camera.mla_shape is not None:
        walk = replace(walk, focal_lengths=walk.focal_lengths / camera.mla_shape.strength(wavelength))
    counts = second_leg(camera.pixel_response, camera.mla_absorption or 0.0, np.ndarray)
    rows, columns = camera.shape
    image = np.zeros(rows * columns)
    emitted = 0.0
    for samples in np.array_split(pupil_samples, math.ceil(len(pupil_samples) / _TOGETHER)):
        pupil = samples[:, 0] * lens.pupil.radius, samples[:, 1] * lens.pupil.radius
        x, y, z = (np.full(len(samples), value) for value in point)
        radii = pupil[0] / camera.pupil_radius, pupil[1] / camera.pupil_radius
        power = np.where(light.is_open(pupil), light.amplitude(pupil, (x, y, z)) ** 2, 0.0).ravel()
        power *= camera.aperture.power(*radii)
        emitted += power.sum()
        on_array = tuple(np.ravel(axis) for axis in light.land(pupil, (x, y, z)))
        if camera.vignetting is not None:
            power *= camera.vignetting.power(*radii, *on_array)
        landed = on_array
        before = pupil
        depth = lens.pupil.distance
        if walk is not None:
            lenslet = walk.lenslet(*walk.lattice.cell(*on_array))
            aside = (at - c for at, c in zip(on_array, lenslet.centre, strict=True))
            power *= lenslet.gain * walk.lattice.in_aperture(*aside)
            before = (on_array[0], on_array[1])
            depth = camera.detector_distance
            window = lens.in_window(pupil, (x, y, z)) if isinstance(lens, ClosedLens) else pupil
            landed, _ = walk.onto_detector(window, Passage(before, lenslet))
            if isinstance(lens, FourierLens):
                power *= lens.field_inset(*window) >= 0
        if has_response(camera):
            power *= counts(np.hypot(landed[0] - before[0], landed[1] - before[1]), depth)
        column, row = (
            np.floor(p / camera.pixel_size + size / 2 - offset).astype(np.int64)
            for p, size, offset in zip(landed, camera.resolution, camera.crop_offset, strict=True)
        )
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        image += np.bincount((row * columns + column)[inside], power[inside], rows * columns)
    return (image / max(emitted, math.ulp(0))).reshape(rows, columns)
