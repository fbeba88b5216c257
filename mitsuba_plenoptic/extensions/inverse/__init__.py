"""Extension inverse."""
