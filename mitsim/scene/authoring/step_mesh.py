"""Mesh faces with OpenCASCADE, as finely as asked, and report the progress on stdout.

Signal chain: faces -> coarse meshes, which count triangles and show how well a radius can be fitted -> chord of each
face within the number of triangles -> meshes, finest first, that share their points on edges -> vertices, normals and
triangles of each face.

It imports no other module of ``mitsim``, as :mod:`mitsim.scene.authoring.step_worker`, whose process runs it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

#: begin of a line of progress
TOLD = "mitsim meshed "

#: begin of the line with the part's diagonal [mm], before that mesh is made
SPANS = "mitsim spans "

#: kinds of surfaces that a task can measure
MEASURED = ("plane", "cylinder", "cone", "sphere")

#: triangles that are made between two lines of progress
_STEP = 50_000

#: factor by which the mesh that counts triangles is coarser; chosen
_COARSER = 16.0

#: diagonal of a part [mm] beyond which no sensor sees it, and its unit is probably wrong: its chord grows with it
LARGE_MM = 1e4

#: least chord of such a part as a share of its diagonal: a fifth of that of a part of 100 mm at the default; chosen
LARGE_SHARE = 1e-5

#: chord of the first mesh as a share of the part's diagonal; chosen
_FIRST = 1e-3

#: largest angle between its facets [rad]: only the chord limits them; chosen
_FLAT = 1.0


def mesh_together(faces: list[Any], chord: float, bend: float, delabella: bool = True) -> None:
    """Mesh faces; those among them that have a mesh as fine keep it, and their neighbours take its points on an edge.

    - ``faces``, ``chord``, ``bend``: to be meshed; largest distance from the surface [mm], and angle between facets
      [rad].
    - ``delabella``: which of OpenCASCADE's two ways connects the same points. Delabella takes a seventeenth of the time
      for 146,000 triangles of a torus.
    """
    from OCP.BRep import BRep_Builder
    from OCP.BRepMesh import BRepMesh_IncrementalMesh
    from OCP.IMeshTools import IMeshTools_MeshAlgoType, IMeshTools_Parameters
    from OCP.TopoDS import TopoDS_Compound

    asked = IMeshTools_Parameters()
    asked.Deflection, asked.Angle, asked.InParallel, asked.Relative = chord, bend, True, False
    if delabella:
        asked.MeshAlgo = IMeshTools_MeshAlgoType.IMeshTools_MeshAlgoType_Delabella
    together, builder = TopoDS_Compound(), BRep_Builder()
    builder.MakeCompound(together)
    for face in faces:
        builder.Add(together, face)
    BRepMesh_IncrementalMesh(together, asked)


def triangle_count(face: Any) -> int:
    """Return the number of triangles of a face's mesh."""
    from OCP.BRep import BRep_Tool
    from OCP.TopLoc import TopLoc_Location

    made = BRep_Tool.Triangulation_s(face, TopLoc_Location())
    return 0 if made is None else int(made.NbTriangles())


def radius_uncertainty(normals: np.ndarray, areas: np.ndarray) -> float:
    """Return the standard uncertainty of a fitted radius, for one point of noise 1 per unit of area.

    ``normals`` (m, 3) are the unit normals of the facets, ``areas`` (m,) their areas. The points of a sphere or
    cylinder depend on its radius by 1, and on its centre by their normal n. With their means <.> over the area A the
    least squares leave the variance of the radius 1 / (A (1 - <n> <n n^T>^-1 <n>)).
    """
    share = areas / areas.sum()
    mean, product = share @ normals, (normals * share[:, None]).T @ normals
    left = 1.0 - mean @ np.linalg.pinv(product, rcond=1e-9) @ mean
    return float(1 / np.sqrt(areas.sum() * max(left, 1e-9)))


