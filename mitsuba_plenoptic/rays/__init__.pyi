"""What other folders and extensions may use of `rays`."""

from .edges import STAR as STAR
from .edges import lens_cells as lens_cells
from .edges import light_of_cells as light_of_cells
from .entrance import Entrances as Entrances
from .entrance import LensWindow as LensWindow
from .lens_choice import CHIEF as CHIEF
from .lens_choice import LensChoice as LensChoice
from .random_numbers import chances_of as chances_of
from .random_numbers import even_steps as even_steps
from .random_numbers import even_words as even_words
from .random_numbers import low_discrepancy as low_discrepancy
from .sensor_rays import Dispersion as Dispersion
from .sensor_rays import LensRays as LensRays
from .sensor_rays import sampler_of as sampler_of
from .tracer import Passage as Passage
from .tracer import Ray as Ray
from .tracer import Walk as Walk
from .tracer import deflects_cosines as deflects_cosines
from .tracer import detector_rows as detector_rows
from .tracer import follow_back as follow_back
from .tracer import on_plane as on_plane
from .tracer import walks_of as walks_of
