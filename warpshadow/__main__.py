"""``python -m warpshadow`` is the command line."""

from warpshadow.cli import app

if __name__ == "__main__":
    app(prog_name="warpshadow")
