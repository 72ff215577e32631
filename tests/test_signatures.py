"""What users import says what it takes and returns: every argument and result has a type, and none is Any."""

import dataclasses
import importlib
import inspect
import os
import subprocess
import sys
import typing
from collections import abc
from collections.abc import Iterator
from pathlib import Path

import numpy.typing
import pytest

ROOT = Path(__file__).parents[1]

FACADES = ("warpshadow", "warpshadow.torch", "warpshadow.inverse", "warpshadow.dataset", "warpshadow.stages")

OTHERS = {
    "warpshadow.device.cuda_graph": ("Captured", "with_gradients"),
    "warpshadow.device.tape": ("recorded",),
    "warpshadow.scene.random_scenes": ("RandomScenes", "Ranges"),
}
"""Public names of modules that are not public as a whole."""


def functions_of(name: str, value: object) -> Iterator[tuple[str, object]]:
    """Public functions behind a name: itself, or a class's own methods and properties."""
    if inspect.isfunction(value):
        yield name, value
    if not inspect.isclass(value):
        return
    for base in value.__mro__:
        if not base.__module__.startswith("warpshadow"):
            continue
        for key, member in vars(base).items():
            parameters = vars(base).get("__dataclass_params__")
            is_made = key == "__init__" and getattr(parameters, "init", False)  # of fields, which have a test
            if is_made or (key.startswith("_") and key not in ("__init__", "__call__")):
                continue
            member = getattr(member, "__func__", member)
            member = getattr(member, "fget", None) or getattr(member, "func", None) or member
            if inspect.isfunction(member):
                yield f"{name}.{key}", member


ARRAY_LIKE = {numpy.typing.ArrayLike, *typing.get_args(numpy.typing.ArrayLike)}
"""Types of what NumPy makes arrays of, which hold an Any of NumPy's."""

BARE_TYPES = {dict, list, tuple, set, os.PathLike, *(getattr(abc, name) for name in abc.__all__)}
"""What has items of any type where it is not said of which."""


def is_any(hint: object) -> bool:
    """Whether a type is Any somewhere, said or meant."""
    if isinstance(hint, list):  # arguments of a callable
        return any(map(is_any, hint))
    if hint in ARRAY_LIKE:
        return False
    return hint is typing.Any or hint in BARE_TYPES or any(map(is_any, typing.get_args(hint)))


def faults(name: str, function) -> list[str]:
    """What a signature does not say."""
    hints = typing.get_type_hints(function)
    parameters = list(inspect.signature(function).parameters.values())
    wanted = [each.name for each in parameters if each.name not in ("self", "cls")]
    wanted += [] if function.__name__ == "__init__" else ["return"]
    return [f"{name}: {each} has no type" for each in wanted if each not in hints] + [
        f"{name}: {each} is {hint}" for each, hint in hints.items() if is_any(hint)
    ]


@pytest.mark.parametrize("facade", FACADES)
def test_public_signatures_have_types_and_no_any(facade):
    module = importlib.import_module(facade)
    found = [pair for name in module.__all__ for pair in functions_of(name, getattr(module, name))]
    assert len(found) > 2
    assert not [fault for pair in found for fault in faults(*pair)]


@pytest.mark.parametrize("module", OTHERS)
def test_public_names_of_other_modules_have_types_and_no_any(module):
    values = {name: getattr(importlib.import_module(module), name) for name in OTHERS[module]}
    found = [pair for name, value in values.items() for pair in functions_of(name, inspect.unwrap(value))]
    assert not [fault for pair in found for fault in faults(*pair)]
    page = (ROOT / "warpshadow" / "README.md").read_text("utf-8")
    assert all(f"`{name}`" in page for name in (module, *values))


@pytest.mark.parametrize("facade", FACADES)
def test_public_fields_have_types_and_no_any(facade):
    module = importlib.import_module(facade)
    classes = [value for value in (getattr(module, name) for name in module.__all__) if dataclasses.is_dataclass(value)]
    for each in classes:
        hints = typing.get_type_hints(each)
        assert not [field.name for field in dataclasses.fields(each) if is_any(hints[field.name])], each


@pytest.mark.parametrize("facade", FACADES)
def test_a_facade_lists_what_it_exports_in_order(facade):
    module = importlib.import_module(facade)
    assert list(module.__all__) == sorted(set(module.__all__))
    assert all(hasattr(module, name) for name in module.__all__)


USER = """# mypy: warn-unused-ignores
import os
from pathlib import Path

import numpy as np
import torch

import warpshadow as ws
from warpshadow import inverse
from warpshadow.torch import TorchRenderer

path: os.PathLike[str] = Path("bunny.obj")
bunny = ws.Body(path, albedo=[0.8, 0.6, 0.5], rotation=(0, 30, 0))
ground = ws.Body(ws.plane(4.0), texture="tile.png", name="ground")
camera = ws.Camera.look_at(np.array([0.0, 2.0, 4.0]), [0, 0, 0], size=(64, 48))
scene = ws.Scene([bunny, ground], "sky.exr", camera, ws.Visibility("log-sh", order=4))
image: np.ndarray = ws.Renderer(scene).render()
ws.write_image(path, image)
renderer = TorchRenderer(scene, device=torch.device("cpu"))
rotations, translations, scales = renderer.scene_poses()
geometry = renderer.placed(rotations, translations, moving=["bunny"])
points: torch.Tensor = geometry.positions
textures = {"ground": torch.ones(4, 4, 3)}
drawn: torch.Tensor = renderer(textures=textures, geometry=geometry)
print(renderer.explain(textures=textures, geometry=geometry), renderer.forward(albedo={0: torch.ones(3)}).shape)
target = inverse.Target("photo.png", mask=image[..., 3])
problem = inverse.Problem(scene, target, [inverse.Texture(body="ground"), inverse.Pose(0)])
found: ws.Scene = inverse.fit(problem, inverse.pose_stages(problem), checkpoint=path).scene

ws.Body(3)  # type: ignore[arg-type]
ws.Visibility("none", softnes=1.0)  # type: ignore[call-arg]
renderer.deformed(1.5)  # type: ignore[arg-type]
renderer.forward(textures=torch.ones(4, 4, 3))  # type: ignore[arg-type]
inverse.Pose(None)  # type: ignore[arg-type]
ws.render(camera)  # type: ignore[arg-type]
"""
"""What a user's type checker is to accept, and, where it says to ignore it, to refuse."""


@pytest.mark.slow
def test_types_are_visible_to_users(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(USER, encoding="utf-8")
    # as `make types` does it, from whose cache it takes all but the script
    run = subprocess.run([sys.executable, "-m", "mypy", str(script)], capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stdout + run.stderr
