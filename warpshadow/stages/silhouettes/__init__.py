"""Silhouettes: where they are, and how samples blend across them."""
