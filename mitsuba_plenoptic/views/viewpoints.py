"""Two-dimensional slices of a light field: views, mosaics of views, epipolar images."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from ..choices import Axis
from ..errors import refuse_if, require_choice, require_count, require_number, suggest_keywords
from ..runtime import Array
from .coordinates import require_light_field


@suggest_keywords
def view(lf: xr.DataArray, *, u: float | None = None, v: float | None = None) -> xr.DataArray:
    """Return the sub-aperture view nearest to a point of the pupil.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field, (v, u, t, s[, c]).
    u, v : float, optional
        Point on the pupil in the light field's coordinates (millimetres where it has a camera). Default: the view
        nearest to the pupil's middle.

    Returns
    -------
    xarray.DataArray
        Dimensions t, s[, c]; upright, with the scalar coordinates u and v of the view.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> lf = mp.decode(mp.example("letters-ray"))
    >>> left = mp.views.view(lf, u=2, v=0)  # 2 mm left of the pupil's middle, or nearest to it
    >>> left.dims, float(left.u)
    (('t', 's'), 1.875)
    """
    lf = require_light_field(lf)
    nearest = _nearest(lf, u=("u", u), v=("v", v))
    if "slope_x" not in lf.coords or nearest["weight"].values.any():
        return nearest
    # Lenses of a Fourier microscope do not fill their columns and rows.
    away = (lf["u"] - (u or 0.0)) ** 2 + (lf["v"] - (v or 0.0)) ** 2
    return lf.isel(away.where(lf["weight"].max(("t", "s")) > 0).argmin(("v", "u")))


def as_view(lf: xr.DataArray, image: Array) -> xr.DataArray:
    """Return an image (t, s[, c]) with the coordinates and attributes of a light field's views."""
    dims = ("t", "s", "c")[: image.ndim]
    return xr.DataArray(image, dims=dims, coords={dim: lf[dim] for dim in dims}, name="radiance", attrs=lf.attrs)


def pick_views(lf: xr.DataArray, count: int) -> xr.DataArray:
    """Return `count` views along each axis, from the middles of equal parts of the pupil.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field, (v, u, t, s[, c]).
    count : int
        Views along each axis.
    """
    lf = require_light_field(lf)
    count = require_count("count", count, maximum=min(lf.shape[:2]))
    middles = (np.arange(count) + 0.5) / count
    return lf.isel({axis: np.floor(middles * lf.sizes[axis]).astype(int) for axis in ("v", "u")})


def view_mosaic(lf: xr.DataArray) -> Array:
    """Return the views side by side, arranged as on the pupil seen from behind the camera.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field, (v, u, t, s[, c]).

    Returns
    -------
    (v t, u s[, 3]) array
    """
    values = require_light_field(lf).values
    v, u, t, s = values.shape[:4]
    return values.swapaxes(1, 2).reshape(v * t, u * s, *values.shape[4:])


def lens_mosaic(lf: xr.DataArray) -> Array:
    """Return the samples (t v, s u[, 3]) of each lens together, as with an integer number of pixels per lens."""
    values = lf.values
    v, u, t, s = values.shape[:4]
    return values.transpose(2, 0, 3, 1, *range(4, values.ndim)).reshape(t * v, s * u, *values.shape[4:])


@suggest_keywords
def epipolar_image(
    lf: xr.DataArray, axis: str = "horizontal", *, at: float | None = None, through: float | None = None
) -> xr.DataArray:
    """Return an epipolar image: one line of the field from all views along one line of the pupil.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field, (v, u, t, s[, c]).
    axis : {"horizontal", "vertical"}
        Direction of both lines: along u and s, or along v and t.
    at : float, optional
        Position of the line in the field: t of a horizontal, s of a vertical one; the nearest line is taken. Default:
        the one nearest to the axis.
    through : float, optional
        Position of the line on the pupil: v of a horizontal, u of a vertical one; the nearest line is taken. Default:
        the one nearest to the pupil's middle.

    Returns
    -------
    xarray.DataArray
        Dimensions u, s[, c], or v, t[, c].
    """
    lf = require_light_field(lf)
    require_choice("axis", axis, Axis)
    field, pupil = ("t", "v") if axis == "horizontal" else ("s", "u")
    return _nearest(lf, **{field: ("at", at), pupil: ("through", through)})


def _nearest(lf: xr.DataArray, **positions: tuple[str, float | None]) -> xr.DataArray:
    """Return the samples nearest to given positions on axes; None means nearest to the middle."""
    targets = dict.fromkeys(positions, 0.0)
    for axis, (name, value) in positions.items():
        if value is None:
            continue
        targets[axis] = require_number(name, value)
        samples = np.sort(lf[axis].values)
        # Of a single sample there is nothing to choose, and no step is known.
        reach = (samples[-1] - samples[0]) / (len(samples) - 1) / 2 if len(samples) > 1 else math.inf
        low = samples[0] - reach
        high = samples[-1] + reach
        # Rounding must not refuse the border itself.
        margin = 1e-6 * reach if math.isfinite(reach) else 0.0
        refuse_if(
            not low - margin <= targets[axis] <= high + margin,
            f"{name} = {targets[axis]:g}: the light field goes from {low:.4g} to {high:.4g} there",
        )
    return lf.sel(targets, method="nearest")
