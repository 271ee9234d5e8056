"""glTF 2.0, as one GLB file or as JSON with its buffers in it: the triangles of its scene, placed by its nodes.

Sizes and indices are checked in three steps before any array is made: chunks against the file, buffer views against
buffers, accessors against views. Only geometry is read; materials, images, cameras and lights are never opened.
Source: Khronos glTF 2.0 specification, sections 3.5 (nodes), 3.6 (binary data), 3.7 (meshes), 4.4 (GLB).
"""

from __future__ import annotations

import base64
import json
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.guard import MAX_TRIANGLES
from puncture_twin.planning.formats.meshes.gltf_document import Accessor, Document, Primitive
from puncture_twin.planning.formats.meshes.gltf_scene import PlacedPrimitive, placed_meshes
from puncture_twin.planning.formats.raw_mesh import RawMesh, join, refuse
from puncture_twin.planning.geometry.rigid import apply

_GLB_ALLOWED = "glTF, version 2: its length, then a JSON chunk and at most one BIN chunk, as long as they say"
_JSON_CHUNK, _BIN_CHUNK = b"JSON", b"BIN\0"
_FLOAT = 5126
_INDEX_TYPES: dict[int, np.dtype[Any]] = {5121: np.dtype("<u1"), 5123: np.dtype("<u2"), 5125: np.dtype("<u4")}
_TRIANGLES = 4


class _Glb(NamedTuple):
    text: bytes
    binary: bytes | None


def read_glb(data: bytes, where: str) -> RawMesh:
    """The triangles of a GLB file's scene, in the unit of the file and its axes (y up by the standard).

    Args:
        data: The whole file.
        where: Its name, for the error.

    Raises:
        InputError: If it is cut, contradicts itself, or uses what is not supported.
    """
    glb = _split_glb(data, where)
    document = _parse(glb.text, where)
    buffers = []
    for index, stated in enumerate(document.buffers):
        if index == 0 and stated.uri is None:
            buffers.append(glb.binary or b"")
        else:
            buffers.append(_buffer(stated.uri, f"{where}, buffer {index}"))
    return _read_document(document, buffers, where)


def read_gltf(data: bytes, where: str) -> RawMesh:
    """The triangles of a glTF file's scene; its buffers stand in it as base64 data.

    Args:
        data: The whole JSON file.
        where: Its name, for the error.

    Raises:
        InputError: If it is cut, contradicts itself, or uses what is not supported.
    """
    document = _parse(data, where)
    buffers = [_buffer(stated.uri, f"{where}, buffer {index}") for index, stated in enumerate(document.buffers)]
    return _read_document(document, buffers, where)


def _split_glb(data: bytes, where: str) -> _Glb:
    if len(data) < 20 or data[:4] != b"glTF" or int.from_bytes(data[4:8], "little") != 2:
        refuse(f"not a GLB file of version 2 ({len(data)} bytes, {data[:4]!r})", where, _GLB_ALLOWED)
    stated = int.from_bytes(data[8:12], "little")
    if stated != len(data):
        refuse(f"header states {stated} bytes, but the file has {len(data)}", where, _GLB_ALLOWED)
    chunks = []
    position = 12
    while position < len(data):
        length, kind = int.from_bytes(data[position : position + 4], "little"), data[position + 4 : position + 8]
        end = position + 8 + length
        if end > len(data):
            refuse(f"chunk {kind!r} states {length} bytes, beyond the file's end", where, _GLB_ALLOWED)
        chunks.append((kind, data[position + 8 : end]))
        position = end
    binaries = [body for kind, body in chunks if kind == _BIN_CHUNK]
    if chunks[0][0] != _JSON_CHUNK or len(binaries) > 1:
        refuse(f"chunks {[kind for kind, _ in chunks]}", where, _GLB_ALLOWED)
    return _Glb(chunks[0][1], binaries[0] if binaries else None)


def _parse(text: bytes, where: str) -> Document:
    allowed = "a glTF 2.0 document in JSON"
    try:
        tree: Any = json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, numbers or nesting without end
        raise InputError(f"JSON cannot be read ({error})", where=where, allowed=allowed) from error
    try:
        document = Document.model_validate(tree)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ascii(".".join(str(step) for step in first["loc"]))
        raise InputError(f"{place}: {first['msg']}", where=where, allowed=allowed) from error
    document.check_supported(where)
    return document


def _buffer(uri: str | None, where: str) -> bytes:
    if uri is None or not uri.startswith("data:"):
        allowed = "one whole file: a GLB, or base64 data in the .gltf"
        refuse(f"the buffer lies in another file ({str(uri)[:60]!r})", where, allowed)
    try:
        return base64.b64decode(uri.partition(";base64,")[2], validate=True)
    except ValueError as error:  # damaged, or not ASCII
        raise InputError(f"base64 data is damaged ({error})", where=where, allowed="base64 data") from error


