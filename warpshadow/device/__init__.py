"""Kernel launches: tape, slices on all cores, lanes, batches, CUDA graphs; threads, worker processes, progress."""
