"""Extension `paper`: the study of the paper, with its figures, times and conclusions computed again.

Pictures of real light are read by the extension `calibrate`, and deconvolved by `deconvolution`.
"""

from ...extension import Extension

EXTENSION = Extension(commands={"reproduce": "reproduce_command"})
