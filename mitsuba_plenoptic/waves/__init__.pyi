"""What other folders and extensions may use of `waves`."""

from .accuracy import DEFAULT_ACCURACY as DEFAULT_ACCURACY
from .control_variate import mean_of_half as mean_of_half
from .control_variate import of_other_half as of_other_half
from .phase_space import FINE as FINE
from .scheme import check_screen as check_screen
from .signed_camera import require_parameters as require_parameters
from .signed_capture import SignedCapture as SignedCapture
from .signed_capture import SignedGradients as SignedGradients
from .signed_rays import RaySum as RaySum
from .spectral_nodes import Node as Node
from .spectral_nodes import WavelengthSampler as WavelengthSampler
from .spectral_nodes import mixed as mixed
from .white_capture import WhiteCapture as WhiteCapture
