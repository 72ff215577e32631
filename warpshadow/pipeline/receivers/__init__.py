"""Receivers: where light is evaluated, which of them go together, and results that are cached for static ones."""
