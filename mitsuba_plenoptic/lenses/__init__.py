"""Main lenses: thin, telecentric, collimated and real ones, each for rays and for waves."""

# Importing a lens's file registers what it builds.
from . import real_lens as real_lens
from . import telecentric as telecentric
from . import thin as thin
