"""What other folders and extensions may use of `optics`."""

from . import colour as colour
from . import guards as guards
from . import rays as rays
from .rays import second_leg as second_leg
from .spectrum import MOST_WAVELENGTHS as MOST_WAVELENGTHS
from .spectrum import RGB_WAVELENGTHS as RGB_WAVELENGTHS
from .spectrum import WAVELENGTHS as WAVELENGTHS
from .spectrum import Spectrum as Spectrum
from .spectrum import Table as Table
from .spectrum import interpolated as interpolated
from .spectrum import read_responses as read_responses
from .waves import EDGE as EDGE
from .waves import advance as advance
from .waves import band_edge_fraction as band_edge_fraction
from .waves import fraction as fraction
from .waves import frequencies_of as frequencies_of
from .waves import in_millimetres as in_millimetres
from .waves import parabola as parabola
from .waves import phasor as phasor
from .waves import power as power
from .waves import power_by_row as power_by_row
from .waves import rim as rim
from .waves import smooth_edge as smooth_edge
from .waves import soft_edge as soft_edge
from .waves import transfer as transfer
