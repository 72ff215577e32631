"""Mathematics in NumPy: spherical harmonics, directions and their cells, spatial sorting."""
