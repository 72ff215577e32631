"""A viewer in the browser: turn a scene under its light with the mouse, and watch a fit (README.md)."""

from warpshadow.viewer.viewing import HOST, PORT, FitViewer, Viewer, serve, view

__all__ = ["HOST", "PORT", "FitViewer", "Viewer", "serve", "view"]
