"""Extension laser."""
