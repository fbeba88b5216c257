"""What other folders and extensions may use of `linear`."""

from .map import LinearMap as LinearMap
from .noise import PixelNoise as PixelNoise
from .noise import dark_variance as dark_variance
from .noise import misfit as misfit
from .solver import RichardsonLucy as RichardsonLucy
from .solver import Sirt as Sirt
from .solver import Smart as Smart
from .solver import SolverState as SolverState
from .solver import Steps as Steps
from .solver import StopRule as StopRule
from .solver import relative_residual as relative_residual
from .solver import solve as solve
