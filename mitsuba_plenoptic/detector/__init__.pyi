"""What other folders and extensions may use of `detector`."""

from .film import behind_detector as behind_detector
from .noise import PARTS as PARTS
from .noise import NonNegative as NonNegative
from .noise import PassSpread as PassSpread
from .noise import keep_spread as keep_spread
from .noise import variance_left as variance_left
from .noise import with_spread as with_spread
from .operator import SHARP as SHARP
from .operator import DetectorOperator as DetectorOperator
from .record import Detector as Detector
from .record import expose as expose
from .record import filters as filters
