"""The reproduction of the paper: its figures, timing and conclusions."""
