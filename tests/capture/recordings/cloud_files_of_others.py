"""PLY and PCD files as other programs write them, and the clouds to put into them."""

from __future__ import annotations

import numpy as np


def pinhole_cloud(width: int = 64, height: int = 48, f: float = 60.0) -> np.ndarray:
    """Points (H, W, 3) [mm] of a wavy surface about 700 mm from a pinhole, with holes, x right, y down, z forward."""
    rows, columns = np.mgrid[:height, :width].astype(float)
    z = 700 + 30 * np.sin(columns / 9) + 20 * np.cos(rows / 7)
    points = np.stack([(columns - 31.3) / f * z, (rows - 22.8) / (f + 1) * z, z], axis=-1).astype(np.float32)
    points[10:14, 20:30] = np.nan
    points[0, :5] = np.nan
    return points


def pcd(points: np.ndarray, kind: str, extra: bool = False, height: int | None = None) -> bytes:
    """A PCD file (H, W, 3); ``extra``: colours and a subarray around the coordinates."""
    rows, columns = points.shape[:2] if height is None else (height, points.size // 3 // height)
    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if extra:
        fields = [("rgb", "<u4"), ("x", "<f4"), ("normal", "<f4", (3,)), ("y", "<f4"), ("_", "u1", (4,)), ("z", "<f8")]
    table = np.zeros(rows * columns, fields)
    for axis, values in zip("xyz", points.reshape(-1, 3).T, strict=True):
        table[axis] = values
    kinds = {"f": "F", "u": "U"}
    types = [table.dtype[name] for name in table.dtype.names]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(table.dtype.names),
        "SIZE " + " ".join(str(each.base.itemsize) for each in types),
        "TYPE " + " ".join(kinds[each.base.kind] for each in types),
        "COUNT " + " ".join(str(int(np.prod(each.shape))) for each in types),
        f"WIDTH {columns}",
        f"HEIGHT {rows}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {rows * columns}",
        f"DATA {kind}",
        "",
    ]
    if kind == "ascii":
        numbers = ([f"{v!r}" for name in table.dtype.names for v in np.ravel(row[name]).tolist()] for row in table)
        body = "".join(" ".join(row) + "\n" for row in numbers).encode()
    elif kind == "binary":
        body = table.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in table.dtype.names)
        packed = lzf(plain)
        body = np.array([len(packed), len(plain)], "<u4").tobytes() + packed
    return "\n".join(lines).encode() + body


def lzf(data: bytes) -> bytes:
    """Compress as LibLZF does, with a table of the last places of three bytes; slow and plain."""
    out, literal, last, at = bytearray(), bytearray(), {}, 0

    def flush():
        for first in range(0, len(literal), 32):
            part = literal[first : first + 32]
            out.append(len(part) - 1)
            out.extend(part)
        literal.clear()

    while at < len(data):
        key, before = data[at : at + 3], last.get(data[at : at + 3])
        last[key] = at
        if before is not None and len(key) == 3 and at - before <= 8192:
            length = 3
            while length < 264 and at + length < len(data) and data[before + length] == data[at + length]:
                length += 1
            flush()
            distance, count = at - before - 1, length - 2
            out.append((min(count, 7) << 5) | (distance >> 8))
            if count >= 7:
                out.append(count - 7)
            out.append(distance & 255)
            at += length
        else:
            literal.append(data[at])
            at += 1
    flush()
    return bytes(out)


def ply(points: np.ndarray, order: str = "binary_little_endian", grid: str = "obj_info", before: bool = False) -> bytes:
    """A PLY file (H, W, 3), its grid told by ``obj_info``, ``camera``, ``range_grid`` or ``none``."""
    height, width = points.shape[:2]
    flat = points.reshape(-1, 3)
    held = np.isfinite(flat).all(axis=1) if grid == "range_grid" else np.ones(len(flat), bool)
    mark = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[order]
    lines = ["ply", f"format {order} 1.0", "comment by a test"]
    if grid in ("obj_info", "range_grid"):
        lines += [f"obj_info num_cols {width}", f"obj_info num_rows {height}"]
    camera = ["element camera 1", "property int viewportx", "property int viewporty"]
    vertices = np.zeros(int(held.sum()), [("x", mark + "f4"), ("y", mark + "f4"), ("z", mark + "f4"), ("red", "u1")])
    for axis, values in zip("xyz", flat[held].T, strict=True):
        vertices[axis] = values
    body = b"" if mark else ""
    views = np.array([(width, height)], [("x", mark + "i4"), ("y", mark + "i4")])

    def written(table):
        if mark:
            return table.tobytes()
        return "".join(" ".join(repr(v) for v in row.tolist()) + "\n" for row in table)

    if grid == "camera" and before:
        lines += camera
        body += written(views)
    lines += [
        f"element vertex {len(vertices)}",
        "property float x",
        "property float y",
        "property float z",
        "property uchar red",
    ]
    body += written(vertices)
    if grid == "camera" and not before:
        lines += camera
        body += written(views)
    if grid == "range_grid":
        lines += [f"element range_grid {len(flat)}", "property list uchar int vertex_indices"]
        number = 0
        for here in held:
            if mark:
                body += bytes([int(here)]) + (np.array([number], mark + "i4").tobytes() if here else b"")
            else:
                body += f"1 {number}\n" if here else "0\n"
            number += here
    head = "\n".join([*lines, "end_header", ""]).encode()
    return head + (body if mark else body.encode())
