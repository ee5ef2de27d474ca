"""PLY files of points: binary or text, with arbitrary vertex properties."""

from __future__ import annotations

import os
from typing import List, Optional, Tuple

import numpy as np
import numpy.typing as npt

from .errors import BadRun

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
# No header is longer: a file that is not a PLY is not read to its end in search of one.
MAX_HEADER_LINES = 200


def _header(lines: List[str], path: str) -> Tuple[str, int, List[Tuple[str, str]]]:
    """Format, number of vertices, and their properties."""
    form, count, properties, element = "", -1, [], ""
    for words in (line.split() for line in lines):
        if words[:1] == ["format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            element = words[1]
            if count >= 0 and element == "vertex":
                raise BadRun(f"{path}: vertices are declared twice")
            if element == "vertex":
                count = int(words[2]) if words[2].isdigit() else -1
            elif count < 0:
                raise BadRun(f"{path}: {element} precedes the vertices")
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES:
                raise BadRun(f"{path}: the property `{' '.join(words[1:])}` of a vertex is not a number")
            properties.append((words[2], _TYPES[words[1]]))
    if count < 0 or not {"x", "y", "z"} <= {name for name, _ in properties}:
        raise BadRun(f"{path}: no vertices with x, y and z")
    return form, count, properties


def read_ply(path: str) -> Optional[npt.NDArray[np.void]]:
    """The vertices as a structured array, memory-mapped if the layout permits; None without a file."""
    try:
        file = open(path, "rb")  # noqa: SIM115
    except FileNotFoundError:
        return None
    with file:
        lines = []
        for _ in range(MAX_HEADER_LINES):
            lines.append(file.readline(1000).decode("ascii", "replace").strip())
            if lines[-1] == "end_header" or (len(lines) == 1 and lines[0] != "ply"):
                break
        if lines[0] != "ply" or lines[-1] != "end_header":
            raise BadRun(f"{path}: not a PLY file")
        form, count, properties = _header(lines, path)
        begin = file.tell()
        orders = {"binary_little_endian": "<", "binary_big_endian": ">"}
        if form == "ascii":
            return _text(path, count, properties, begin)
        if form not in orders:
            raise BadRun(f"{path}: unknown format `{form}`")
        try:
            kind = np.dtype([(name, orders[form] + letter) for name, letter in properties])
        except ValueError as error:
            raise BadRun(f"{path}: {error}") from None
        if os.fstat(file.fileno()).st_size - begin < count * kind.itemsize:
            raise BadRun(f"{path}: truncated: the header announces {count} points of {kind.itemsize} bytes")
        if count == 0:
            return np.empty(0, dtype=kind)
        return np.memmap(path, dtype=kind, mode="r", offset=begin, shape=(count,))


def _text(path: str, count: int, properties: List[Tuple[str, str]], begin: int) -> npt.NDArray[np.void]:
    points = np.empty(count, dtype=properties)
    with open(path, encoding="ascii", errors="replace") as file:
        file.seek(begin)
        for index in range(count):
            words = file.readline().split()
            try:
                points[index] = tuple(float(word) for word in words[: len(properties)])
            except (ValueError, TypeError):
                raise BadRun(f"{path}: point {index + 1} of {count} cannot be read") from None
    return points
