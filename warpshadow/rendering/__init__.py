"""Scenes to images, for users: the renderer of any scene, stills, and bodies put into photographs."""
