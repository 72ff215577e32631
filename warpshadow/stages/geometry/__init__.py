"""Geometry: poses and deformation of vertices and spheres, and normals."""
