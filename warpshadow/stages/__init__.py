"""The paper, a stage a file: from vertices and spheres to an image."""
