"""Bodies: all of a scene as one mesh, their reflectance, and the blockers that they are."""
