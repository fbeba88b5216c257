"""Extension wavefront."""
