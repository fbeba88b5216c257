"""What computes, and under which limits: processor or device, memory, batches, threads and workers."""
