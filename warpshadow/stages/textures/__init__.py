"""Textures: mip pyramids, footprints of samples, and the colors that these filter."""
