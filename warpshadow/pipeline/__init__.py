"""What runs and what is kept: from a scene to its images."""
