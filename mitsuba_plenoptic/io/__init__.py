"""Files: captures, checkpoints, and functions that write a file completely or not at all."""
