"""The command line: render, view and tune scenes, fit them, fit spheres to a mesh, look into a light, compile ahead.

Commands are listed by ``--help`` in the order in which their modules are imported.
"""

# isort: skip_file
from warpshadow.cli.console import app
from warpshadow.cli import rendering, scenes, fits, preparation

__all__ = ["app", "fits", "preparation", "rendering", "scenes"]
