"""Linear maps of light to pixels, the solver that inverts them for light that is never negative, and pixels' noise."""
