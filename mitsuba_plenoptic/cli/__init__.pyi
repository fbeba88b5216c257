"""What extensions may use of `cli`."""

from . import inputs as inputs
from . import options as options
from . import stopping as stopping
from .program import COMMANDS as COMMANDS
from .program import PROGRAM as PROGRAM
from .program import command_group as command_group
from .program import load as load
from .program import main as main
from .signatures import options_of as options_of
