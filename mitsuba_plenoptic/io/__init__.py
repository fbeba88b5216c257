"""Files: captures, checkpoints, and how they are written whole or not at all."""
