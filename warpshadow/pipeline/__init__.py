"""The pipeline from a scene to its images: nodes that run, and cached results."""
