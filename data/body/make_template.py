"""Reduce MakeHuman's body to what the scanner lays over scans: see README.md beside this file."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import anny
import numpy as np
import open3d as o3d
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components

Array = NDArray[np.float64]

BODIES, SHAPES = 6000, 80
PARTS = ("head", "neck", "trunk") + tuple(
    f"{side} {part}"
    for side in ("left", "right")
    for part in ("upper arm", "forearm", "hand", "thigh", "shank", "foot")
)


def skeleton() -> dict[str, tuple[str | None, tuple[str, ...], str]]:
    """Our joints: parent, first words of MakeHuman's bones that move with it, the bone it sits on."""
    joints: dict[str, tuple[str | None, tuple[str, ...], str]] = {
        "pelvis": (None, ("root", "pelvis", "spine05"), "root"),
        "lumbar": ("pelvis", ("spine04", "spine03"), "spine04"),
        "thorax": ("lumbar", ("spine02", "spine01", "breast"), "spine02"),
        "neck": ("thorax", ("neck",), "neck01"),
        "head": ("neck", (), "head"),
    }
    for side, s in (("left", "L"), ("right", "R")):
        joints |= {
            f"{side} clavicle": ("thorax", ("clavicle", "shoulder01"), f"clavicle.{s}"),
            f"{side} upper arm": (f"{side} clavicle", ("upperarm",), f"upperarm01.{s}"),
            f"{side} forearm": (f"{side} upper arm", ("lowerarm",), f"lowerarm01.{s}"),
            f"{side} hand": (f"{side} forearm", ("wrist", "metacarpal", "finger"), f"wrist.{s}"),
            f"{side} thigh": ("pelvis", ("upperleg",), f"upperleg01.{s}"),
            f"{side} shank": (f"{side} thigh", ("lowerleg",), f"lowerleg01.{s}"),
            f"{side} foot": (f"{side} shank", ("foot", "toe"), f"foot.{s}"),
        }
    return joints


def joint_of(bone: str) -> str:
    """The joint of ours that a bone of MakeHuman's moves with."""
    end = {".L": "left ", ".R": "right "}.get(bone[-2:], "")
    for name, (_, words, _) in skeleton().items():
        sided = name.startswith(("left ", "right "))
        if words and bone.startswith(words) and (not sided or name.startswith(end or "-")):
            return name
    return "head"


def to_body(points: torch.Tensor) -> Array:
    """From metres, facing -y, to millimetres, x forward, y to the left."""
    x, y, z = np.moveaxis(points.numpy().astype(np.float64), -1, 0)
    return 1000.0 * np.stack([-y, x, z], axis=-1)


def sample_population(model: anny.Anny) -> Array:
    """Coefficients (BODIES, B) of random bodies, from small children to old age."""
    rng = np.random.default_rng(1)
    values = rng.uniform(0.0, 1.0, (BODIES, len(model.phenotype_labels)))
    # Age 0 is a baby of one year, 1/3 a child of eleven.
    values[:, model.phenotype_labels.index("age")] = rng.uniform(0.1, 1.0, BODIES)
    local = rng.normal(0.0, 0.3, (BODIES, len(model.local_change_labels))).clip(-1.0, 1.0)
    found = model._get_phenotype_blendshape_coefficients(
        torch.tensor(values), torch.tensor(local), torch.zeros((BODIES, 0), dtype=torch.float64)
    )
    return found.numpy()


