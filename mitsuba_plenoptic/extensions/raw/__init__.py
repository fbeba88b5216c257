"""Extension raw."""
