"""``python -m warpshadow.cli`` is the command line, too."""

from warpshadow.cli import app

if __name__ == "__main__":
    app(prog_name="warpshadow")
