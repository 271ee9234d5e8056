"""Mutators that know the structure of a file: records, counts, numbers, indices, trees; and plain bytes."""

import gzip
import json
import re
import struct
import zlib

import numpy as np

NUMBERS = [
    *["nan", "inf", "-inf", "1e400", "-1e400", "1e30", "-1e30", "1e-320", "1e308", "0", "-0", "1", "-1", "2", "3", "7"],
    *["0.5", "1e5", "100001", "255", "256", "65535", "65536", "2147483647", "2147483648", "-2147483649", "4294967295"],
    *["4294967296", "9223372036854775808", "0x10", "1_0", "1,5", "+5", ".5", "5.", "5e", "1e", "1d3", "\u0663"],
    *["\u00b2", "-", ".", "e", "9" * 30, "1" * 400, "", " ", '"', "'"],
]
"""What a number becomes."""

WORDS = [
    *["", "\0", "\u202e", "\x1b[31m", "x" * 300, "../a", "/etc/passwd", "a b", "true", "null", "{", "[", "#", ",,,"],
    *["\r", "\n"],
]
"""What a word becomes."""

VALUES = [
    *[None, True, False, 0, -1, 1, 2, 10**30, -(2**63), 1e308, float("nan"), float("inf"), -1.5, "", "x", "1", "\0"],
    *[[], {}, [[]], [1, 2], {"a": 1}, "x" * 300, "LPS", "RAS"],
]
"""What a node of a tree becomes."""

_NUMBER = re.compile(rb"[-+]?[0-9][0-9.]*(?:[eE][-+]?[0-9]+)?")
_WORD = re.compile(rb"[A-Za-z_]{2,}")


def pick(rng, items):
    return items[int(rng.integers(len(items)))]


def mutated(rng, data, kind, others):
    """Some changes to a file's bytes, of a kind of ``KINDS``; other files are there to splice with."""
    for _ in range(int(rng.choice([1, 1, 1, 2, 3, 6]))):
        data = pick(rng, KINDS[kind])(rng, data, others)
    return data


def flip(rng, data, others):
    if not data:
        return data
    out = bytearray(data)
    start = int(rng.integers(len(out)))
    for step in range(int(rng.integers(1, 5))):
        place = (start + step) % len(out) if rng.random() < 0.5 else int(rng.integers(len(out)))
        out[place] = int(rng.integers(256)) if rng.random() < 0.7 else pick(rng, [0, 255, 10, 13, 32, 44, 48])
    return bytes(out)


def truncate(rng, data, others):
    keep = int(rng.integers(len(data) + 1)) if rng.random() < 0.6 else max(len(data) - int(rng.integers(1, 9)), 0)
    return data[:keep]


def remove(rng, data, others):
    start = int(rng.integers(len(data) + 1))
    return data[:start] + data[start + int(rng.integers(1, 60)) :]


