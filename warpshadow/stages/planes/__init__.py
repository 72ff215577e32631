"""Plane blockers: bodies that lie in planes, and the light they block."""
