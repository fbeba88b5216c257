"""Elements that fields of light pass: microlenses, their diffraction orders, and a camera at one wavelength."""
