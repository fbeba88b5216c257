"""A stand-in for Optiland where it is not installed: the glasses that the lens files of the tests name."""
