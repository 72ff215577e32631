"""Bounced light: which bodies send it, how often, and how receivers gather it. Imported where a scene asks."""
