"""Flats: bodies that lie in planes, and what they block of the light."""
