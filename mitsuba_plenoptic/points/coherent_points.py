"""Complex fields of mutually coherent points, and their adjoints: what `CaptureOperator` has of extension `laser`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import require_choice
from ..optics import guards
from ..runtime import Doubles, Sizes, active_backend, as_array, one_at_a_time
from .arrival import SampledField

PLANES = ("pupil", "array", "detector")
"""Planes in which fields are computed: just behind the main lens, just before the microlenses, and on the detector."""


class CoherentPoints:
    """Points whose light may add coherently, as fields, which `coherent_fields` computes together."""

    points: Doubles
    coherent_fields: Any

    @one_at_a_time
    def field(self, amplitudes: Any, *, plane: str = "detector") -> SampledField:
        r"""Return the sum of the complex fields of all points, which are mutually coherent, each with an amplitude.

        .. math:: U(p) = \sum_r a_r \, u_r(p)

        where the point spread of `forward` is the integral of :math:`|u_r|^2` over a pixel, apart from the light that
        the method "patch" leaves out. The phase of an amplitude is the phase of the point's field at the centre of the
        pupil. Points of similar distance are propagated together: the time depends little on their number. The main
        lens must be thin, and there must be one wavelength and no `pupil_weights`.

        Parameters
        ----------
        amplitudes : complex array (n,)
            Amplitudes; their squared moduli are weights as in `forward`.
        plane : {"detector", "array", "pupil"}
            Plane of the field: on the detector, just before the microlenses, or just behind the main lens.

        Returns
        -------
        SampledField
            ``samples``, complex64 (rows, columns), on the camera-frame x and y of ``origin``, the first sample, and of
            those that follow at distances of ``pitch``, in millimetres. The integral of the squared modulus is the
            power that passes the pupil, less what misses the window.

        Raises
        ------
        PhysicsError
            If too much of the light is lost.

        Examples
        --------
        >>> import mitsuba_plenoptic as mp
        >>> camera = mp.PlenopticCamera(detector_width=0.128, resolution=(64, 64), aperture_radius=2)
        >>> operator = mp.CaptureOperator(camera, [(-0.01, 0, 240), (0.01, 0, 240)], wavelength=633)
        >>> field = operator.field([1, 1j], plane="array")
        >>> operator.field_adjoint(field.samples, plane="array").shape
        (2,)
        """
        amplitude = _complex("amplitudes", amplitudes, (len(self.points),))
        with guards.watch():
            field = self.coherent_fields.at(amplitude, require_choice("plane", plane, PLANES))
        return SampledField(active_backend().to_host(field.samples), field.origin, field.pitch)

    @one_at_a_time
    def field_adjoint(self, samples: Any, *, plane: str = "detector") -> NDArray[np.complex64]:
        r"""Return the inner product of every point's field with a field's samples, the adjoint of `field`.

        Parameters
        ----------
        samples : complex array (rows, columns)
            Samples in the plane, on the grid of `field`.
        plane : {"detector", "array", "pupil"}
            The plane, as in `field`.

        Returns
        -------
        complex64 array (n,)
            :math:`\sum_p \overline{u_r(p)} \, s_p` for each point r.

        Raises
        ------
        InputError
            As for `field`.
        """
        fields = self.coherent_fields
        shape = fields.shape(require_choice("plane", plane, PLANES))
        field = _complex("samples", samples, shape)
        return fields.adjoint(field, plane)


def _complex(name: str, values: Any, shape: Sizes) -> NDArray[np.complex64]:
    """Return values as a complex array of a shape; refuse anything else."""
    rule = "they must be complex numbers"
    return np.ascontiguousarray(as_array(name, values, dtype=np.complex64, rule=rule, shape=shape))
