"""What other folders and extensions may use of `prescription`."""

from . import lens_data as lens_data
from .collimator import Collimator as Collimator
from .glass import LINE_C as LINE_C
from .glass import LINE_D as LINE_D
from .glass import LINE_F as LINE_F
from .glass import Glass as Glass
from .glass import catalogue_glass as catalogue_glass
from .glass import known_glass as known_glass
from .lens_data import SINGLE as SINGLE
from .lens_data import THIN as THIN
from .lens_data import LensData as LensData
from .lens_data import conjugate_distance as conjugate_distance
from .lens_data import defocus_factor as defocus_factor
from .lens_data import even_count as even_count
from .lens_data import image_distance as image_distance
from .lens_data import vergence as vergence
from .lens_file import known_lens as known_lens
from .lens_file import read_lens as read_lens
from .lens_file import read_prescription as read_prescription
from .objective import Objective as Objective
from .surfaces import LEAST as LEAST
from .surfaces import Paraxial as Paraxial
from .surfaces import Prescription as Prescription
from .surfaces import Surface as Surface
from .surfaces import height as height
from .surfaces import paraxial as paraxial
