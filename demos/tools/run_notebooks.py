"""Run the notebooks, and keep what they show in them.

    python demos/tools/run_notebooks.py [NOTEBOOK …]

Without arguments, all in `demos/notebooks`. They hold neither paths of this machine nor times of the run. The first
pictures of `relight_a_glb` are written beside it as a PNG, for README.md.
"""

import argparse
import base64
import io
import sys
from pathlib import Path

try:
    import nbformat
    from nbclient import NotebookClient
except ImportError as error:
    raise ImportError(f'{error}; in a checkout pip install -e ".[dev]" installs it') from error

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
SHOWN = {"relight_a_glb": 2}  # how many pictures of a notebook README.md shows
MAX_SECONDS = 600  # of a cell: the first one of a new machine compiles kernels and fits spheres


def executed(path: Path, *more: str) -> nbformat.NotebookNode:
    """A notebook as it is after it has run from its own folder, with further cells behind its own."""
    notebook = nbformat.read(path, as_version=4)
    notebook.cells += [nbformat.v4.new_code_cell(source) for source in more]
    NotebookClient(notebook, timeout=MAX_SECONDS, resources={"metadata": {"path": str(path.parent)}}).execute()
    return notebook


def lasting_outputs(cell: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """What a cell shows on every machine: neither warnings nor bars, which only slow work shows."""
    bar = "application/vnd.jupyter.widget-view+json"
    outputs = cell.get("outputs", [])
    return [output for output in outputs if output.get("name") != "stderr" and bar not in output.get("data", {})]


def tidied(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """The same without what differs from run to run, and from machine to machine: times, progress and warnings."""
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook.metadata = nbformat.from_dict({"kernelspec": kernel, "language_info": {"name": "python"}})
    for number, cell in enumerate(notebook.cells):
        cell.metadata, cell["id"] = nbformat.from_dict({}), f"cell-{number}"
        if cell.cell_type == "code":
            cell.outputs = lasting_outputs(cell)
    return notebook


def write_pictures(notebook: nbformat.NotebookNode, count: int, path: Path) -> None:
    """Write the first pictures that a notebook shows side by side."""
    from PIL import Image

    shown = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [data["image/png"] for data in shown if "image/png" in data][:count]
    images = [Image.open(io.BytesIO(base64.b64decode(picture))) for picture in pictures]
    joined = Image.new("RGB", (sum(image.width for image in images), images[0].height))
    for number, image in enumerate(images):
        joined.paste(image, (sum(other.width for other in images[:number]), 0))
    joined.save(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("notebooks", nargs="*", type=Path, default=sorted(NOTEBOOKS.glob("*.ipynb")))
    for path in parser.parse_args().notebooks:
        notebook = tidied(executed(path))
        nbformat.write(notebook, path)
        if path.stem in SHOWN:
            write_pictures(notebook, SHOWN[path.stem], path.with_suffix(".png"))
        sys.stdout.write(f"{path}: {path.stat().st_size / 1e3:.0f} kB\n")


if __name__ == "__main__":
    main()
