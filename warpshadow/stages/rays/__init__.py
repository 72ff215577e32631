"""Rays against meshes: one at a time, and packets of sixteen."""
