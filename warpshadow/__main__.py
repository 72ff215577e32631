"""``python -m warpshadow``."""

from warpshadow.cli import app

app(prog_name="warpshadow")
