"""PLY, binary little endian: our own clouds and meshes, exact when read back."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Bytes, Floats
from bodyscan.errors import ResultError
from bodyscan.files.atomic import atomic_replacement
from bodyscan.files.reading import read_regular
from bodyscan.mesh.body import REGION_NAMES, BodyCloud, BodyMesh, BreathAt
from bodyscan.mesh.topology import find_fault

Records = NDArray[np.void]

END = b"end_header\n"
_COLUMNS = {
    "positions": ("x", "y", "z"),
    "normals": ("nx", "ny", "nz"),
    "colours": ("red", "green", "blue"),
    "breath": ("breath_mm", "breath_sigma_mm"),
}
_TYPES: dict[str, tuple[Any, str]] = {
    **dict.fromkeys(_COLUMNS["positions"], ("<f8", "double")),
    **dict.fromkeys((*_COLUMNS["normals"], "sigma_mm", *_COLUMNS["breath"]), ("<f4", "float")),
    **dict.fromkeys((*_COLUMNS["colours"], "pairs_seen", "region", "filled"), ("u1", "uchar")),
    "vertex_indices": (np.dtype([("count", "u1"), ("corners", "<i4", 3)]), "list uchar int"),
}
"""Types of the properties: numpy's and PLY's."""

Layout = dict[str, tuple[str, ...]]
"""Properties of each element, in the order of the file."""


def _make_layout(what: str, *, breath: bool = False, regions: bool = False) -> Layout:
    """The layout of a cloud or a mesh, with or without displacements to mean breath and regions."""
    known = ("region",) if regions else ()
    vertex = (*_COLUMNS["positions"], *_COLUMNS["normals"], *_COLUMNS["colours"], "sigma_mm")
    if what == "cloud":
        return {"vertex": (*vertex, "pairs_seen", *known)}
    extra = (*_COLUMNS["breath"], *known) if breath else known
    return {"vertex": (*vertex, *extra), "face": ("vertex_indices", "filled", *known)}


def describe_axes(up: str = "z") -> str:
    """Unit and axes of a body of which z points up, or y, as its file's header states them."""
    first = "the way the subject faces" if up == "z" else "to the subject's left"
    return f"bodyscan: mm, x {first}, {up} up, floor at {up} = 0"


def lay_axes(vectors: NDArray[Any], up: str) -> NDArray[Any]:
    """Vectors (..., 3), whose axes point front, left, up, as a file has them (left, up, front)."""
    return vectors[..., [0, 1, 2] if up == "z" else [1, 2, 0]]


def write_ply(path: Path, body: BodyCloud | BodyMesh, up: str = "z") -> None:
    """Write a cloud or a mesh in mm; up: see `describe_axes`.

    A mesh's faces have a uchar `filled` (0 or 1); points, vertices and faces have a uchar `region`
    (index into `REGION_NAMES`) if it is known.
    """
    parts: dict[str, NDArray[Any]] = {
        "normals": lay_axes(body.normals, up).T,
        "colours": body.colours.T,
    }
    if isinstance(body, BodyCloud):
        layout = _make_layout("cloud", regions=body.regions is not None)
        vertices: dict[str, Any] = {"pairs_seen": body.pairs_seen}
        parts["positions"] = lay_axes(body.points, up).T
    else:
        layout = _make_layout(
            "mesh", breath=body.breath is not None, regions=body.regions is not None
        )
        vertices, parts["positions"] = {}, lay_axes(body.vertices, up).T
        if body.breath is not None:
            parts["breath"] = np.stack([body.breath.mm, body.breath.sigma_mm])
    vertices |= {"sigma_mm": body.sigma_mm, "region": body.regions}
    for part, arrays in parts.items():
        vertices |= dict(zip(_COLUMNS[part], arrays, strict=True))
    columns = [vertices]
    if isinstance(body, BodyMesh):
        corners = np.empty(len(body.faces), _TYPES["vertex_indices"][0])
        corners["count"], corners["corners"] = 3, body.faces
        faces = {"vertex_indices": corners, "filled": body.filled, "region": body.face_regions}
        columns.append(faces)
    records = []
    for names, values in zip(layout.values(), columns, strict=True):
        records.append(np.empty(len(values[names[0]]), _list_fields(names)))
        for name in names:
            records[-1][name] = values[name]
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        stream.write(_make_header(layout, [len(rows) for rows in records], up))
        for rows in records:
            stream.write(rows.data)


