"""Name faces descriptively: ``top``, ``bore_12mm_left``, ``chamfer_30deg``.

Signal chain: faces -> the name in the CAD file, if a person wrote one -> else the kind of the face with its size -> for
equal names, the position -> for names that are still equal, a number by z, y, x, then by area.

Names depend on geometry alone. A file that is read again, or exported with its entities in another order, gives the
same names. Left and right are -x and +x, front and back -y and +y, bottom and top -z and +z, seen from the front with z
up.
"""

from __future__ import annotations

import re
import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from decimal import ROUND_HALF_UP, Decimal

import numpy as np
from scipy.spatial import cKDTree

from characterisation.features.surfaces import Cone, Cylinder, Plane, Sphere
from characterisation.files.arrays import Floats
from mitsim.scene.authoring.face import Face, Torus

#: names of directions along x, y, z: (minus, plus)
SIDES = (("left", "right"), ("front", "back"), ("bottom", "top"))

#: a plane faces an axis within this cosine: 0.5 deg
_ALONG = float(np.cos(np.deg2rad(0.5)))

#: largest width of a chamfer as a share of the part's diagonal
_CHAMFER_SHARE = 0.08

#: a cylinder that spans more than this angle is a bore or a boss, else a fillet [rad]
ROUND = np.deg2rad(200.0)

#: a concave cylinder that spans more than this angle, half a turn, is the end of a slot; a fillet joins two faces [rad]
_HALF = np.deg2rad(150.0)

#: positions differ if their distance exceeds this share of the part's size along that axis
_APART = 0.02

#: faces form two clusters along an axis if the gap between them exceeds this share of their distance; over a half, so
#: that the middle lies in the gap: noise would give the middle one of three holes a side; chosen
_GAP = 0.55

#: noise of a file, and facets of the default mesh at the rim of a round face, move its place by less [mm]; chosen
_NOISE_MM = 0.02

#: the wide end of a cone and the bore that it ends agree within this share of its radius; chosen
_OF_RADIUS = 0.01

#: faces touch where their vertices are this close [mm]; the faces of a CAD file share the points of their edges; chosen
_TOUCHING_MM = 1e-3

#: placeholders of CAD programs for faces without a name
_NO_NAME = re.compile(r"(none|null|unnamed|advanced_?face|face|surface|shape|body|solid|\W)*[\d\W_]*", re.IGNORECASE)

#: names of bodies that a program wrote for want of one: OpenCASCADE's product and label, a GUID, the type of the shape
_NO_PART = re.compile(
    r"(open cascade step translator.*|=>\[[\d:]*\]|\{?[0-9a-f]{8}(-?[0-9a-f]{4}){3}-?[0-9a-f]{12}\}?"
    r"|compound|compsolid|(manifold[ _])?solid([ _]brep)?|shell|shape|body|part|unnamed|untitled|no[ _]?name|none|null"
    r"|\W)*",
    re.IGNORECASE | re.DOTALL,
)

#: ids of finishes in a scene (:func:`~mitsim.scene.authoring.part_folder.finish_names`)
_FINISH = re.compile(r"finish(_[0-9a-f]{6}|_none)?", re.IGNORECASE)

#: longest name from a CAD file [bytes]: it becomes part of a file's name; chosen
_LONGEST = 60

#: longest name of an assembly's part before it [bytes]; chosen
_LONGEST_PART = 30

#: lengths and angles are rounded after noise below this many decimal places is removed: 9.525 mm is written in inches,
#: too
_PLACES = 4


def with_names(faces: Sequence[Face]) -> list[Face]:
    """Return the faces with descriptive, unique names; planes first, then round faces, then the rest, by size."""
    if not faces:
        return []
    corners = np.concatenate([face.vertices for face in faces])
    low, high = corners.min(axis=0), corners.max(axis=0)
    parts = _part_names(faces)
    groups = defaultdict(list)
    for number, face in enumerate(faces):
        groups[parts[number] + (_given(face) or described_name(face, faces, low, high))].append(number)
    names: dict[int, str] = {}
    for base, members in groups.items():
        for number, suffix in zip(members, _distinguished([faces[n] for n in members], high - low), strict=True):
            names[number] = base + suffix
    return _in_order([replace(face, name=name) for face, name in zip(faces, _unique(names, faces), strict=True)])


