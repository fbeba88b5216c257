"""The detector: its record, the linear operator from light to signals, the film that applies it, and noise."""

from .record import Detector as Detector
from .record import expose as expose