def _read_document(document: Document, buffers: list[bytes], where: str) -> RawMesh:
    _check_sizes(document, buffers, where)
    placed = placed_meshes(document, sum(len(buffer) for buffer in buffers), where)
    parts = [_part(document, buffers, each, where) for each in placed]
    return join([part for group in parts for part in group])


def _check_sizes(document: Document, buffers: list[bytes], where: str) -> None:
    for index, (stated, found) in enumerate(zip(document.buffers, buffers, strict=True)):
        if not stated.byte_length <= len(found):
            what = f"buffer {index} states {stated.byte_length} bytes, {len(found)} are there"
            refuse(what, where, "buffers as long as they say")
    for index, view in enumerate(document.buffer_views):
        end = view.byte_offset + view.byte_length
        if view.buffer >= len(buffers) or end > document.buffers[view.buffer].byte_length:
            what = f"bufferView {index} ends at byte {end} of buffer {view.buffer}, which does not reach there"
            refuse(what, where, "views inside their buffer")


def _part(document: Document, buffers: list[bytes], placed: PlacedPrimitive, where: str) -> list[RawMesh]:
    T = placed.T_scene_mesh
    mirrored = np.linalg.det(T[:3, :3]) < 0.0  # section 3.7.4: then the winding turns
    parts = []
    for number, primitive in enumerate(document.meshes[placed.mesh].primitives):
        raw = _primitive(document, buffers, primitive, f"{where}, mesh {placed.mesh}, primitive {number}")
        vertices = apply(T, raw.vertices)
        parts.append(RawMesh(vertices, raw.faces[:, ::-1] if mirrored else raw.faces))
    return parts


def _primitive(document: Document, buffers: list[bytes], primitive: Primitive, where: str) -> RawMesh:
    if primitive.mode != _TRIANGLES:
        refuse(f"primitive mode {primitive.mode}", where, f"{_TRIANGLES} (separate triangles)")
    position = primitive.attributes.get("POSITION")
    if position is None or primitive.targets:
        refuse("no POSITION, or morph targets", where, "a rigid mesh with POSITION")
    accessor = _accessor(document, position, where)
    if (accessor.component_type, accessor.type) != (_FLOAT, "VEC3"):
        refuse(f"POSITION of type {accessor.component_type} {accessor.type}", where, f"{_FLOAT} VEC3")
    vertices = _array(document, buffers, position, np.dtype("<f4"), 3, where).astype(np.float64)
    if primitive.indices is None:
        indices = np.arange(len(vertices), dtype=np.int64)
    else:
        indices = _indices(document, buffers, primitive.indices, where)
    if len(indices) % 3 or len(indices) > 3 * MAX_TRIANGLES:
        refuse(f"{len(indices)} indices", where, f"three per triangle, at most {MAX_TRIANGLES} triangles")
    if indices.max() >= len(vertices):
        refuse(f"index {indices.max()} out of range", where, f"0 to {len(vertices) - 1}")
    return RawMesh(vertices, indices.reshape(-1, 3))


def _indices(document: Document, buffers: list[bytes], index: int, where: str) -> NDArray[np.int64]:
    accessor = _accessor(document, index, where)
    if accessor.component_type not in _INDEX_TYPES or accessor.type != "SCALAR":
        refuse(f"indices of type {accessor.component_type} {accessor.type}", where, f"SCALAR of {list(_INDEX_TYPES)}")
    dtype = _INDEX_TYPES[accessor.component_type]
    return _array(document, buffers, index, dtype, 1, where).reshape(-1).astype(np.int64)


def _accessor(document: Document, index: int, where: str) -> Accessor:
    if index >= len(document.accessors):
        refuse(f"accessor {index} of {len(document.accessors)}", where, "an accessor of the file")
    return document.accessors[index]


def _array(
    document: Document, buffers: list[bytes], index: int, dtype: np.dtype[Any], width: int, where: str
) -> NDArray[Any]:
    accessor = _accessor(document, index, where)
    if accessor.buffer_view is None or accessor.sparse is not None or accessor.normalized:
        refuse(f"accessor {index} is sparse, normalized or without data", where, "plain data in a buffer view")
    if accessor.buffer_view >= len(document.buffer_views):
        refuse(f"accessor {index} uses bufferView {accessor.buffer_view}", where, "a view of the file")
    view = document.buffer_views[accessor.buffer_view]
    row = dtype.itemsize * width
    stride = view.byte_stride or row
    needed = accessor.byte_offset + (accessor.count - 1) * stride + row
    if needed > view.byte_length or stride < row:
        what = f"accessor {index} takes {needed} bytes of a view of {view.byte_length}, {stride} per row"
        refuse(what, where, "accessors inside their view")
    start = view.byte_offset + accessor.byte_offset
    strides = (stride, dtype.itemsize)
    return np.ndarray((accessor.count, width), dtype, buffers[view.buffer], offset=start, strides=strides)
