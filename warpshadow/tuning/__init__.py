"""Settings that reach an error in the least time."""
