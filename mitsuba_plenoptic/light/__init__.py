"""From a scene to the pixels that the detector records, by rays and by waves."""
