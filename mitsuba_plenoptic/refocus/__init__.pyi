"""What other folders and extensions may use of `refocus`."""

from . import planning as planning
from .api import reconstruct as reconstruct
from .bins import BinSums as BinSums
from .conjugates import ThinConjugates as ThinConjugates
from .estimates import estimate_reconstruction as estimate_reconstruction
from .lens_by_lens import fine_bins as fine_bins
from .methods import METHODS as METHODS
from .methods import Found as Found
from .methods import Progress as Progress
from .methods import Task as Task
from .methods import method as method
from .methods import portion as portion
from .methods import registered as registered
from .methods import require_distances as require_distances
from .methods import used_by as used_by
from .methods import work_of as work_of
from .projection import pupil_radius as pupil_radius
from .projection import ray_sums as ray_sums
from .projection import ray_sums_vjp as ray_sums_vjp
from .radiance import LensSpread as LensSpread
from .radiance import captures as captures
from .radiance import divisors as divisors
from .radiance import is_reached as is_reached
from .radiance import lens_scale as lens_scale
from .radiance import to_radiance as to_radiance
from .radiance import white_pixels as white_pixels
from .radiance import white_sums as white_sums
from .results import Reconstruction as Reconstruction
from .results import Volume as Volume
from .results import read_reconstruction as read_reconstruction
from .results import require_volume_path as require_volume_path
from .results import write_reconstruction as write_reconstruction
from .results import write_volume as write_volume
from .straight import regular_place as regular_place
from .straight import straightened as straightened
from .wave_methods import BackwardFields as BackwardFields
from .wave_methods import signed_parts as signed_parts

FOOTPRINTS: tuple[str, ...]
