"""The shell: a sphere around the scene from which an environment at a finite distance sends its light."""