def fitted_chords(faces: list[Any], kinds: list[str], chord: float, largest_chord: float, fitted: float) -> np.ndarray:
    """Return the chord (n,) of each meshed face: ``chord``, or more where a radius is fitted with a larger uncertainty.

    Chords differ in steps of a factor sqrt(2), since faces of one chord are meshed together.

    ``faces``, ``kinds``: meshed faces, and the kinds of their surfaces. ``chord``, ``largest_chord``, ``fitted``: least
    and largest chord; chord of a face whose radius has the standard uncertainty 1, as for :func:`mesh`.
    """
    out = np.full(len(faces), chord)
    for number, (face, kind) in enumerate(zip(faces, kinds, strict=True)):
        made = triangles_of(face) if kind in ("sphere", "cylinder") else None
        if made is None:
            continue
        a, b, c = np.moveaxis(made[0][made[2]], 1, 0)
        across = np.cross(b - a, c - a)
        length = np.linalg.norm(across, axis=1)
        facets = length > 0
        if facets.any():
            normals = across[facets] / length[facets, None]
            wanted = np.clip(fitted * radius_uncertainty(normals, length[facets] / 2), chord, largest_chord)
            out[number] = chord * 2.0 ** (np.floor(2 * np.log2(wanted / chord)) / 2)
    return out


