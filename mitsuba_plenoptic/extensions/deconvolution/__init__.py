"""Extension `deconvolution`: object planes from a camera's response, by its adjoint and by inversion.

`cells` divides bins and detector into parts that repeat from lens to lens, `response` and `fourier` compute the light
on the detector from the bins of one part, `kernels` keeps the parts that are not dark, and `linear` inverts the
response as far as the noise allows (`variation`). Methods `incoherent` and `deconvolved` use them.
"""

from ...extension import Extension

EXTENSION = Extension(
    methods={"incoherent": "incoherent", "deconvolved": "deconvolved"},
    options={"deconvolved": "options:DeconvolvedOptions"},
    hooks={"price of a response": "fourier:response_seconds"},
)
