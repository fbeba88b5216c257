"""Means of computation and their limits: processor or device, memory, batches, threads and workers."""
