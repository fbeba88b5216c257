"""Extension studio."""
