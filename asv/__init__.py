"""The history of the ten figures that matter, by ``asv run`` and ``asv publish``."""
