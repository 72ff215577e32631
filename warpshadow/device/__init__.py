"""Kernel launches: the tape, slices on all cores, lanes, batches, constants, CUDA graphs."""
