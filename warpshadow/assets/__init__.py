"""The assets of a scene: meshes, images, environment maps, cameras."""
