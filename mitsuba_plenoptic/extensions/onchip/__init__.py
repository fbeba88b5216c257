"""Extension onchip."""
