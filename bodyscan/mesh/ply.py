"""PLY, binary little endian: our own clouds and meshes, exact when read back."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Array, Bytes, Floats
from bodyscan.errors import ResultError
from bodyscan.files.atomic import atomic_replacement
from bodyscan.files.reading import read_regular
from bodyscan.mesh.body import REGION_NAMES, BodyCloud, BodyMesh, BreathAt

Records = NDArray[np.void]

END = b"end_header\n"


@dataclass(frozen=True, eq=False)
class Element:
    """One kind of record in a PLY file: its name, its fields (numpy) and its properties (PLY)."""

    name: str
    fields: np.dtype[Any]
    properties: tuple[str, ...]

    def header(self, count: int) -> list[str]:
        properties = [f"property {text}" for text in self.properties]
        return [f"element {self.name} {count}", *properties]


def _vertex(*extra: tuple[str, str, str]) -> Element:
    """Describe a vertex: position, normal, colour, sigma, `extra` (name, numpy type, PLY type)."""
    fields = [(axis, "<f8", "double") for axis in ("x", "y", "z")]
    fields += [(axis, "<f4", "float") for axis in ("nx", "ny", "nz")]
    fields += [(colour, "u1", "uchar") for colour in ("red", "green", "blue")]
    fields += [("sigma_mm", "<f4", "float"), *extra]
    return Element(
        "vertex",
        np.dtype([(name, kind) for name, kind, _ in fields]),
        tuple(f"{kind} {name}" for name, _, kind in fields),
    )


_REGION = ("region", "u1", "uchar")


def _cloud(*, regions: bool) -> tuple[Element, ...]:
    return (_vertex(("pairs_seen", "u1", "uchar"), *([_REGION] if regions else [])),)


def _mesh(*, breath: bool, regions: bool) -> tuple[Element, ...]:
    """Describe vertices and faces, with or without displacements to mean breath and regions."""
    breath_fields = [("breath_mm", "<f4", "float"), ("breath_sigma_mm", "<f4", "float")]
    vertex = _vertex(*(breath_fields if breath else []), *([_REGION] if regions else []))
    fields = [("count", "u1"), ("corners", "<i4", 3), ("filled", "u1")]
    properties = ["list uchar int vertex_indices", "uchar filled"]
    if regions:
        fields, properties = [*fields, ("region", "u1")], [*properties, "uchar region"]
    return vertex, Element("face", np.dtype(fields), tuple(properties))


def write_ply(path: Path, body: BodyCloud | BodyMesh) -> None:
    """Write a cloud or a mesh in mm, rig frame.

    A mesh's faces have a uchar `filled` (0 or 1); points, vertices and faces have a uchar `region`
    (index into `REGION_NAMES`) if it is known.
    """
    regions = body.regions is not None
    if isinstance(body, BodyCloud):
        elements = _cloud(regions=regions)
        records = [_vertex_records(elements[0], body, body.points)]
        records[0]["pairs_seen"] = body.pairs_seen
    else:
        elements = _mesh(breath=body.breath is not None, regions=regions)
        faces = np.empty(len(body.faces), elements[1].fields)
        faces["count"], faces["corners"], faces["filled"] = 3, body.faces, body.filled
        records = [_vertex_records(elements[0], body, body.vertices), faces]
        if body.breath is not None:
            records[0]["breath_mm"] = body.breath.mm
            records[0]["breath_sigma_mm"] = body.breath.sigma_mm
        if regions:
            faces["region"] = body.face_regions
    if regions:
        records[0]["region"] = body.regions
    with atomic_replacement(Path(path)) as temporary, temporary.open("wb") as stream:
        stream.write(_header(elements, [len(rows) for rows in records]))
        for rows in records:
            stream.write(rows.data)


def read_ply_cloud(path: Path) -> BodyCloud:
    """Read a cloud that `write_ply` wrote. Raises ResultError if the file is not one."""
    kinds = [_cloud(regions=regions) for regions in (True, False)]
    (vertices,) = _read(Path(path), kinds, "cloud")
    regions = _regions(vertices, path)
    return BodyCloud(*_vertex_arrays(vertices), vertices["pairs_seen"].copy(), regions)


def read_ply_mesh(path: Path) -> BodyMesh:
    """Read a mesh that `write_ply` wrote. Raises ResultError if the file is not one."""
    states = (False, True)
    kinds = [_mesh(breath=breath, regions=regions) for breath in states for regions in states]
    vertices, faces = _read(Path(path), kinds, "mesh")
    points, normals, sigma_mm, colours = _vertex_arrays(vertices)
    corners = faces["corners"].astype(np.int64)
    if corners.size and (corners.min() < 0 or corners.max() >= len(points)):
        raise ResultError("a face names a vertex that is not there", where=str(path))
    breath = None
    if "breath_mm" in (vertices.dtype.names or ()):
        breath = BreathAt(vertices["breath_mm"].copy(), vertices["breath_sigma_mm"].copy())
    filled, regions = faces["filled"] != 0, _regions(vertices, path)
    return BodyMesh(points, corners, normals, colours, sigma_mm, filled, breath, regions)


def _regions(vertices: Records, path: Path) -> Bytes | None:
    """Regions (V,), None in a file that was written before there were any."""
    if "region" not in (vertices.dtype.names or ()):
        return None
    regions: Bytes = vertices["region"].copy()
    if regions.size and regions.max() >= len(REGION_NAMES):
        raise ResultError(f"has an unknown region, {regions.max()}", where=str(path))
    return regions


def _vertex_records(element: Element, body: BodyCloud | BodyMesh, positions: Array) -> Records:
    records = np.empty(len(positions), element.fields)
    for k, (axis, colour) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        records[axis] = positions[:, k]
        records[f"n{axis}"] = body.normals[:, k]
        records[colour] = body.colours[:, k]
    records["sigma_mm"] = body.sigma_mm
    return records


def _vertex_arrays(records: Records) -> tuple[Array, Floats, Floats, Bytes]:

    def columns(*names: str) -> NDArray[Any]:
        return np.stack([records[name] for name in names], axis=-1)

    colours = columns("red", "green", "blue")
    return columns("x", "y", "z"), columns("nx", "ny", "nz"), records["sigma_mm"].copy(), colours


def _header(elements: Sequence[Element], counts: Sequence[int]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += ["comment bodyscan: mm, x the way the subject faces, z up, floor at z = 0"]
    for element, count in zip(elements, counts, strict=False):
        lines += element.header(count)
    return "\n".join([*lines, ""]).encode("ascii") + END


def _read(path: Path, known: Sequence[Sequence[Element]], what: str) -> list[Records]:
    """Read the records of each element of a file that `write_ply` wrote with a known layout."""
    try:
        data = read_regular(path)
    except OSError as error:
        raise ResultError(f"cannot be read ({error.strerror})", where=str(path)) from error
    end = data[:4096].find(END) + len(END)
    lines = _strip_comments(data[:end])
    counts = [int(line.split()[-1]) for line in lines if re.fullmatch(rb"element \w+ \d+", line)]
    elements = next((one for one in known if lines == _strip_comments(_header(one, counts))), ())
    sizes = [n * element.fields.itemsize for n, element in zip(counts, elements, strict=False)]
    if not elements or len(data) != end + sum(sizes):
        raise ResultError(
            f"is not a {what} that bodyscan wrote, or is cut short",
            where=str(path),
            remedy="Export it again; PLY files of other programs are not read.",
        )
    records, start = [], end
    for element, count, size in zip(elements, counts, sizes, strict=True):
        records.append(np.frombuffer(data, element.fields, count, start))
        start += size
    return records


def _strip_comments(header: bytes) -> list[bytes]:
    return [line for line in header.splitlines() if not line.startswith(b"comment")]