def read_ply_cloud(path: Path) -> BodyCloud:
    """Read a cloud that `write_ply` wrote. Raises ResultError if the file is not one."""
    (vertices,) = _read(Path(path), "cloud")
    regions = _read_regions(vertices, path)
    return BodyCloud(*_split_vertices(vertices), vertices["pairs_seen"].copy(), regions)


def read_ply_mesh(path: Path) -> BodyMesh:
    """Read a mesh that `write_ply` wrote. Raises ResultError if the file is not one."""
    vertices, faces = _read(Path(path), "mesh")
    points, normals, sigma_mm, colours = _split_vertices(vertices)
    corners = faces["vertex_indices"]["corners"].astype(np.int64)
    fault = find_fault(points, corners)
    if fault:
        raise ResultError(fault, where=str(path))
    breath = None
    if "breath_mm" in (vertices.dtype.names or ()):
        breath = BreathAt(vertices["breath_mm"].copy(), vertices["breath_sigma_mm"].copy())
    filled, regions = faces["filled"] != 0, _read_regions(vertices, path)
    return BodyMesh(points, corners, normals, colours, sigma_mm, filled, breath, regions)


def _read_regions(vertices: Records, path: Path) -> Bytes | None:
    """Regions (V,), None in a file that was written before there were any."""
    if "region" not in (vertices.dtype.names or ()):
        return None
    regions: Bytes = vertices["region"].copy()
    if regions.size and regions.max() >= len(REGION_NAMES):
        raise ResultError(f"has an unknown region, {regions.max()}", where=str(path))
    return regions


def _split_vertices(records: Records) -> tuple[Array, Floats, Floats, Bytes]:
    def columns(part: str) -> NDArray[Any]:
        return np.stack([records[name] for name in _COLUMNS[part]], axis=-1)

    sigma_mm = records["sigma_mm"].copy()
    return columns("positions"), columns("normals"), sigma_mm, columns("colours")


def _list_fields(names: Sequence[str]) -> np.dtype[Any]:
    return np.dtype([(name, _TYPES[name][0]) for name in names])


def _make_header(layout: Layout, counts: Sequence[int], up: str = "z") -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"comment {describe_axes(up)}"]
    for (element, names), count in zip(layout.items(), counts, strict=False):
        lines += [f"element {element} {count}"]
        lines += [f"property {_TYPES[name][1]} {name}" for name in names]
    return "\n".join([*lines, ""]).encode("ascii") + END


def _read(path: Path, what: str) -> list[Records]:
    """Read the records of each element of a cloud or mesh that `write_ply` wrote."""
    try:
        data = read_regular(path)
    except OSError as error:
        raise ResultError(f"cannot be read ({error.strerror})", where=str(path)) from error
    start = data[:4096].find(END) + len(END)
    lines = _strip_comments(data[:start])
    counts = [int(line.split()[-1]) for line in lines if re.fullmatch(rb"element \w+ \d+", line)]
    states = product((False, True), repeat=2)
    known = [_make_layout(what, breath=breath, regions=regions) for breath, regions in states]
    layout = next((one for one in known if lines == _strip_comments(_make_header(one, counts))), {})
    fields = [_list_fields(names) for names in layout.values()]
    sizes = [n * each.itemsize for n, each in zip(counts, fields, strict=False)]
    if not layout or len(data) != start + sum(sizes):
        raise ResultError(
            f"is not a {what} that bodyscan wrote, or is cut short",
            where=str(path),
            remedy="Export it again; PLY files of other programs are not read.",
        )
    records = []
    for each, count, size in zip(fields, counts, sizes, strict=True):
        records.append(np.frombuffer(data, each, count, start))
        start += size
    return records


def _strip_comments(header: bytes) -> list[bytes]:
    return [line for line in header.splitlines() if not line.startswith(b"comment")]
