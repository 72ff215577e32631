"""Importing the package is quick, and pulls in nothing that is not needed yet."""

import json
import subprocess
import sys
import time

import pytest

HEAVY = ("torch", "scipy", "trimesh", "matplotlib", "OpenEXR", "pxr", "PIL", "typer", "viser")


def modules_after(statement):
    """Names in sys.modules after a statement in a fresh process, and the seconds the statement took there."""
    script = (
        f"import json, sys, time; start = time.perf_counter(); {statement}; "
        "print(json.dumps([time.perf_counter() - start, sorted(sys.modules)]))"
    )
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    seconds, names = json.loads(output.splitlines()[-1])
    return seconds, set(names)


def test_importing_the_package_imports_nothing_heavy_and_takes_no_time():
    """Generous on a loaded machine: 3 s, of which it takes a hundredth."""
    start = time.perf_counter()
    seconds, names = modules_after("import warpshadow")
    assert not names.intersection(HEAVY)
    assert seconds < 1
    assert time.perf_counter() - start < 3


def test_no_stage_imports_anything_heavy():
    stages = ["basis", "blockers", "camera", "directions", "image", "light", "mesh", "raster", "reference", "renderer"]
    stages += ["scene", "sh", "shading", "spheres", "visibility.directional", "visibility.log_sh"]
    _, names = modules_after("import " + ", ".join(f"warpshadow.{stage}" for stage in stages))
    assert not names.intersection(HEAVY)


def test_every_public_name_can_be_imported():
    _, names = modules_after("from warpshadow import *")
    assert "warpshadow.renderer" in names
    assert not names.intersection(HEAVY)


def test_an_unknown_public_name_is_an_attribute_error():
    import warpshadow

    with pytest.raises(AttributeError, match="module 'warpshadow' has no attribute 'rendre'"):
        _ = warpshadow.rendre
