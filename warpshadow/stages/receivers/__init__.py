"""Receivers: the points at which light is computed for an image."""
