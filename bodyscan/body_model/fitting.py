"""Fit the parametric body to a scanned surface: shape and pose, then a smooth residual.

Gauss-Newton on distances along the scan's normals (point to plane) between the template's vertices
and the measured surface, in the manner of non-rigid ICP (Allen, Curless, Popovic 2003; Amberg,
Romdhani, Vetter 2007). Matches are closest in position and normal together, so that an arm does not
fit the trunk beside it, go both ways, so that no limb of the scan stays without one of the template's,
and are weighed by a redescending kernel (Geman-McClure) that narrows from the error of the start to
what the basis cannot make. Priors: shapes are unit normal, joints stay near a standing pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from bodyscan.arrays import Array, Indices
from bodyscan.body_model.template import (
    BodyShapeAndPose,
    BodyTemplate,
    PosedBody,
    drop_side,
    pose_body,
)
from bodyscan.geometry.robust import rms
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.mesh.topology import compute_vertex_normals, list_directed_edges

BASIS_MM = 4.0
"""What bodies have that the basis cannot make, RMS: asymmetry, muscles, cloth."""
JOINT_DEG = {
    "pelvis": 10.0, "lumbar": 8.0, "thorax": 8.0, "neck": 12.0, "head": 12.0, "clavicle": 8.0,
    "upper arm": 30.0, "forearm": 25.0, "hand": 20.0, "thigh": 12.0, "shank": 8.0, "foot": 12.0,
}  # fmt: skip
"""Standard deviation of the joints of people who stand to be scanned, about each axis, degrees."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Measured points (N, 3), mm, body frame, with outward unit normals (N, 3)."""

    points: Array
    normals: Array


@dataclass(frozen=True, eq=False)
class FittedBody:
    """A template laid over a scan.

    vertices: (V, 3), mm, body frame; the template's topology.
    shape: (K,) of the template, and posed: its body in that shape and pose, before the residual.
    distance_mm: (V,), from each vertex to the surface along its normal; NaN where nothing was measured.
    rms_mm: of the distances of shape and pose alone: what the basis could not make.
    agreement: share of the template that lies on the surface, and of the surface that lies on the
        template, the mean of the two.
    """

    template: BodyTemplate
    vertices: Array
    shape: Array
    posed: PosedBody
    distance_mm: Array
    rms_mm: float
    agreement: float = 1.0

    @property
    def rest_joints(self) -> Array:
        """Joints (J, 3) of its shape in the rest pose, mm."""
        return self.template.joints + np.tensordot(self.shape, self.template.joint_shapes, axes=1)

    def transform(self, a_from_b: RigidTransform) -> FittedBody:
        """Transform from frame b to frame a."""
        posed = PosedBody(
            a_from_b.apply(self.posed.vertices),
            a_from_b.rotation @ self.posed.rotations,
            a_from_b.apply(self.posed.joints),
        )
        return replace(self, vertices=a_from_b.apply(self.vertices), posed=posed)

    def find_rest_vertices(self, weights: Array) -> Array:
        """Vertices (V, 3) in the rest pose, from which skinning by weights (V, J) gives `vertices`."""
        rotations = self.posed.rotations
        offsets = self.posed.joints - np.einsum("jab,jb->ja", rotations, self.rest_joints)
        blended = np.einsum("vj,jab->vab", weights, rotations)
        moved = self.vertices - weights @ offsets
        return np.asarray(np.linalg.solve(blended, moved[:, :, None])[:, :, 0])


@dataclass(frozen=True, eq=False)
class _Region:
    """What is fitted of a body: indices of the template's vertices, of the surface's points, and of the
    parameters that move; the share of the body."""

    vertices: Indices
    points: Indices
    moving: Indices
    share: float = 1.0


@dataclass(frozen=True, eq=False)
class _Matches:
    """M vertices, by index (M,), the points they match (M, 3), normals there (M, 3), weights (M,)."""

    vertices: Indices
    points: Array
    normals: Array
    weights: Array


