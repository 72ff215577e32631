"""Visibility of spheres: as log-SH sums, and as transmittance towards cells of directions."""
