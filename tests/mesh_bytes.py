"""The bytes of mesh files: GLB of a document, VTK's XML of polygons in every encoding that it has."""

import base64
import json
import struct
import zlib
from typing import Any

import numpy as np


def glb(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


TRIANGLE = np.array([[0, 0, 0], [10, 0, 0], [0, 20, 0]], dtype="<f4")


def gltf_document(**changes: Any) -> dict[str, Any]:
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [1, 2, 3]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6}],
        "buffers": [{"byteLength": 42}],
    }
    return document | changes


GLTF_BINARY = TRIANGLE.tobytes() + np.array([0, 1, 2], dtype="<u2").tobytes()


def vtk_binary(array: np.ndarray, compressed: bool, header: str = "<u4") -> list[bytes]:
    raw = array.tobytes()
    if not compressed:
        return [np.array([len(raw)], header).tobytes() + raw]
    block = 64
    blocks = [raw[i : i + block] for i in range(0, len(raw), block)]
    packed = [zlib.compress(each) for each in blocks]
    sizes = [len(blocks), block, len(raw) % block, *(len(each) for each in packed)]
    return [np.array(sizes, header).tobytes(), b"".join(packed)]


def vtp(
    points: np.ndarray,
    polygons: list[list[int]],
    form: str = "ascii",
    *,
    compressed: bool = False,
    header: str = "UInt32",
    pieces: int = 1,
    **changes: str,
) -> bytes:
    connectivity = np.array([i for polygon in polygons for i in polygon], dtype="<i8")
    offsets = np.cumsum([len(polygon) for polygon in polygons]).astype("<i8")
    appended = b""

    def array(name: str, kind: str, values: np.ndarray, extra: str = "") -> str:
        nonlocal appended
        head = f'<DataArray type="{kind}" Name="{name}" {extra}'
        if form == "ascii":
            return f'{head} format="ascii">{" ".join(map(str, values.reshape(-1).tolist()))}</DataArray>'
        parts = vtk_binary(values, compressed, {"UInt32": "<u4", "UInt64": "<u8"}[header])
        if form == "binary":
            return f'{head} format="binary">\n{b"".join(map(base64.b64encode, parts)).decode()}\n</DataArray>'
        offset = len(appended)
        appended += b"".join(map(base64.b64encode, parts)) if form == "base64" else b"".join(parts)
        return f'{head} format="appended" offset="{offset}"/>'

    piece = f"""<Piece NumberOfPoints="{changes.get("n_points", str(len(points)))}"
NumberOfStrips="{changes.get("n_strips", "0")}" NumberOfPolys="{changes.get("n_polys", str(len(polygons)))}">
<PointData>{array("scalar", "Float64", points[:, 0])}</PointData>
<Points>{array("Points", "Float64", points.astype("<f8"), 'NumberOfComponents="3"')}</Points>
<Polys>{array("connectivity", "Int64", connectivity)}{array("offsets", "Int64", offsets)}</Polys></Piece>"""
    compressor = 'compressor="vtkZLibDataCompressor"' if compressed else ""
    text = f"""<?xml version="1.0"?>\n<!-- a comment -->
<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="{header}" {compressor}>
<PolyData>{piece * pieces}</PolyData>"""
    if not appended:
        return text.encode() + b"</VTKFile>\n"
    kind = "raw" if form == "raw" else "base64"
    section = f'<AppendedData encoding="{kind}">\n _'.encode() + appended + b"\n</AppendedData>"
    return text.encode() + section + b"</VTKFile>\n"
