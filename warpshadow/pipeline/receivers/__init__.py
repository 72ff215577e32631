"""Receivers: where light is evaluated, which of them go together, and what is cached of those that do not move."""
