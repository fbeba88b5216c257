"""Fields of light on their way through a camera, as chains of links with forward and adjoint.

A chain leads a sampled field from plane to plane: from the exit pupil to the array and the detector, for scene points
(`points.full_fields`) and their coherent sums (extension `laser`); from the detector back to the array, the main lens
and the object planes (`refocus.wave_methods`); or to the array alone (`refocus.lens_by_lens`). Each link is an element,
such as the microlenses, and free space behind it. A field runs through all links in blocks of rows, in memory that the
links share.

The files, from a field's samples to the camera that it crosses:

- `steps`: samples in a plane, and those in the next one.
- `workspace`: the memory, blocks of rows, and the Fourier transforms in them.
- `elements`: lines, functions and samples that multiply a field: microlenses, light made to converge.
- `links`: the chain and its links: `Hop` over free space to other samples, `Fresnel` by one transform, `Spectrum` to
  directions and `FromSpectrum` from them.
- `watch`: powers that guards compare while a field streams by.
- `transmittance`: the transmission of the array. `microlens_orders`: the same as a sum of diffraction orders, for grids
  that can not hold the steepest. `lens_kinds`: lenses of irregular arrays that count as equal.
- `optical_system`: a camera at one wavelength. `accuracy`: the numbers that settle how exact all this is.

`optics.waves` has the transfer function of free space, and `optics.waves.propagate`, the step of a whole field between
two equal grids, for users. Patches of points (`points.patch`) have small grids of their own.

`__init__.pyi` names what other folders and extensions may use; it is imported when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)
