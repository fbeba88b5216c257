"""Extension `data`: data sets of random scenes.

Data sets of dual pixels need the extension `onchip`.
"""

from ...extension import Extension

EXTENSION = Extension(modules={"dataset": "dataset"}, commands={"dataset": "dataset_command"})
