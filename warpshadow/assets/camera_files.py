"""Files of cameras: NeRF's transforms.json, and COLMAP's text files."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.assets.camera_conventions import Y_DOWN, intrinsics_of
from warpshadow.check import AnyPath

_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
_COLMAP = ("cameras.txt", "images.txt")


def load_cameras(
    path: AnyPath, *, size: tuple[int, int] | None = None, up: str = "y", near: float = 0.01
) -> dict[Path, Camera]:
    """Read the cameras of photographs: NeRF's ``transforms.json``, or COLMAP's ``cameras.txt`` and ``images.txt``.

    Args:
        path: The JSON file; or the folder of the text files, which ``colmap model_converter --output_type TXT`` writes.
        size: Width and height of the images [pixels]; by default that of the file, or else of each image.
        up: Which axis of the file's world points up, "y" or "z", as in NeRF's Blender scenes; a world of "z" is turned
            so that y is up here.
        near: Distance of the near plane [scene units].
    Returns:
        The cameras by their images' paths, in the file's order; paths of a JSON file are relative to it, COLMAP's as
        they stand in its file.
    Raises:
        ValueError: for lenses with distortion, and for a mistake in the file.
    """
    path = check.path("path", path)
    check.choice("up", up, ("y", "z"))
    if size is not None:
        size = check.image_size(size)
    with check.located(str(path)):
        result = _read_colmap(path, near) if path.is_dir() else _read_transforms(path, size, near)
    if size is not None:
        result = {name: camera.stretched(*size) for name, camera in result.items()}
    if up == "y":
        return result
    return {name: replace(camera, rotation=camera.rotation @ _TO_Y_UP.T) for name, camera in result.items()}


def _read_transforms(path: Path, size: tuple[int, int] | None, near: float) -> dict[Path, Camera]:
    if not path.is_file():
        raise FileNotFoundError("no such file or folder")
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"got no JSON ({error}), expected NeRF's transforms.json, or COLMAP's folder") from error
    if not isinstance(document, dict) or not isinstance(document.get("frames"), list):
        raise ValueError("frames: missing, expected a list of them, each with file_path and transform_matrix")
    result = {}
    for number, frame in enumerate(document["frames"]):
        with check.located(f"frames[{number}]"):
            check.instance("frame", frame, dict, "file_path and transform_matrix")
            values = {key: value for key, value in document.items() if key != "frames"} | frame
            if not isinstance(values.get("file_path"), str):
                raise ValueError("file_path: missing, expected the path of an image")
            image = path.parent / values["file_path"]
            image = image if image.suffix else image.with_name(f"{image.name}.png")  # which Blender scenes leave out
            if image in result:
                raise ValueError(f"file_path: got {image} twice, expected it once")
            result[image] = _frame_camera(values, image, size, near)
    return result


def _frame_camera(values: Mapping[str, Any], image: Path, size: tuple[int, int] | None, near: float) -> Camera:
    """A camera of the size that its intrinsics are for."""
    distortion_values = {key: values[key] for key in _DISTORTION if values.get(key)}
    if distortion_values:
        raise ValueError(
            f"{', '.join(distortion_values)}: got {', '.join(map(str, distortion_values.values()))}, expected 0: "
            "the cameras here are pinholes; "
            "cv2.undistort or colmap image_undistorter makes images of one"
        )
    model = str(values.get("camera_model", "OPENCV"))
    if values.get("is_fisheye") or model not in _PINHOLES:
        raise ValueError(
            f"camera_model: got {'is_fisheye' if values.get('is_fisheye') else model}, expected a pinhole, one of "
            f"{', '.join(_PINHOLES)}; colmap image_undistorter makes images of one"
        )
    if "w" in values and "h" in values:
        width, height = (check.integer(key, int(check.number(key, values[key])), unit="pixels") for key in "wh")
    else:
        width, height = size or _image_size(image)
    fx, fy = _focal_length("x", values, width), _focal_length("y", values, height)
    if fx is None:
        raise ValueError("fl_x: missing, expected fl_x [pixels] or camera_angle_x [radians]")
    fy = fx if fy is None else fy
    center = (
        check.number(*argument)
        for argument in (("cx", values.get("cx", width / 2)), ("cy", values.get("cy", height / 2)))
    )
    camera_to_world = check.array("transform_matrix", values.get("transform_matrix", check.NOTHING), (4, 4))
    rotation = Y_DOWN @ camera_to_world[:3, :3].T
    return Camera(intrinsics_of(fx, fy, *center), rotation, -rotation @ camera_to_world[:3, 3], width, height, near)


def _focal_length(axis: str, values: Mapping[str, Any], pixels: int) -> float | None:
    """Focal length along an axis [pixels], given as such or by the angle of view; None where neither is."""
    if (key := f"fl_{axis}") in values:
        return check.positive(key, values[key])
    if (key := f"camera_angle_{axis}") in values:
        return float(0.5 * pixels / np.tan(0.5 * check.positive(key, values[key])))
    return None


def _image_size(image: Path) -> tuple[int, int]:
    from PIL import Image

    if not image.is_file():
        raise ValueError(f"w, h: missing, and there is no image {image}, expected them, or size=(width, height)")
    with Image.open(image) as image_file:
        return image_file.size


def _read_colmap(folder: Path, near: float) -> dict[Path, Camera]:
    for name in _COLMAP:
        if not (folder / name).is_file():
            remedy = "colmap model_converter --output_type TXT writes it"
            raise FileNotFoundError(f"no {name} in it; {remedy}")
    models = {}
    for number, line in enumerate((folder / _COLMAP[0]).read_text(encoding="utf-8").splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            with check.located(f"{_COLMAP[0]}: line {number}"):
                identity, model, width, height, *params = line.split()
                models[identity] = model, [float(value) for value in params], (int(width), int(height))
    result = {}
    lines = (folder / _COLMAP[1]).read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#") or _is_line_of_points(line):
            continue
        with check.located(f"{_COLMAP[1]}: line {number}"):
            _, *pose, identity, name = line.split(maxsplit=9)
            if identity not in models:
                raise ValueError(f"got camera {identity}, expected one of {', '.join(models)}")
            qvec, tvec = [float(value) for value in pose[:4]], [float(value) for value in pose[4:]]
            result[Path(name)] = Camera.from_colmap(qvec, tvec, *models[identity], near=near)
    return result


def _is_line_of_points(line: str) -> bool:
    """Whether a line of images.txt lists points of an image, x, y and a number of each, and not an image."""
    words = line.split()
    try:
        [float(word) for word in words]
    except ValueError:
        return False
    return len(words) % 3 == 0