def _unique(names: dict[int, str], faces: Sequence[Face]) -> list[str]:
    """Return unique names by face; those of files differ in more than capitals, and from finishes of the scene."""
    taken: dict[str, int] = {}
    out: dict[int, str] = {}
    rank = _ranks(np.array([_place(face) for face in faces]))
    for number in sorted(names, key=lambda index: (names[index], rank[index], faces[index].area)):
        base = name = f"face_{names[number]}" if _FINISH.fullmatch(names[number]) else names[number]
        while name.casefold() in taken:
            taken[base.casefold()] += 1
            name = f"{base}_{taken[base.casefold()]}"
        taken[name.casefold()] = 1
        out[number] = name
    return [out[number] for number in range(len(faces))]


def _in_order(faces: list[Face]) -> list[Face]:
    kinds = ("plane", "cylinder", "cone", "sphere", "torus", "face")
    return sorted(faces, key=lambda face: (kinds.index(face.kind), -round(face.area, 4), face.name))


def _given(face: Face) -> str:
    """Return the name in the CAD file if a person wrote it: it contains a word and is not the program's counter."""
    name = face.drawn_name
    letters = "".join(character for character in name if not _is_mark(character))
    # an ideograph or a syllable is a word; a single letter of an alphabet is not
    word = re.search(r"[^\W\d_]{2}", letters) or any(unicodedata.category(letter) == "Lo" for letter in letters)
    return identifier(name) if word and not _NO_NAME.fullmatch(letters) else ""


def identifier(name: str, longest: int = _LONGEST) -> str:
    """Return a name valid in files, XML and tasks: letters of any script, digits, dash and underscore, a letter first.

    Letters keep their marks. ``longest`` is in bytes, since a name may become part of a file's name.
    """
    composed = unicodedata.normalize("NFC", name)
    kept = "".join(
        character if character.isalnum() or character in "_-" or _is_mark(character) else " " for character in composed
    )
    plain = re.sub(r" +", "_", kept).strip("_-").encode()[:longest].decode("utf-8", "ignore").rstrip("_-")
    return plain if plain[:1].isalpha() else f"face_{plain}".rstrip("_")


def _is_mark(character: str) -> bool:
    """Return whether a character is a mark on the letter before it."""
    return unicodedata.category(character).startswith("M")


def _part_names(faces: Sequence[Face]) -> list[str]:
    """Return a prefix such as ``lid_`` for each face of an assembly's part; empty for a single body."""
    bodies = defaultdict(list)
    for face in faces:
        bodies[face.body].append(face)
    if len(bodies) == 1:
        return [""] * len(faces)
    middles = [np.concatenate([face.vertices for face in members]).mean(axis=0) for members in bodies.values()]
    rank = dict(zip(bodies, _ranks(np.array(middles)), strict=True))
    given = {body: "" if _NO_PART.fullmatch(members[0].part) else members[0].part for body, members in bodies.items()}
    groups = defaultdict(list)
    for body in sorted(bodies, key=lambda body: (given[body], rank[body][::-1])):
        groups[identifier(given[body] or "part", _LONGEST_PART)].append(body)
    names = {
        body: name if len(alike) == 1 else f"{name}_{number}"
        for name, alike in groups.items()
        for number, body in enumerate(alike, 1)
    }
    return [f"{names[face.body]}_" for face in faces]


def described_name(face: Face, faces: Sequence[Face], low: Floats, high: Floats) -> str:
    """Return the kind of a face with its size, among the ``faces`` of a part.

    ``face``, ``faces``: the face, and all of the part. ``low``, ``high``: (3,) [mm] Corners of the part.
    """
    surface, part = face.surface, float(np.linalg.norm(high - low))
    if isinstance(surface, Plane):
        return _plane_name(face, surface, faces, low, high)
    if isinstance(surface, Cylinder):
        kind = cylinder_kind(face, surface)
        whole = kind in ("boss", "bore")
        return f"{kind}_{size(2 * surface.radius)}mm" if whole else f"{kind}_r{size(surface.radius)}mm"
    if isinstance(surface, Cone):
        angle = np.rad2deg(2 * surface.half_angle)
        if not face.convex:
            kind = "cone" if any(_ends(face, other) for other in faces) else "countersink"
            return f"{kind}_{degrees(angle)}deg"
        narrow = np.ptp((face.vertices - surface.point) @ surface.axis) < _CHAMFER_SHARE * part
        return f"chamfer_{degrees(angle / 2)}deg" if narrow else f"cone_{degrees(angle)}deg"
    if isinstance(surface, Sphere):
        return f"{'ball' if face.convex else 'seat'}_{size(2 * surface.radius)}mm"
    if isinstance(surface, Torus):
        return f"{'round' if face.convex else 'fillet'}_r{size(surface.tube)}mm"
    return "freeform" if face.normals is not None else "face"


