"""Raster: projection, the face that each sample sees, and values of vertices there."""
