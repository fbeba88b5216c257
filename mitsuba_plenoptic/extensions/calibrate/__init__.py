"""Extension calibrate."""