def fit_body(template: BodyTemplate, surface: Surface) -> FittedBody:
    """Fit a template to a standing body's surface (body frame, floor at z = 0)."""
    tree = KDTree(join_positions_normals(surface.points, surface.normals))
    points = np.arange(0, len(surface.points), max(1, len(surface.points) // 4000))
    count = 3 + template.joints.size + len(template.shapes)
    whole = _Region(np.arange(len(template.vertices)), points, np.arange(count))
    # Degrees of the arms from the trunk; each start finds arms within 15 of it.
    starts = [_start(template, surface, arms) for arms in (15.0, 35.0, 55.0)]
    coarse = (120.0, 100.0, 80.0, 70.0, 60.0, 50.0, 40.0)
    tried = [_fit_pose(template, surface, tree, start, coarse, whole) for start in starts]
    body, _ = min(tried, key=lambda pair: pair[1])
    fine = (35.0, 30.0, 25.0, 22.0, 20.0, 18.0, 16.0, 14.0, 12.0)
    body, _ = _fit_pose(template, surface, tree, body, fine, whole)
    body = _seat_hands(template, surface, tree, body)
    body, _ = _fit_pose(template, surface, tree, body, (10.0, 10.0, 10.0), whole)
    posed = pose_body(template, body)
    normals = _compute_normals(template, posed.vertices)
    missed = _measure_distance(template, surface, tree, posed.vertices, normals)
    missed = missed[np.isfinite(missed)]
    vertices = _fit_residual(template, surface, tree, posed.vertices)
    normals = _compute_normals(template, vertices)
    distance = _measure_distance(template, surface, tree, vertices, normals)
    rms_mm = rms(missed) if missed.size else float("nan")
    back = _match_back(template, surface, vertices, normals, 10.0, whole).weights > 0.0
    agreement = 0.5 * float(np.isfinite(distance[~template.hidden]).mean() + back.mean())
    return FittedBody(template, vertices, body.shape, posed, distance, rms_mm, agreement)


def _measure_distance(
    template: BodyTemplate, surface: Surface, tree: KDTree, vertices: Array, normals: Array
) -> Array:
    """Signed distance (V,) mm of vertices from the surface, along its normals; NaN without a match."""
    matches = _match(template, surface, tree, vertices, normals, 10.0, np.arange(len(vertices)))
    distance = np.einsum("vi,vi->v", vertices - matches.points, matches.normals)
    distance[matches.weights == 0.0] = np.nan
    return distance


def join_positions_normals(points: Array, normals: Array) -> Array:
    """Points (N, 6) whose distance is that of position and normal together, mm."""
    # Normals at right angles count as 80 mm: the opposite sides of an arm, so far apart, never match.
    return np.hstack([points, 80.0 / np.sqrt(2.0) * normals])


def _start(template: BodyTemplate, surface: Surface, arms_deg: float) -> BodyShapeAndPose:
    """The likeliest shape of the surface's stature, on the floor, arms at an angle from the trunk."""
    top, sole = int(template.vertices[:, 2].argmax()), int(template.vertices[:, 2].argmin())
    gain = (template.shapes[:, top, 2] - template.shapes[:, sole, 2]).astype(np.float64)
    mean = template.vertices[top, 2] - template.vertices[sole, 2]
    shape = gain * (surface.points[:, 2].max() - mean) / (gain @ gain)
    rotations = np.zeros_like(template.joints)
    for side, turn in (("left", 1.0), ("right", -1.0)):
        joint = template.joint_names.index(f"{side} upper arm")
        elbow = template.joint_names.index(f"{side} forearm")
        along = template.joints[elbow] - template.joints[joint]
        now = np.degrees(np.arctan2(abs(along[1]), -along[2]))
        rotations[joint, 0] = turn * np.radians(arms_deg - now)
    vertices = pose_body(template, BodyShapeAndPose(shape, rotations, np.zeros(3))).vertices
    centre = np.median(surface.points[:, :2], axis=0) - np.median(vertices[:, :2], axis=0)
    return BodyShapeAndPose(shape, rotations, np.append(centre, -vertices[:, 2].min()))


def _compute_normals(template: BodyTemplate, vertices: Array) -> Array:
    return compute_vertex_normals(vertices, template.faces).astype(np.float64)


def _match(
    template: BodyTemplate,
    surface: Surface,
    tree: KDTree,
    vertices: Array,
    normals: Array,
    scale_mm: float,
    used: Indices,
) -> _Matches:
    """Match vertices (by index) to closest points; weight 0 far off, with unlike normals, by holes."""
    _, nearest = tree.query(join_positions_normals(vertices[used], normals[used]))
    points, target = surface.points[nearest], surface.normals[nearest]
    weights = _weigh(vertices[used] - points, normals[used], target, scale_mm)
    weights[template.hidden[used]] = 0.0
    return _Matches(used, points, target, weights)


def _match_back(
    template: BodyTemplate,
    surface: Surface,
    vertices: Array,
    normals: Array,
    scale_mm: float,
    region: _Region,
) -> _Matches:
    """Match a few thousand points to their closest vertices: what draws a limb that fits nothing yet to
    the surface that nothing fits."""
    points, target = surface.points[region.points], surface.normals[region.points]
    shown = region.vertices[~template.hidden[region.vertices]]
    there = KDTree(join_positions_normals(vertices[shown], normals[shown]))
    _, nearest = there.query(join_positions_normals(points, target))
    found = shown[nearest]
    weights = _weigh(vertices[found] - points, normals[found], target, scale_mm)
    return _Matches(found, points, target, weights)


def _weigh(offset: Array, normals: Array, target: Array, scale_mm: float) -> Array:
    """Geman-McClure weights of offsets (M, 3): 0 beyond three scales, with normals 60 degrees apart,
    and where the offset runs along the surface, beside a hole's rim."""
    distance = np.linalg.norm(offset, axis=1)
    along = np.abs(np.einsum("vi,vi->v", offset, target))
    aside = np.sqrt(np.maximum(distance**2 - along**2, 0.0))
    near = (distance < 3.0 * scale_mm) & (aside < 15.0 + along)
    cosine = np.einsum("vi,vi->v", normals, target)
    return np.where(near & (cosine > 0.5), 1.0 / (1.0 + (distance / scale_mm) ** 2) ** 2, 0.0)


def _fit_pose(
    template: BodyTemplate,
    surface: Surface,
    tree: KDTree,
    body: BodyShapeAndPose,
    scales_mm: tuple[float, ...],
    region: _Region,
) -> tuple[BodyShapeAndPose, float]:
    """Refine shape and pose, one Gauss-Newton step a scale; returns them and the last cost."""
    cost, shown = np.inf, ~template.hidden[region.vertices]
    for scale in scales_mm:
        posed = pose_body(template, body)
        normals = _compute_normals(template, posed.vertices)
        found = _match(template, surface, tree, posed.vertices, normals, scale, region.vertices)
        back = _match_back(template, surface, posed.vertices, normals, scale, region)
        sigma_mm = max(BASIS_MM, scale / 4.0)
        body, cost = _step(template, body, posed, [found, back], sigma_mm, region)
        missing = 2.0 - found.weights[shown].mean() - back.weights.mean()
        cost += missing * region.share * len(template.vertices) / 25.0
    return body, cost


def _seat_hands(
    template: BodyTemplate, surface: Surface, tree: KDTree, body: BodyShapeAndPose
) -> BodyShapeAndPose:
    """Fit each arm by itself from several turns of its hand and forearm, and keep the best.

    Fingers that lie on their neighbours fit well nearly everywhere: of 20 hands of random bodies 7 were
    fitted so, with their tips 20 to 60 mm off and the wrists 15.
    """
    for side in ("left", "right"):
        region = _cover_arm(template, surface, body, side)
        if len(region.points) == 0:
            continue
        elbow, wrist = (template.joint_names.index(f"{side} {n}") for n in ("forearm", "hand"))
        part = template.parts == template.part_names.index(f"{side} hand")
        spread = np.cov(template.vertices[part].T)
        across = np.linalg.eigh(spread)[1][:, 0]  # square to the palm
        along = template.joints[wrist] - template.joints[elbow]
        along /= np.linalg.norm(along)
        tried = []
        # A finger beside its place is 13 degrees of the hand; forearms turn by 25 (JOINT_DEG).
        for joint, axis, degrees in (
            (wrist, across, (0.0, 13.0, -13.0)),
            (elbow, along, (30.0, -30.0)),
        ):
            for turn in degrees:
                step = np.zeros(3 + template.joints.size + len(template.shapes))
                step[3 + 3 * joint : 6 + 3 * joint] = np.radians(turn) * axis
                start = body.add_step(step)
                scales = (20.0, 14.0, 10.0, 10.0)
                tried.append(_fit_pose(template, surface, tree, start, scales, region))
        body, _ = min(tried, key=lambda pair: pair[1])
    return body


def _cover_arm(
    template: BodyTemplate, surface: Surface, body: BodyShapeAndPose, side: str
) -> _Region:
    """Forearm and hand, the points of the surface that lie closest to them, and the arm's turns."""
    parts = [template.part_names.index(f"{side} {name}") for name in ("forearm", "hand")]
    arm = np.isin(template.parts, parts)
    joints = [
        template.joint_names.index(f"{side} {name}") for name in ("upper arm", "forearm", "hand")
    ]
    sample = np.arange(0, len(surface.points), max(1, len(surface.points) // 20_000))
    distance, nearest = KDTree(pose_body(template, body).vertices).query(surface.points[sample])
    points = sample[(distance < 50.0) & arm[nearest]]  # an arm's width
    moving = 3 + 3 * np.array(joints)[:, None] + np.arange(3)
    return _Region(np.flatnonzero(arm)[::2], points, moving.ravel(), float(arm.mean()))


def _step(
    template: BodyTemplate,
    body: BodyShapeAndPose,
    posed: PosedBody,
    matches: Sequence[_Matches],
    sigma_mm: float,
    region: _Region,
) -> tuple[BodyShapeAndPose, float]:
    """One Gauss-Newton step of pose and shape, and the cost before it; sigma_mm: of a distance."""
    moving = region.moving
    joints = np.radians([JOINT_DEG[drop_side(one)] for one in template.joint_names]) ** -2.0
    shapes = np.ones(len(template.shapes))
    precision = np.concatenate([np.full(3, 1e-6), np.repeat(joints, 3), shapes])[moving]
    here = np.concatenate([np.zeros(3), body.rotations.ravel(), body.shape])[moving]
    information, gradient = np.diag(precision), precision * here
    cost = float(precision @ here**2)
    for some in matches:
        used = np.flatnonzero(some.weights > 0.0)[::2]
        at, normals = some.vertices[used], some.normals[used]
        jacobian = differentiate(template, body, posed, at, normals)[:, moving]
        residual = np.einsum("vi,vi->v", posed.vertices[at] - some.points[used], normals)
        # What the basis cannot make is smooth over 50 mm: a body has 500 such patches in 1.8 m^2.
        patches = 500.0 * region.share / max(len(some.weights) / 2, 1)
        weights = some.weights[used] / sigma_mm**2 * patches
        information += (jacobian * weights[:, None]).T @ jacobian
        gradient += jacobian.T @ (weights * residual)
        cost += float(weights @ residual**2)
    step = np.zeros(3 + body.rotations.size + len(body.shape))
    step[moving] = np.linalg.solve(information, -gradient)
    moved = body.add_step(step)
    return replace(moved, shape=np.clip(moved.shape, -4.0, 4.0)), cost


def differentiate(
    template: BodyTemplate, body: BodyShapeAndPose, posed: PosedBody, used: Indices, normals: Array
) -> Array:
    """Derivatives (M, 3 + 3 J + K) of displacements along normals by root, turns and shapes.

    Turns are right increments of the joints' own rotations, in their own axes.
    """
    weights = template.weights[used]
    shaped = template.vertices[used] + np.tensordot(body.shape, template.shapes[:, used], axes=1)
    rest = template.joints + np.tensordot(body.shape, template.joint_shapes, axes=1)
    moves = template.descendants
    at = np.einsum("jab,mjb->mja", posed.rotations, shaped[:, None] - rest) + posed.joints
    columns = [normals]
    for joint in range(len(rest)):
        below = weights * moves[joint]
        arm = np.einsum("mj,mja->ma", below, at - posed.joints[joint])
        columns.append(np.cross(arm, normals) @ posed.rotations[joint])
    blended = np.einsum("mj,jab->mab", weights, posed.rotations)
    facing = np.einsum("ma,mab->mb", normals, blended)
    by_shape = np.einsum("mb,kmb->mk", facing, template.shapes[:, used])
    offsets = np.zeros_like(template.joint_shapes, dtype=np.float64)
    for joint, parent in enumerate(template.parents):
        if parent >= 0:
            bone = template.joint_shapes[:, joint] - template.joint_shapes[:, parent]
            offsets[:, joint] = offsets[:, parent] + bone @ posed.rotations[parent].T
    shifts = offsets - np.einsum("jab,kjb->kja", posed.rotations, template.joint_shapes)
    by_shape += np.einsum("ma,mj,kja->mk", normals, weights, shifts, optimize=True)
    return np.hstack([*columns, by_shape])


def _fit_residual(template: BodyTemplate, surface: Surface, tree: KDTree, vertices: Array) -> Array:
    """Displace vertices onto the surface along its normals, smoothly: biharmonic in the displacement.

    What slides along the surface stays where the prior on shape and pose has put it.
    """
    laplacian = _build_laplacian(template.faces, len(vertices))
    smooth = (laplacian.T @ laplacian).tocsc()
    rest, everywhere = vertices, np.arange(len(vertices))
    for stiffness, scale in ((10.0, 20.0), (1.0, 12.0), (0.1, 8.0), (0.1, 8.0)):
        normals = _compute_normals(template, vertices)
        matches = _match(template, surface, tree, vertices, normals, scale, everywhere)
        gap = np.einsum("vi,vi->v", matches.points - vertices, matches.normals)
        target = vertices - rest + gap[:, None] * matches.normals
        system = stiffness * smooth + sparse.diags(matches.weights + 1e-4)
        factor = splu(
            system.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        vertices = rest + factor.solve(matches.weights[:, None] * target)
    return vertices


def _build_laplacian(faces: Indices, count: int) -> sparse.csr_matrix:
    """The uniform graph Laplacian (V, V) of a closed mesh, each edge of which runs both ways."""
    edges = list_directed_edges(faces)
    links = sparse.csr_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    degree = np.asarray(links.sum(axis=1)).ravel()
    return sparse.csr_matrix(sparse.identity(count) - sparse.diags(1.0 / degree) @ links)
