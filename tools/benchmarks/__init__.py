"""The sections of `tools/benchmark.py`: each compares one thing with what it is measured against."""
