"""Shading: the light that receivers reflect directly, past blockers."""
