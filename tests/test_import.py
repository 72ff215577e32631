"""Importing the package pulls in nothing that is not needed yet."""

import importlib
import json
import pkgutil
import subprocess
import sys

import pytest
import warp

HEAVY = ("torch", "scipy", "trimesh", "matplotlib", "OpenEXR", "pxr", "PIL", "typer", "viser")


def modules_after(statement):
    """Names in sys.modules after a statement in a fresh process."""
    script = f"import json, sys; {statement}; print(json.dumps(sorted(sys.modules)))"
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    return set(json.loads(output.splitlines()[-1]))


@pytest.mark.slow
def test_importing_the_package_imports_nothing_heavy():
    names = modules_after("import warpshadow")
    assert "warp" in names
    assert not names.intersection(HEAVY)


METHODS = {f"warpshadow.pipeline.methods.{name}" for name in ("directional", "log_sh", "ray_traced")}

STILL = """
import warpshadow as ws
camera = ws.Camera.look_at((0, 0, 5), (0, 0, 0), size=(8, 8))
ws.render(ws.Scene([ws.Body(ws.icosphere(1.0, 1))], ws.EnvironmentMap.constant(), camera), progress=False)
""".strip().replace("\n", "; ")


@pytest.mark.slow
def test_a_method_of_visibility_is_imported_when_a_scene_asks_for_it():
    renderer_and_stages = {"warpshadow.pipeline.renderer", "warpshadow.stages.facade"}
    assert not modules_after("import warpshadow").intersection(METHODS | renderer_and_stages)
    assert modules_after(STILL).intersection(METHODS) == {"warpshadow.pipeline.methods.ray_traced"}


@pytest.mark.slow
def test_importing_the_package_does_not_start_warp():
    """Which looks for devices and loads its compiler: half a second that a first kernel pays for."""
    script = "import warp, warpshadow; print('imported'); warp.init()"  # which says that it starts
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.startswith("imported") and f"Warp {warp.__version__}" in run.stdout


@pytest.mark.slow
def test_no_module_below_torch_imports_anything_heavy():
    wings = "maths", "device", "assets", "stages", "spheres", "scene", "pipeline", "tuning"
    packages = [importlib.import_module(f"warpshadow.{wing}") for wing in wings]
    modules = [each.name for wing in packages for each in pkgutil.walk_packages(wing.__path__, f"{wing.__name__}.")]
    assert len(modules) > 60
    assert not modules_after("import " + ", ".join(modules)).intersection(HEAVY)


@pytest.mark.slow
def test_every_public_name_can_be_imported():
    names = modules_after("from warpshadow import *")
    assert "warpshadow.pipeline.renderer" in names
    assert not names.intersection(HEAVY)


def test_an_unknown_public_name_is_an_attribute_error():
    import warpshadow

    with pytest.raises(AttributeError, match="module 'warpshadow' has no attribute 'rendre'"):
        _ = warpshadow.rendre


def test_dir_lists_all_public_names_before_they_are_imported():
    assert not modules_after("import warpshadow; assert {*warpshadow.__all__} <= {*dir(warpshadow)}") & METHODS