def cylinder_kind(face: Face, surface: Cylinder) -> str:
    """Return what a cylindrical face is called: ``boss`` or ``bore`` if it goes round far enough to be measured."""
    angle = round_angle(face.vertices, surface.axis, surface.point)
    if angle > ROUND:
        return "boss" if face.convex else "bore"
    return "round" if face.convex else "slot_end" if angle > _HALF else "fillet"


def _plane_name(face: Face, surface: Plane, faces: Sequence[Face], low: Floats, high: Floats) -> str:
    along = int(np.argmax(np.abs(surface.normal)))
    if abs(surface.normal[along]) >= _ALONG:
        up = bool(surface.normal[along] > 0)
        at = float(surface.point[along])
        name = SIDES[along][up]
        if abs(at - (high if up else low)[along]) < 1e-3 * max(float(high[along] - low[along]), 1.0):
            return name
        return f"{name}_at_{'xyz'[along]}{size(at)}mm"
    narrow = _extents(face).min() < _CHAMFER_SHARE * float(np.linalg.norm(high - low))
    off = float(np.rad2deg(np.arccos(np.abs(surface.normal).max())))
    if narrow and not _is_floor(face, surface, faces):
        return f"chamfer_{degrees(off)}deg"
    upright = abs(surface.normal[2]) < np.sqrt(1 - _ALONG**2)  # like the sides of a hexagonal nut
    if upright:
        return f"side_{degrees(off)}deg"
    return f"slope_{degrees(np.rad2deg(np.arccos(abs(surface.normal[2]))))}deg"  # against the horizontal


def _is_floor(face: Face, surface: Plane, faces: Sequence[Face]) -> bool:
    """Return whether a plane's neighbours rise from it, as from the floor of a bore, along most of its outline."""
    tree, rise = cKDTree(face.vertices), 0.0
    low, high = face.vertices.min(axis=0) - _TOUCHING_MM, face.vertices.max(axis=0) + _TOUCHING_MM
    for other in faces:
        near = ((other.vertices >= low) & (other.vertices <= high)).all(axis=1)
        if other is face or other.body != face.body or not near.any():
            continue
        near[near] = tree.query(other.vertices[near], distance_upper_bound=_TOUCHING_MM)[0] < np.inf
        touching = near[other.triangles]
        corners, touches = other.vertices[other.triangles][(two := touching.sum(axis=1) == 2)], touching[two]
        ends = corners[touches].reshape(-1, 2, 3)
        beyond = (corners[~touches] - surface.point) @ surface.normal
        rise += float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) @ np.sign(beyond))
    return rise > 0


def _ends(face: Face, bore: Face) -> bool:
    """Return whether the wide end of a cone lies in a bore, as the tip of a drill, and not at a surface."""
    cone, cylinder = face.surface, bore.surface
    if not isinstance(cone, Cone) or not isinstance(cylinder, Cylinder) or bore.convex or bore.body != face.body:
        return False
    limit = _OF_RADIUS * cone.radius
    way = cone.point - cylinder.point
    off = float(np.linalg.norm(way - (way @ cylinder.axis) * cylinder.axis))
    along = (bore.vertices - cone.point) @ cylinder.axis
    aligned = abs(float(cone.axis @ cylinder.axis)) >= _ALONG
    at_end = min(abs(float(along.min())), abs(float(along.max()))) <= limit
    return aligned and at_end and off <= limit and abs(cone.radius - cylinder.radius) <= limit


