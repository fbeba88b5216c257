"""What reproduces the paper, and only that: its figures, timing and conclusions."""
