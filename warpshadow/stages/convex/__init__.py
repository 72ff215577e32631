"""Convex blockers: bodies that consist of convex parts, such as boxes and rods, and the light they block."""
