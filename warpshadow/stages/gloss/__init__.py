"""Gloss: light that surfaces reflect as mirrors with roughness do, by samples of the lobe of each receiver."""
