"""PLY files: properties that trimesh does not read, and whether files are cut off."""

import numpy as np


def ply_fault(content: bytes) -> str:
    """Describe where a PLY file is cut off; "" if it may be complete."""
    header, mark, body = content.partition(b"end_header")
    if not mark:
        return "its header has no end" if header.startswith(b"ply") else ""
    count, needed, elements = 0, 0, []
    is_ascii = b"format ascii" in header
    for words in map(bytes.split, header.splitlines()):
        if words[:1] == [b"element"]:
            count = int(words[2])
            elements.append(f"{count} of {words[1].decode(errors='replace')}")
            needed += is_ascii * count
        elif words[:1] == [b"property"] and not is_ascii:
            has_list = words[1] == b"list"
            entries = 3 if has_list and words[-1] in (b"vertex_indices", b"vertex_index") else 0
            sizes = [_BYTES.get(word, 0) for word in words[2:4]] if has_list else [0, 0]
            needed += count * (sizes[0] + entries * sizes[1] if has_list else _BYTES.get(words[1], 0))
    lines = [line for line in body.splitlines() if line.strip()] if is_ascii else []
    got, unit = (len(lines), "lines") if is_ascii else (len(body.split(b"\n", 1)[-1]), "bytes")
    if got >= needed:
        return ""
    return f"got {got} {unit} after its header, which says {', '.join(elements)}, at entries {needed} {unit}"


_BYTES = {b"char": 1, b"uchar": 1, b"short": 2, b"ushort": 2, b"int": 4, b"uint": 4, b"float": 4, b"double": 8} | {
    f"{kind}{bits}".encode(): bits // 8 for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64)
}
"""Sizes of the numbers of PLY files."""


def ply_corner_uvs(shape) -> np.ndarray | None:
    """The uvs [corner, 2] of a PLY file that stores them with faces; trimesh gives each vertex only one."""
    raw = shape.metadata.get("_ply_raw", {})
    data = raw.get("face", {}).get("data", {})
    names = data.dtype.names or () if isinstance(data, np.ndarray) else data
    if "texcoord" not in names:
        return None
    corners = next((data[name] for name in ("vertex_indices", "vertex_index") if name in names), None)
    axes = [np.ravel(raw["vertex"]["data"][axis]) for axis in "xyz"]
    points = np.stack(axes, axis=-1).astype(np.float32)
    if corners is None or not np.array_equal(points[_values(corners)], shape.triangles.astype(np.float32)):
        return None  # the faces no longer match the file's
    return _values(data["texcoord"]).reshape(-1, 2)


def ply_colors(shape) -> np.ndarray | None:
    """The colors [vertex, 3] of a PLY file, which trimesh leaves where vertices have uvs, too."""
    data = shape.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    names = data.dtype.names or () if isinstance(data, np.ndarray) else data
    channels = [np.ravel(data[name]) for name in ("red", "green", "blue") if name in names]
    is_whole = len(channels) == 3 and len(channels[0]) == len(shape.vertices)
    return np.stack(channels, axis=1) if is_whole else None


def _values(lists) -> np.ndarray:
    """The values of lists: binary files hold [count, values], ASCII files the values alone."""
    return np.asarray(lists["f1"] if getattr(lists.dtype, "names", None) else lists)
