"""Scenes: bodies, light and camera, their files, and scenes made at random."""