def chords(
    kinds: list[str], counts: np.ndarray, coarse: float, chord: float | np.ndarray, other_chord: float, most: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the chord (n,) of each face, and about how many triangles (n,) it will have.

    The number is inversely proportional to the chord, and to its square root for planes and cylinders, whose triangles
    are long. If all faces would have over ``most``, the chords of the faces with the most triangles are doubled: of
    measured faces up to ``other_chord``, then of all.

    ``kinds``, ``counts``, ``coarse``: kinds (n,) of the surfaces, and their triangles (n,) at the chord ``coarse``.
    ``chord``, ``other_chord``, ``most``: of faces that a task can measure, one or for each face, and of other faces;
    triangles of all faces.
    """
    measured = np.array([kind in MEASURED for kind in kinds])
    out = np.where(measured, chord, other_chord)
    while most and (now := expected(kinds, counts, coarse, out)).sum() > most:
        finer = measured & (2 * out <= other_chord)
        chosen = finer if finer.any() else now > 2
        if not chosen.any():
            break
        out[chosen & (now >= 0.5 * now[chosen].max())] *= 2
    return out, expected(kinds, counts, coarse, out)


def expected(kinds: list[str], counts: np.ndarray, coarse: float, chord: float | np.ndarray) -> np.ndarray:
    """Return about how many triangles (n,) faces have at ``chord``, from their ``counts`` at the chord ``coarse``.

    Parameters
    ----------
    kinds, counts, coarse, chord
        As for :func:`chords`.
    """
    straight = np.array([kind in ("plane", "cylinder") for kind in kinds])
    return np.maximum(counts * (coarse / chord) ** np.where(straight, 0.5, 1.0), 1.0)


def counted(shapes: list[Any], faces: list[Any], kinds: list[str], chord: float, most: int) -> tuple[np.ndarray, float]:
    """Mesh faces coarsely, and print the part's diagonal; return their triangles (n,), and the chord of that mesh.

    The first mesh is as coarse as the part is large, so that its time has a limit. It becomes finer, down to ``chord``,
    as long as that takes at most about ``most`` triangles.

    Parameters
    ----------
    shapes, faces, kinds, chord, most
        As for :func:`mesh`.
    """
    from OCP.BRepTools import BRepTools

    coarse = max(chord, _FIRST * diagonal(shapes, False))
    mesh_together(faces, coarse, _FLAT)
    print(f"{SPANS}{diagonal(shapes, True)!r}", flush=True)
    while True:
        counts = np.array([triangle_count(face) for face in faces], float)
        finer = max(chord, coarse / _COARSER)
        if finer == coarse or expected(kinds, counts, coarse, finer).sum() > most:
            return counts, coarse
        for shape in shapes:
            BRepTools.Clean_s(shape)
        coarse = finer
        mesh_together(faces, coarse, _FLAT)


def diagonal(shapes: list[Any], meshed: bool) -> float:
    """Return the diagonal of some shapes, from their meshes or from a box that may be larger."""
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib

    box = Bnd_Box()
    for shape in shapes:
        BRepBndLib.Add_s(shape, box, meshed)
    box.SetGap(0.0)  # else it adds the chord
    return 0.0 if box.IsVoid() else float(np.sqrt(box.SquareExtent()))


def mesh(  # noqa: PLR0913 - one number each
    shapes: list[Any],
    faces: list[Any],
    kinds: list[str],
    chord: float,
    bend: float,
    other_chord: float,
    most: int,
    fitted: float = 0.0,
) -> float:
    """Mesh all faces, finest first; return the chord that the limit of triangles leaves of ``chord``.

    If Delabella leaves a face without triangles, the other way meshes it again.

    Parameters
    ----------
    shapes, faces, kinds, bend
        To be meshed, all faces of them, the kinds of their surfaces, and the angle between facets [rad].
    chord, other_chord, most
        As for :func:`chords`; 0 triangles is no limit.
    fitted
        Chord [mm] of a sphere or cylinder whose radius a fit determines with the standard uncertainty 1, for one point
        of noise 1 on each mm^2; 0: all measured faces have ``chord``.
    """
    if not faces:
        return chord
    measured = np.array([kind in MEASURED for kind in kinds])
    chord_of, planned, coarsened = np.where(measured, chord, other_chord), np.ones(len(faces)), 1.0
    if most:
        from OCP.BRepTools import BRepTools

        counts, coarse = counted(shapes, faces, kinds, _COARSER * chord, most)
        wanted = fitted_chords(faces, kinds, chord, other_chord, fitted) if fitted else np.full(len(faces), chord)
        for shape in shapes:
            BRepTools.Clean_s(shape)
        chord_of, planned = chords(kinds, counts, coarse, wanted, other_chord, most)
        coarsened = float((chord_of / np.where(measured, wanted, other_chord)).max(initial=1.0))
    order = np.lexsort((planned, chord_of))
    made, told = np.cumsum(planned[order]), 0.0
    for number, here in enumerate(order):
        last = number + 1 == len(order)
        if last or chord_of[order[number + 1]] != chord_of[here] or (most and made[number] - told > _STEP):
            mesh_together([faces[index] for index in order[: number + 1]], float(chord_of[here]), bend)
            told = float(made[number])
            if most:
                print(f"{TOLD}{told:.0f} {made[-1]:.0f}", flush=True)
    lost = [number for number, face in enumerate(faces) if not triangle_count(face)]
    for here in np.unique(chord_of[lost]):
        again = [faces[number] for number in lost if chord_of[number] == here]
        mesh_together([*(face for face in faces if triangle_count(face)), *again], float(here), bend, False)
    return chord * coarsened


def triangles_of(face: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return vertices (n, 3) [mm], outward unit normals (n, 3), triangles (m, 3) counter-clockwise outside, or None."""
    from OCP.BRep import BRep_Tool
    from OCP.BRepLib import BRepLib_ToolTriangulatedShape
    from OCP.TopAbs import TopAbs_REVERSED
    from OCP.TopLoc import TopLoc_Location

    location = TopLoc_Location()
    mesh = BRep_Tool.Triangulation_s(face, location)
    if mesh is None or not mesh.NbTriangles():
        return None
    if BRep_Tool.Surface_s(face) is None:
        mesh.ComputeNormals()
    else:
        BRepLib_ToolTriangulatedShape.ComputeNormals_s(face, mesh)
    nodes = range(1, mesh.NbNodes() + 1)
    points = np.array([(p.X(), p.Y(), p.Z()) for p in map(mesh.Node, nodes)])
    normals = np.array([(n.X(), n.Y(), n.Z()) for n in map(mesh.Normal, nodes)])
    corners = np.array([mesh.Triangle(i).Get() for i in range(1, mesh.NbTriangles() + 1)]).reshape(-1, 3) - 1
    motion = location.Transformation()
    matrix = np.array([[motion.Value(r, c) for c in range(1, 5)] for r in range(1, 4)])
    points, normals = points @ matrix[:, :3].T + matrix[:, 3], normals @ matrix[:, :3].T
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    mirrored = np.linalg.det(matrix[:, :3]) < 0
    backward = face.Orientation() == TopAbs_REVERSED
    if backward != mirrored:
        corners = corners[:, ::-1]
    # some versions of OpenCASCADE reverse the normals of a reversed face: use the triangles' orientation
    a, b, c = np.moveaxis(points[corners], 1, 0)
    facing = np.einsum("ij,ij->i", np.cross(b - a, c - a), normals[corners].sum(axis=1)).sum()
    return points, normals if facing >= 0 else -normals, corners
