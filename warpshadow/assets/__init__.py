"""What a scene is made of: meshes, images, environment maps, cameras."""
