"""The optical system between a scene and the detector: microlenses, sampling, and kernels in phase space."""
