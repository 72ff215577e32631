"""Mathematics in NumPy and SciPy: shapes of meshes, spherical harmonics, directions and their cells, sorting."""