def _extents(face: Face) -> Floats:
    """Return length and width [mm] of a plane face along its own principal directions."""
    local = face.vertices - face.vertices.mean(axis=0)
    _, _, directions = np.linalg.svd(local, full_matrices=False)
    return np.asarray(np.ptp(local @ directions[:2].T, axis=0))


def round_angle(vertices: Floats, axis: Floats, point: Floats) -> float:
    """Return the angle about an axis that a face spans [rad]: 2 pi less the largest gap between its vertices (n, 3)."""
    first = np.eye(3)[np.argmin(np.abs(axis))]
    first = first - (first @ axis) * axis
    local = vertices - point
    angle = np.sort(np.arctan2(local @ np.cross(axis, first), local @ first))
    gaps = np.diff(np.append(angle, angle[0] + 2 * np.pi))
    steps = len(vertices)
    gap = float(gaps.max())
    return 2 * np.pi if gap < max(np.deg2rad(50.0), 4 * np.pi / steps) else 2 * np.pi - gap


def size(value: float) -> str:
    """Format a length for a name: to 0.01 mm, with an underscore as decimal point (``12_5``)."""
    text = f"{_rounded(value, 2):.2f}".rstrip("0").rstrip(".")
    return ("0" if text in ("-0", "") else text).replace(".", "_")


def degrees(value: float) -> str:
    """Format an angle for a name: to 1 deg."""
    return f"{_rounded(value, 0):.0f}"


def _rounded(value: float, decimals: int) -> Decimal:
    """Round a number half away from zero, so that noise of the file does not decide."""
    return Decimal(f"{value:.{_PLACES}f}").quantize(Decimal(1).scaleb(-decimals), ROUND_HALF_UP)


def _place(face: Face) -> Floats:
    """Return the position of a face: the centre of its box, on its axis if it has one."""
    middle = (face.vertices.min(axis=0) + face.vertices.max(axis=0)) / 2
    if isinstance(face.surface, Cylinder | Cone):
        point, axis = face.surface.point, face.surface.axis
        middle = point + ((middle - point) @ axis) * axis
    return np.asarray(middle)


def _distinguished(faces: list[Face], extent: Floats) -> list[str]:
    """Return suffixes that distinguish faces with equal descriptions: sides if sufficient, else numbers by z, y, x."""
    if len(faces) == 1:
        return [""]
    positions = np.array([_place(face) for face in faces])
    spread = np.ptp(positions, axis=0)
    far = spread > np.maximum(_APART * extent, _NOISE_MM)
    words: list[list[str]] = [[] for _ in faces]
    for along in (2, 1, 0):
        if far[along] and _form_two_clusters(positions[:, along]):
            middle = (positions[:, along].max() + positions[:, along].min()) / 2
            for word, position in zip(words, positions, strict=True):
                word.append(SIDES[along][bool(position[along] > middle)])
    suffixes = ["".join(f"_{side}" for side in word) for word in words]
    out: dict[int, str] = {}
    groups = defaultdict(list)
    for number, suffix in enumerate(suffixes):
        groups[suffix].append(number)
    rank = _ranks(positions)
    for suffix, members in groups.items():
        order = sorted(members, key=lambda member: (rank[member], faces[member].area))
        for count, number in enumerate(order, 1):
            out[number] = suffix if len(members) == 1 else f"{suffix}_{count}"
    return [out[number] for number in range(len(faces))]


def _ranks(positions: Floats) -> list[list[int]]:
    """Return the ranks of positions (n, 3) [mm] by z, y and x; those less than :data:`_NOISE_MM` apart are equal."""
    order = np.argsort(positions, axis=0)
    steps = np.diff(np.take_along_axis(positions, order, axis=0), axis=0, prepend=positions.min(axis=0)[None])
    ranks = np.empty(positions.shape, int)
    np.put_along_axis(ranks, order, np.cumsum(steps > _NOISE_MM, axis=0), axis=0)
    out: list[list[int]] = ranks[:, ::-1].tolist()
    return out


def _form_two_clusters(values: Floats) -> bool:
    """Return whether numbers form two clusters with a gap, so that sides distinguish them; a row of holes does not."""
    ordered = np.sort(values)
    gaps = np.diff(ordered)
    return bool(gaps.max() > _GAP * (ordered[-1] - ordered[0]))
