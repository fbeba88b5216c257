"""Extension data."""
