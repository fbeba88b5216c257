"""Relations of refocused images by every method: lamps at their places, with their light; crops; wavelengths."""

import numpy as np
from of_captures import METHODS, off_bins
from of_points import IRREGULAR, same_array
from relation import image_of, relation

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.camera.entry import Use
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import radiance_weight


def filled_bin(camera, row, column, g, wavelength, parts):
    """Return the capture of a bin of radiance 1 in a plane, of some points along its sides."""
    size, known = camera.row_pitch, camera.at_wavelength(wavelength)
    inside = (np.arange(parts) + 0.5) / parts
    x, y = ((index + inside - count / 2) * size for index, count in zip((column, row), camera.bin_count, strict=True))
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    points = np.column_stack([-places * g / camera.mla_distance, np.full(len(places), g)])
    weight = radiance_weight(known, main_lens(known, wavelength), size**2) / len(points)
    return image_of(camera, points, wavelength, np.full(len(points), weight)).astype(np.float32)


def refocused(camera, image, g, method, wavelength, iterations=2):
    """Return the image, and what is known of it; without a wavelength deconvolved by rays."""
    options = {} if method == "ray" or wavelength is None else {"wavelength": wavelength}
    options |= {"iterations": iterations} if method == "deconvolved" else {}
    result = mp.reconstruct(image, g, camera=camera, method=method, **options)
    return result.image, result.facts


def of_method(method):
    """Add the relations of images by one method."""

    def lamp(draw):
        """A bin that shines is found where it is; by deconvolution with its light, which the response explains."""
        camera, g = draw.camera, draw.point()[2]
        row, column = (int(draw.rng.integers(count // 2 - 1, count // 2 + 1)) for count in camera.bin_count[::-1])
        fine = (8 if "mla_transmissions" in draw.options else 3) if method == "deconvolved" else 1
        recorded = filled_bin(camera, row, column, g, draw.wavelength, fine)
        image, facts = refocused(camera, recorded, g, method, draw.wavelength, 60)
        near = np.nan_to_num(image[row - 2 : row + 3, column - 2 : column + 3]).astype(float)
        peak = np.maximum(near - 0.3 * near.max(), 0)
        away = [float((peak.sum(axis) * np.arange(-2, 3)).sum() / peak.sum()) for axis in (0, 1)]
        # Lenses whose cells shrink behind oblique chief rays record more than those of the nearest regular array.
        limit = 0.08 if "mla_cra" in draw.options else 0.03
        light = (abs(near.sum() - 1) / limit, facts["residual"] / 0.25) if method == "deconvolved" else ()
        return max(np.hypot(*away) / 0.4, *light, 0.0), 1.0

    def part(draw):
        """A crop shows its part of the whole, but for the lenses at its rim, and nothing beyond."""
        camera, g = draw.camera, draw.camera.focus_distance * float(draw.rng.uniform(0.997, 1.003))
        image, count = draw.rng.random(camera.shape, np.float32), camera.resolution[0]
        offset, size = draw.rng.integers(0, count // 4, 2), draw.rng.integers(5 * count // 8, 3 * count // 4, 2)
        cropped = camera.replace(crop_offset=tuple(offset.tolist()), crop_size=tuple(size.tolist()))
        window = np.s_[offset[1] : offset[1] + size[1], offset[0] : offset[0] + size[0]]
        (whole, _), (some, _) = (
            refocused(each, pixels, g, method, None if method == "deconvolved" else draw.wavelength)
            for each, pixels in ((camera, image), (cropped, np.ascontiguousarray(image[window])))
        )
        columns, rows = (
            slice(int(np.ceil(o * n / count)) + 1, int((o + s) * n / count) - 1)
            for o, s, n in zip(offset, size, camera.bin_count, strict=True)
        )
        beyond = np.ones(some.shape, bool)
        beyond[max(rows.start - 3, 0) : rows.stop + 3, max(columns.start - 3, 0) : columns.stop + 3] = False
        if np.isfinite(some[beyond]).any():
            return np.inf, 0.0
        return off_bins(some[rows, columns], whole[rows, columns]), 0.06

    def wavelengths(draw):
        """Channels are those of captures of their wavelengths."""
        image, g = draw.rng.random((*draw.camera.shape, 3), np.float32), draw.point()[2]
        given = (draw.wavelength, 500.0, draw.wavelength)
        together = mp.reconstruct(mp.Capture(image, draw.camera, given), g, method=method).image
        return max(
            off_bins(
                together[..., i],
                mp.reconstruct(mp.Capture(image[..., i], draw.camera, given[i]), g, method=method).image,
            )
            for i in (1, 2)
        ), 2e-3

    def array(draw):
        """An array turned or moved onto itself has the same image; behind oblique chief rays next to the same."""
        recorded = image_of(draw.camera, [draw.point(2.0) for _ in range(5)], draw.wavelength).astype(np.float32)
        g = draw.camera.focus_distance * float(draw.rng.choice([0.93, 1.1]))
        cameras = same_array(draw), draw.camera
        images = (refocused(camera, recorded, g, method, draw.wavelength)[0] for camera in cameras)
        return off_bins(*images), 2e-3 if "mla_cra" in draw.options else 2e-5

    costly = "mla_focal_length vignetting" if METHODS[method] is Use.RESPONSES else ""
    for judge, use in ((lamp, Use.POINTS), (part, Use(0)), (wavelengths, Use(0)), (array, Use.POINTS)):
        if method not in OTHERWISE[judge.__name__]:
            # Aberrations spread the light of a bin over several lenses, so that crops have light from beyond.
            aberrated = "glass lens_model wavefront" if judge is part else ""
            uneven = IRREGULAR if judge is array else ""
            without = f"crop_offset crop_size stray_light stray_width main_lens {costly} {aberrated} {uneven}"
            judge.__name__ = f"{judge.__name__}_{method}"
            relation(METHODS[method] | use, without, method)(judge)


OTHERWISE = {
    "lamp": ("incoherent",),
    "part": ("partial", "incoherent"),
    "wavelengths": ("ray", "partial", "incoherent", "deconvolved"),
    "array": ("incoherent", "deconvolved"),
}
"""Methods whose relation would say nothing, or is that of another one."""

for each in METHODS:
    of_method(each)