def find_hidden(vertices: Array, faces: NDArray[np.int64], normals: Array) -> NDArray[np.bool_]:
    """Vertices that hardly any light reaches: inside the mouth and the nostrils."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
    )
    directions = np.random.default_rng(0).normal(size=(64, 3))
    free, cast = np.zeros(len(vertices)), np.zeros(len(vertices))
    for towards in directions / np.linalg.norm(directions, axis=1, keepdims=True):
        some = normals @ towards > 0.1
        start = vertices[some] + 0.5 * normals[some]
        rays = np.hstack([start, np.broadcast_to(towards, start.shape)]).astype(np.float32)
        free[some] += np.isinf(scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy())
        cast[some] += 1.0
    return free / np.maximum(cast, 1.0) < 0.12


def vertex_normals(vertices: Array, faces: NDArray[np.int64]) -> Array:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals, across = np.zeros_like(vertices), np.cross(b - a, c - a)
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def build_limit(faces: NDArray[np.int64], count: int) -> csr_array:
    """The matrix (V, V) that takes vertices to where Loop's subdivision puts them in the limit.

    MakeHuman's mesh controls a smooth surface and lies outside of it where a body is convex: by 2 mm
    and more at nose, nape and fingers.
    """
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])  # closed: both ways
    links = coo_array((np.ones(len(edges)), edges.T), shape=(count, count)).tocsr()
    degree = np.asarray(links.sum(axis=1)).ravel()
    weight = (0.625 - (0.375 + 0.25 * np.cos(2.0 * np.pi / degree)) ** 2) / degree
    share = 1.0 / (degree + 0.375 / weight)
    return csr_array(diags_array(1.0 - degree * share) + diags_array(share) @ links)


class Author:
    """Finds landmarks on the mean body by rules on its own geometry (root joint at z = 73 mm)."""

    def __init__(self, vertices: Array, normals: Array, joint: NDArray[np.int64], at: Array):
        self.vertices, self.normals = vertices, normals
        self.names = list(skeleton())
        self.part = {name: joint == k for k, name in enumerate(self.names)}
        self.joint = dict(zip(self.names, at, strict=True))
        self.found: dict[str, int] = {}

    def pick(self, mask: NDArray[np.bool_], towards: tuple[float, ...] | Array) -> int:
        some = np.flatnonzero(mask)
        return int(some[np.argmax(self.vertices[some] @ np.asarray(towards, float))])

    def near(self, point: tuple[float, ...], mask: NDArray[np.bool_]) -> int:
        some = np.flatnonzero(mask)
        return int(some[np.argmin(np.sum((self.vertices[some] - point) ** 2, axis=1))])

    def deepest(self, mask: NDArray[np.bool_], low: Array, high: Array) -> int:
        """The vertex farthest behind the straight line from one point of a profile to another."""
        some = np.flatnonzero(mask)
        x, _, z = self.vertices[some].T
        line = low[0] + (z - low[2]) * (high[0] - low[0]) / (high[2] - low[2])
        return int(some[np.argmin(x - line)])

    def band(self, low: float, high: float) -> NDArray[np.bool_]:
        z = self.vertices[:, 2]
        return (z >= low) & (z <= high)

    def find_middle(self) -> None:
        """Landmarks on the midline."""
        x, y, z = self.vertices.T
        out, part, mid = self.found, self.part, np.abs(y) < 4.0
        head, front, back = part["head"], self.normals[:, 0] > 0.2, self.normals[:, 0] < -0.2
        out["vertex"] = self.pick(head & mid, (0, 0, 1))
        nose = out["pronasale"] = self.pick(head & mid, (1, 0, 0))
        bridge = head & mid & front & self.band(z[nose] + 15, z[nose] + 60)
        sellion = out["sellion"] = self.pick(bridge, (-1, 0, 0))
        brow = head & mid & front & self.band(z[sellion] + 8, z[nose] + 90)
        out["glabella"] = self.pick(brow, (1, 0, 0))
        chin = head & mid & self.band(z[nose] - 110, z[nose] - 50)
        pogonion = out["pogonion"] = self.pick(chin & (self.normals[:, 0] > 0.6), (1, 0, 0))
        below = chin & (self.normals[:, 2] < -0.5) & (x > x[pogonion] - 30)
        out["menton"] = self.pick(below, (0, 0, -1))
        out["opisthocranion"] = self.pick(head & mid, (-1, 0, 0))
        base = self.joint["neck"][2]
        nape = back & mid & self.band(base - 15, base + 15)
        out["cervicale"] = self.near((x[nape].min(), 0, base - 3), back & mid)
        throat = front & mid
        # The notch lies some 50 mm below the seventh cervical vertebra.
        notch = throat & self.band(base - 70, base - 35)
        out["suprasternale"] = self.near((x[notch].mean(), 0, base - 53), notch)
        belly = throat & self.band(190, 215)
        out["omphalion"] = self.near((x[belly].max(), 0, 200), throat)
        seat = mid & self.band(-70, 0) & (self.normals[:, 2] < -0.3)
        out["crotch"] = self.pick(seat, (0, 0, -1))
        waist = 0.5 * (z[out["left waist"]] + z[out["right waist"]])
        level = mid & self.band(waist - 16, waist + 16)
        out["front waist"] = self.pick(level & front, (1, 0, 0))
        out["back waist"] = self.pick(level & back, (-1, 0, 0))

    def find_trunk(self, side: str, s: float) -> None:
        """Landmarks of one side of head and trunk."""
        x, y, z = self.vertices.T
        out, part, half = self.found, self.part, s * y > 4.0
        front, back = self.normals[:, 0] > 0.2, self.normals[:, 0] < -0.2
        trunk = part["pelvis"] | part["lumbar"] | part["thorax"]
        trunk |= part["left clavicle"] | part["right clavicle"]
        shoulder = self.joint[f"{side} upper arm"]
        out[f"{side} tragion"] = self.near((61, s * 72, 748), part["head"] & half)
        out[f"{side} side neck"] = self.near((15, s * 62, 625), half)
        over = half & (np.abs(y - shoulder[1] - s * 14) < 9) & (np.abs(x - shoulder[0]) < 40)
        out[f"{side} acromion"] = self.pick(over, (0, 0, 1))
        fold = half & (np.abs(s * y - 165) < 40) & self.band(400, 520)
        out[f"{side} front axilla"] = self.near((shoulder[0] + 28, s * 158, 470), fold & front)
        out[f"{side} back axilla"] = self.near((shoulder[0] - 55, s * 165, 465), fold & back)
        pit = half & (np.abs(s * y - 160) < 30) & self.band(400, 500) & (self.normals[:, 2] < -0.4)
        out[f"{side} axilla"] = self.pick(pit, (0, 0, 1))
        breast = trunk & half & front & (np.abs(s * y - 100) < 40) & self.band(350, 470)
        bust = out[f"{side} bust point"] = self.pick(breast, (1, 0, 0))
        ribs = self.near((x[bust] - 30, y[bust], z[bust] - 110), trunk & front)
        under = trunk & front & (np.abs(y - y[bust]) < 8) & self.band(z[bust] - 90, z[bust] - 25)
        ends = self.vertices[ribs], self.vertices[bust]
        out[f"{side} underbust"] = self.deepest(under, *ends)
        flank = trunk & half & self.band(170, 320)
        levels = np.arange(175, 316, 10)
        widths = [np.abs(y[flank & (np.abs(z - level) < 9)]).max() for level in levels]
        waist = flank & (np.abs(z - levels[int(np.argmin(widths))]) < 9)
        out[f"{side} waist"] = self.pick(waist, (0, s, 0))
        hip = (trunk | part[f"{side} thigh"]) & half
        level = self.joint[f"{side} thigh"][2]
        out[f"{side} trochanterion"] = self.pick(hip & self.band(level - 12, level + 12), (0, s, 0))
        seat = hip & (s * y > 40) & self.band(-60, 80)
        out[f"{side} gluteal point"] = self.pick(seat, (-1, 0, 0))
        out[f"{side} gluteal fold"] = self.near((-60, s * 90, -42), back & half)

    def find_leg(self, side: str, s: float) -> None:
        """Landmarks of one leg."""
        x, _, z = self.vertices.T
        out, shank, foot = self.found, self.part[f"{side} shank"], self.part[f"{side} foot"]
        leg = self.part[f"{side} thigh"] | shank
        knee, ankle = self.joint[f"{side} shank"], self.joint[f"{side} foot"]
        out[f"{side} patella"] = self.pick(leg & (np.abs(z - knee[2] - 12) < 14), (1, 0, 0))
        hollow = leg & (np.abs(z - knee[2]) < 12) & (self.normals[:, 0] < -0.2)
        out[f"{side} popliteal"] = self.pick(hollow, (-1, 0, 0))
        out[f"{side} calf"] = self.pick(shank & self.band(-560, -430), (-1, 0, 0))
        around = (shank | foot) & self.band(ankle[2] - 25, ankle[2] + 20)
        out[f"{side} lateral malleolus"] = self.pick(around, (0, s, 0))
        out[f"{side} medial malleolus"] = self.pick(around, (0, -s, 0))
        out[f"{side} pternion"] = self.pick(foot, (-1, 0, 0))
        out[f"{side} acropodion"] = self.pick(foot, (1, 0, 0))
        ball = foot & (x > ankle[0] + 70) & (x < ankle[0] + 170)
        out[f"{side} lateral metatarsal"] = self.pick(ball, (0.3, s, 0))
        out[f"{side} medial metatarsal"] = self.pick(ball, (0.3, -s, 0))

    def find_arm(self, side: str, s: float) -> None:
        """Landmarks of one arm."""
        out, fore, hand = self.found, self.part[f"{side} forearm"], self.part[f"{side} hand"]
        shoulder, elbow, wrist = (
            self.joint[f"{side} {name}"] for name in ("upper arm", "forearm", "hand")
        )
        along, up = _unit(wrist - elbow), _unit(shoulder - elbow)
        close = np.linalg.norm(self.vertices - elbow, axis=1) < 75.0
        arm = self.part[f"{side} upper arm"] | fore
        out[f"{side} olecranon"] = self.pick(arm & close, -(along + up))
        fingers = np.flatnonzero(hand)
        reach = np.linalg.norm(self.vertices[fingers] - wrist, axis=1)
        tip = out[f"{side} dactylion"] = int(fingers[np.argmax(reach)])
        thumb = self.pick(hand, (1, -0.5 * s, 0.6))
        palm = _unit(self.vertices[tip] - wrist)
        radial = _unit(np.cross(palm, np.cross(_unit(self.vertices[thumb] - wrist), palm)))
        ring = (fore | hand) & (np.abs((self.vertices - wrist) @ along + 4.0) < 9.0)
        out[f"{side} radial styloid"] = self.pick(ring, radial)
        out[f"{side} ulnar styloid"] = self.pick(ring, -radial)


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def main(out: Path) -> None:
    torch.set_default_dtype(torch.float64)
    model = anny.Anny(local_changes="all", phenotypes="all")
    names, joints = list(skeleton()), skeleton()
    faces = model.faces.numpy()
    count = len(model.template_vertices)
    edges = np.vstack([faces[:, :2], faces[:, 1:]])
    links = coo_array((np.ones(len(edges)), edges.T), shape=(count, count))
    _, label = connected_components(links, directed=False)
    kept = np.flatnonzero(label == np.argmax(np.bincount(label)))  # without eyes and tongue
    number = np.full(count, -1)
    number[kept] = np.arange(len(kept))
    faces = number[faces[np.isin(faces[:, 0], kept)]]

    bones = list(model.bone_labels)
    weights = np.zeros((count, len(names)))
    group = np.array([names.index(joint_of(bone)) for bone in bones])
    indices, values = model.vertex_bone_indices.numpy(), model.vertex_bone_weights.numpy()
    np.add.at(weights, (np.arange(count)[:, None], group[indices]), values)
    weights = weights[kept] / weights[kept].sum(axis=1, keepdims=True)

    seats = [bones.index(joints[name][2]) for name in names]
    basis, seat_basis = to_body(model.blendshapes)[:, kept], to_body(model.bone_heads_blendshapes)
    seat_basis = seat_basis[:, seats]
    basis -= seat_basis[:, :1]
    seat_basis = seat_basis - seat_basis[:, :1]
    coefficients = sample_population(model)
    mean = coefficients.mean(axis=0)
    vertices = to_body(model.template_vertices)[kept] + np.tensordot(mean, basis, 1)
    at = to_body(model.template_bone_heads)[seats] + np.tensordot(mean, seat_basis, 1)

    # Principal components in the space of vertices, through the coefficients' covariance.
    values, vectors = np.linalg.eigh(np.cov(coefficients.T))
    scaled = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    displaced = scaled @ basis.reshape(len(mean), -1)
    values, vectors = np.linalg.eigh(displaced @ displaced.T)
    strongest = vectors[:, ::-1][:, :SHAPES].T
    shapes = (strongest @ displaced).reshape(SHAPES, -1, 3)

    normals = vertex_normals(vertices, faces)
    author = Author(vertices, normals, weights.argmax(axis=1), at)
    for side, s in (("left", 1.0), ("right", -1.0)):
        author.find_trunk(side, s)
        author.find_leg(side, s)
        author.find_arm(side, s)
    author.find_middle()
    limit = build_limit(faces, len(vertices))
    vertices, shapes = limit @ vertices, np.stack([limit @ shape for shape in shapes])
    scales = np.abs(shapes).max(axis=(1, 2)) / 32767.0
    sigmas = json.loads(Path(__file__).with_name("sigmas.json").read_text())
    part = np.array([PARTS.index(name if name in PARTS else "trunk") for name in names])
    floor = np.array([0.0, 0.0, vertices[:, 2].min()])
    parents = [-1 if joints[name][0] is None else names.index(joints[name][0]) for name in names]
    np.savez_compressed(
        out,
        vertices=(vertices - floor).astype(np.float32),
        faces=faces.astype(np.uint16),
        shapes=np.round(shapes / scales[:, None, None]).astype(np.int16),
        shape_scales=scales.astype(np.float32),
        joints=at - floor,
        joint_shapes=np.tensordot(strongest @ scaled, seat_basis, 1).astype(np.float32),
        parents=np.array(parents),
        joint_names=np.array(names),
        weights=np.round(255.0 * weights).astype(np.uint8),
        parts=part[weights.argmax(axis=1)].astype(np.uint8),
        part_names=np.array(PARTS),
        landmark_names=np.array(list(author.found)),
        landmark_vertices=np.array(list(author.found.values())),
        landmark_sigma_mm=np.array([sigmas.get(name, 5.0) for name in author.found]),
        hidden=find_hidden(vertices, faces, normals),
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
