"""Bad input, generated: what `tools/fuzz.py` runs."""
