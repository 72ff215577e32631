"""Examples, benchmarks and tools, and what they share; README.md shows what they print and draw."""
