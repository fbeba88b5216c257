"""Wave captures: the light of incoherent scenes by signed rays.

Light of an incoherent scene is described in phase space, by a Wigner function: a density over positions and directions
that may be negative. Through each lens it moves along rays; the edge of a pupil or of a microlens spreads it. A capture
draws the rays of a ray capture, gives each ray coefficients of either sign, one for each function that describes where
the edges diffract, sums the coefficients in images over the pixels, and convolves each image with its kernel.

The files in the order in which light passes them:

`scheme` chooses between cameras with and without microlenses. `ray_sampler` draws rays through microlenses, and
`pupil_sampler` those of cameras without an array. `phase_space` and `pupil_diffraction` plan the diffraction: which
functions and kernels a camera needs, by `array_kernels`, `array_field`, `lens_functions`, `oblique`, `fitted_pupil` and
`pupil_samples`; `expansion` plans cameras near another one. `spectral_nodes` chooses wavelengths. `signed_rays` is the
estimator, which traces, weighs and sums, with the control variate of `control_variate`; `pixel_kernels` and
`convolution` make images of the sums. `signed_capture` is a capture with its cost and the derivatives by a scene;
`signed_camera` those by a camera; `white_capture` is that of white. The numbers on which the accuracy depends are the
records of `accuracy`.

`__init__.pyi` names what other folders and extensions may use; it is imported when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)
