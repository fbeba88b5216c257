"""The shipped extensions: folders that can be deleted, see `mitsuba_plenoptic.extension`."""
