"""The referee of refocused images, under the name by which the tools import it."""

from mitsuba_plenoptic.report.referee import agreement, best_shift, thin_lens_image

__all__ = ["agreement", "best_shift", "thin_lens_image"]