def insert(rng, data, others):
    start = int(rng.integers(len(data) + 1))
    end = start + int(rng.integers(1, 100))
    return data[:start] + (rng.bytes((end - start) // 5 + 1) if rng.random() < 0.5 else data[start:end]) + data[start:]


def splice(rng, data, others):
    other = pick(rng, others)
    share = rng.random() if rng.random() < 0.7 else 1.0
    return data[: int(len(data) * share)] + other[int(len(other) * rng.random()) :]


def change_number(rng, data, others):
    found = list(_NUMBER.finditer(data[:200_000]))
    if not found:
        return data
    place = pick(rng, found[:12] if rng.random() < 0.4 else found)
    text = pick(rng, NUMBERS).encode()
    if rng.random() < 0.4 and place.group().isdigit():
        text = str(int(place.group()) + int(rng.choice([-1, 1, 10, -10]))).encode()
    return data[: place.start()] + text + data[place.end() :]


def change_word(rng, data, others):
    found = list(_WORD.finditer(data[:200_000]))
    if not found:
        return data
    place = pick(rng, found)
    text = pick(rng, WORDS).encode() if rng.random() < 0.6 else pick(rng, found).group()
    return data[: place.start()] + text + data[place.end() :]


def change_lines(rng, data, others):
    lines = data.split(b"\n")
    i, j = (int(rng.integers(len(lines))) for _ in range(2))
    how = int(rng.integers(6))
    if how == 0:
        del lines[i]
    elif how == 1:
        lines.insert(j, lines[i])
    elif how == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif how == 3:
        del lines[min(i, j) : max(i, j)]
    elif how == 4:
        lines[i:i] = [lines[i]] * int(rng.integers(2, 60))
    else:
        lines[i] = lines[i][: int(rng.integers(len(lines[i]) + 1))]
    return pick(rng, [b"\n", b"\n", b"\n", b"\r\n", b"\r"]).join(lines)


def change_cells(rng, data, others):
    lines = data.split(b"\n")
    row = int(rng.integers(len(lines)))
    cells = lines[row].split(b",")
    i, j = (int(rng.integers(len(cells))) for _ in range(2))
    how = int(rng.integers(5))
    if how == 0:
        del cells[i]
    elif how == 1:
        cells.insert(i, cells[j])
    elif how == 2:
        cells[i], cells[j] = cells[j], cells[i]
    elif how == 3:
        cells[i] = pick(rng, [b'"' + cells[i], b'"' + cells[i] + b'"', cells[i] + b"\r", b"", b" "])
    else:
        cells[i] = pick(rng, NUMBERS).encode()
    lines[row] = b",".join(cells)
    return b"\n".join(lines)


def change_tree(rng, data, others):
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return flip(rng, data, others)
    places = list(_places(tree))
    if not places:
        return data
    parent, key = pick(rng, places[:40] if rng.random() < 0.5 else places)
    how = int(rng.integers(6))
    if how == 0:
        del parent[key]
    elif how == 1 and isinstance(parent, list):
        parent.insert(key, parent[key])
    elif how == 2:
        other, name = pick(rng, places)
        parent[key] = json.loads(json.dumps(other[name]))
    elif how == 3:
        parent[key] = [parent[key]] if rng.random() < 0.5 else {"a": parent[key]}
    elif how == 4 and isinstance(parent[key], int | float) and not isinstance(parent[key], bool):
        parent[key] = parent[key] * pick(rng, [-1, 0, 2, 1000, 1e-3]) + pick(rng, [0, 1, -1, 1e-9])
    else:
        parent[key] = pick(rng, VALUES)
    text = json.dumps(tree)
    return (text.replace("Infinity", "1e400") if rng.random() < 0.5 else text).encode()


def _places(tree):
    waiting = [tree]
    while waiting:
        node = waiting.pop(0)
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            yield node, key
            if isinstance(node[key], dict | list):
                waiting.append(node[key])


def change_glb(rng, data, others):
    if len(data) < 28 or data[:4] != b"glTF":
        return flip(rng, data, others)
    length = struct.unpack("<I", data[12:16])[0]
    text, rest = data[20 : 20 + length], data[20 + length :]
    if rng.random() < 0.75:
        text = change_tree(rng, text, others)
    else:
        rest = rest[:8] + change_floats(rng, rest[8:], others)
    text += b" " * (-len(text) % 4)
    return b"glTF" + struct.pack("<III", 2, 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest


def change_floats(rng, data, others):
    if len(data) < 8:
        return data
    place = 4 * int(rng.integers(len(data) // 4)) + int(rng.choice([0, 0, 0, 1, 2]))
    if rng.random() < 0.5:
        new = struct.pack("<f", pick(rng, [np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-40, 0.0, 1e6]))
    else:
        new = struct.pack("<I", pick(rng, [0, 1, 41, 42, 84, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1]))
    return data[:place] + new + data[place + 4 :]


def change_head(rng, data, others):
    places = [(0, "i"), (80, "i"), *[(40 + 2 * i, "h") for i in range(8)], (70, "h"), (72, "h"), (252, "h"), (254, "h")]
    places += (
        [(at, "f") for at in range(76, 120, 4)] + [(at, "f") for at in range(256, 328, 4)] + [(123, "b"), (344, "i")]
    )
    at, form = pick(rng, places)
    values = {
        "b": [0, 1, 2, 3, 8, 127, -1],
        "h": [0, 1, 2, 3, 4, 7, 16, 64, 256, 512, 10, 12, 14, 32767, -1, -32768],
        "i": [0, 1, 79, 80, 81, 160, 348, 540, 2**31 - 1, -1],
        "f": [0.0, 1.0, -1.0, 352.0, 353.0, 351.5, 1e30, np.nan, np.inf, 1e-30, 2.0, 1000.0],
    }[form]
    new = struct.pack("<" + form, pick(rng, values))
    return data[:at] + new + data[at + len(new) :] if at + len(new) <= len(data) else data


def change_text_head(rng, data, others):
    end = max(data.find(b"end_header\n"), data.find(b"\n\n")) + 2
    how = pick(rng, [change_number, change_word, change_lines])
    return how(rng, data[:end], others) + data[end:] if end > 1 else how(rng, data, others)


def inside_gzip(how):

    def change(rng, data, others):
        try:
            return gzip.compress(how(rng, gzip.decompress(data), others), 1, mtime=0)
        except (OSError, EOFError, ValueError, zlib.error):
            return flip(rng, data, others)

    return change


def change_element(rng, data, others):
    found = list(_ELEMENT.finditer(data))
    if not found:
        return flip(rng, data, others)
    place = pick(rng, found)
    at, length = place.start() + 8, struct.unpack("<H", place.group()[6:8])[0]
    how = int(rng.integers(5))
    if how == 0:
        other = int(rng.choice([0, 1, 2, 255, 65535, min(length + 2, 65534)]))
        return data[: at - 2] + struct.pack("<H", other) + data[at:]
    if how == 1:
        return data[: place.start()] + data[at + length :]
    if how == 2:
        return data[:at] + data[place.start() : at + length] + data[at:]
    if how == 3 and place.group()[4:6] == b"US" and length == 2:
        return data[:at] + struct.pack("<H", int(rng.choice([0, 1, 2, 8, 12, 16, 32, 4096, 65535]))) + data[at + 2 :]
    new = b"\\".join(pick(rng, NUMBERS).encode()[:16] for _ in range(int(rng.integers(1, 4))))[: max(length, 2)]
    return data[:at] + new.ljust(length) + data[at + length :]


_ELEMENT = re.compile(rb"[\x02-\x30][\x00\x30].[\x00-\x20](?:DS|IS|US|UI|CS|LO|SH)..", re.DOTALL)

PLAIN = [flip, truncate, remove, insert, splice]
TEXT = [*PLAIN, change_number, change_number, change_number, change_word, change_lines, change_lines]
KINDS = {
    "text": TEXT,
    "table": [*TEXT, change_cells, change_cells, change_cells],
    "tree": [*PLAIN, change_number, change_word, *[change_tree] * 6],
    "glb": [*PLAIN, *[change_glb] * 5],
    "stl": [*PLAIN, change_head, change_floats, change_floats, change_floats],
    "headed": [*PLAIN, change_floats, change_floats, *[change_text_head] * 4],
    "hdf5": [*PLAIN, flip, flip, change_floats, change_word],
    "nifti": [*PLAIN, change_floats, *[change_head] * 5],
    "dicom": [*PLAIN, *[change_element] * 8],
    "gzip": [*PLAIN, *[inside_gzip(how) for how in (flip, truncate, insert, change_floats, *[change_head] * 5)]],
}
"""Name of a kind of file to its mutators; one that stands several times is drawn more often."""
