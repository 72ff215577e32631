"""A viewer in the browser: turn a scene under its light with the mouse (README.md)."""

from warpshadow.viewer.viewing import HOST, PORT, Viewer, serve, view

__all__ = ["HOST", "PORT", "Viewer", "serve", "view"]
