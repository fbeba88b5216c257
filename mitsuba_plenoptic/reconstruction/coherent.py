r"""Refocusing by coherent back-propagation of the square root of a capture.

The detector has lost the phase of the light. Coherent reconstruction supplies one: under each microlens, of centre
c, the light is taken to converge from its whole micro-image towards c,

.. math:: U_0(p) = \sqrt{I(p)} \, \exp\left(-i \pi \frac{|p - c|^2}{\lambda z}\right)

and goes back by the angular spectrum to the MLA, through the microlenses :math:`\exp(-i \pi |m - c|^2 / \lambda f_2)`,
to the main lens :math:`\exp(-i \pi P^2 / \lambda f_1)` and its pupil, and to the object plane, where
:math:`|U|^2` is summed over bins.

Why the microlens acts a second time
------------------------------------
The converging phase undoes what the microlens did on the way in, and it is tempting to go straight on to the main
lens. But at its focus in the MLA plane, a field that converges from z away is the Fourier transform of
:math:`\sqrt{I}` *times* :math:`\exp(i \pi |m - c|^2 / \lambda z)` (Goodman, "Introduction to Fourier Optics", section
5.2). If that factor stays, the light that reaches the main lens is not the micro-image enlarged but the micro-image
after :math:`(\lambda z)^{1/2}` of Fresnel blur: 18 um of a micro-image of 43 um for the paper's camera, where a
microlens has the Fresnel number 1.4. A blurred micro-image is a blurred pupil: every ray's direction is uncertain, and
planes out of focus come out with doubled edges, the more the farther they are. The microlens's own phase cancels the
factor (exactly for z = f2), and the pupil holds :math:`\sqrt{I}` itself. ``relay=False`` leaves it out, to show this.

Focused cameras
---------------
The two phases are right for :math:`z \neq f_2`, too. The chief ray of a pixel goes through the centre of its lens, so
light converges to there over z; and what is left after the microlens, :math:`\exp(-i \pi |m - c|^2 / \lambda a)`, makes
it converge once more, to :math:`\sqrt{I}` itself in the plane that the microlens sees, a before the MLA (or behind it)
with :math:`1/a + 1/z = 1/f_2`: the micro-image, enlarged, where the main lens's image is. Where micro-images are smooth
the light goes through a small part of the lens only, and what came from the rim of the pupil through the rim of a lens
misses the pupil on its way back; images are divided by what a white scene gives.
"""

from __future__ import annotations

import numpy as np

from .full_fields import reconstruct_subsets
from .methods import Task, method
from .waves import refocus_by_waves


@method("coherent", options=("relay",), waves=True)
def refocus(task: Task, *, relay: bool) -> list[np.ndarray]:
    """Follow the light back as one coherent wave."""
    return refocus_by_waves(task, reconstruct_subsets, relay=relay)
