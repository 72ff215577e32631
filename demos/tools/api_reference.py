"""The API reference, built from the docstrings.

    make docs      or      python demos/tools/api_reference.py [--output out/docs]

Each module has a page. Names that a package exports, such as ``warpshadow.Scene``, are on the page of the package.
"""

import argparse
import pkgutil
import sys
import warnings
from pathlib import Path

import pdoc
import warp as wp

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow
from warpshadow import stages


def main(output: Path) -> None:
    for value in list(vars(wp).values()):
        if isinstance(value, type) and value.__module__.startswith("warp."):
            value.__module__ = "warp"  # where users find it, in place of where it is defined
    for package in (warpshadow, stages):  # pdoc does not ask for names that are imported when they are asked for
        vars(package).update({name: getattr(package, name) for name in package.__all__})
    names = [module.name for module in pkgutil.walk_packages(warpshadow.__path__, "warpshadow.")]
    # pdoc shows an annotation that it cannot evaluate as it is written, which is fine
    warnings.filterwarnings("ignore", message="Error parsing type annotation")
    warnings.filterwarnings("error", message="Found .* in .*__all__")  # names without documentation
    pdoc.render.configure(docformat="google", show_source=False)
    pdoc.pdoc("warpshadow", *names, output_directory=output)
    print(f"wrote {output / 'index.html'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/docs"), help="folder for the pages")
    main(parser.parse_args().output)
