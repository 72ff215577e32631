"""Visibility past spheres: directional transmittance and log-SH."""
