"""What a GLB file says: its chunks, and the part of its document that holds geometry, validated and of sound sizes.

Source: Khronos glTF 2.0 specification, sections 3.6 (binary data), 4.4 (GLB) and 5 (properties).
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.alias_generators import to_camel

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.strict_json import parse_json
from puncture_twin.planning.formats.raw_mesh import refuse

_GLB_ALLOWED = "glTF, version 2: its length, then a JSON chunk and at most one BIN chunk, as long as they say"
_DOCUMENT_ALLOWED = "a glTF 2.0 document in JSON"
_JSON_CHUNK, _BIN_CHUNK = b"JSON", b"BIN\0"
TRIANGLES = 4
"""Mode of a primitive: separate triangles."""

_HARMLESS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_")
"""Required extensions with these beginnings change colours only, not the surface."""
_INSTANCING = "EXT_mesh_gpu_instancing"

MAX_NODES = 10_000
"""Nodes, accessors or views of a file; a scene of anatomy has some hundred, and each one costs its own time."""

Index = Annotated[int, Field(ge=0, le=2**53)]
Number = Annotated[float, Field(allow_inf_nan=False)]


class _Properties(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, alias_generator=to_camel, extra="ignore")


class Asset(_Properties):
    """The version of the standard."""

    version: str


class Buffer(_Properties):
    """A run of bytes: the BIN chunk."""

    byte_length: Index
    uri: str | None = None


class BufferView(_Properties):
    """A part of the buffer."""

    buffer: Index
    byte_length: Index
    byte_offset: Index = 0
    byte_stride: Annotated[int, Field(ge=4, le=252)] | None = None


class Accessor(_Properties):
    """Numbers of one type in a buffer view."""

    component_type: int
    count: Annotated[int, Field(ge=1, le=2**40)]
    type: str
    buffer_view: Index | None = None
    byte_offset: Index = 0
    normalized: bool = False
    sparse: dict[str, Any] | None = None


class Primitive(_Properties):
    """A part of a mesh with one material."""

    attributes: dict[str, Index]
    indices: Index | None = None
    mode: int = TRIANGLES
    targets: list[dict[str, Any]] | None = None


class Mesh(_Properties):
    """Primitives that are placed together."""

    primitives: Annotated[list[Primitive], Field(min_length=1)]


class Node(_Properties):
    """A place in the scene: a mesh, children, and the transform to its parent."""

    children: list[Index] = []
    mesh: Index | None = None
    skin: Index | None = None
    matrix: Annotated[list[Number], Field(min_length=16, max_length=16)] | None = None
    translation: Annotated[list[Number], Field(min_length=3, max_length=3)] = [0.0, 0.0, 0.0]
    rotation: Annotated[list[Number], Field(min_length=4, max_length=4)] = [0.0, 0.0, 0.0, 1.0]
    scale: Annotated[list[Number], Field(min_length=3, max_length=3)] = [1.0, 1.0, 1.0]
    extensions: dict[str, Any] = {}


class Scene(_Properties):
    """The nodes at the top."""

    nodes: Annotated[list[Index], Field(max_length=MAX_NODES)] = []


class Document(_Properties):
    """The part of a document that holds geometry, validated; everything else in it is left aside."""

    asset: Asset
    scene: Index | None = None
    scenes: list[Scene] = []
    nodes: Annotated[list[Node], Field(max_length=MAX_NODES)] = []
    meshes: list[Mesh] = []
    accessors: Annotated[list[Accessor], Field(max_length=MAX_NODES)] = []
    buffer_views: Annotated[list[BufferView], Field(max_length=MAX_NODES)] = []
    buffers: Annotated[list[Buffer], Field(max_length=1)] = []
    extensions_required: list[str] = []


class GlbFile(NamedTuple):
    """A checked document, and the bytes of its one buffer."""

    document: Document
    binary: bytes


def read_document(data: bytes, where: str) -> GlbFile:
    """What a GLB file holds, with chunks, buffer and views that reach as far as they say.

    Raises:
        InputError: If it is cut, contradicts itself, or uses what would change the surface and is not supported.
    """
    written, binary = _chunks(data, where)
    document = _parse(written, where)
    _check_supported(document, where)
    _check_sizes(document, len(binary), where)
    return GlbFile(document, binary)


def _chunks(data: bytes, where: str) -> tuple[bytes, bytes]:
    """The JSON chunk and the BIN chunk, which may be empty."""
    if len(data) < 20 or data[:4] != b"glTF" or int.from_bytes(data[4:8], "little") != 2:
        refuse(f"not a GLB file of version 2 ({len(data)} bytes, {data[:4]!r})", where, _GLB_ALLOWED)
    stated = int.from_bytes(data[8:12], "little")
    if stated != len(data):
        refuse(f"header states {stated} bytes, but the file has {len(data)}", where, _GLB_ALLOWED)
    chunks, position = [], 12
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
    return chunks[0][1], binaries[0] if binaries else b""


def _parse(text: bytes, where: str) -> Document:
    tree = parse_json(text, where=where, allowed=_DOCUMENT_ALLOWED)
    try:
        return Document.model_validate(tree)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ascii(".".join(str(step) for step in first["loc"]))
        raise InputError(f"{place}: {first['msg']}", where=where, allowed=_DOCUMENT_ALLOWED) from error


def _check_supported(document: Document, where: str) -> None:
    """Refuse what would change the surface in a way that this reader does not know."""
    if not document.asset.version.startswith("2."):
        refuse(f"glTF version {document.asset.version[:20]!r}", where, "version 2")
    for name in document.extensions_required:
        if not name.startswith(_HARMLESS):
            refuse(f"needs the extension {name[:60]!r}", where, "glTF without compression or other extensions")
    for index, node in enumerate(document.nodes):
        if node.skin is not None or _INSTANCING in node.extensions:
            refuse(f"node {index} is bent by a skin or instanced", where, "rigid meshes, one per node")


def _check_sizes(document: Document, size: int, where: str) -> None:
    """Hold the buffer against the BIN chunk, and the views against the buffer."""
    for buffer in document.buffers:
        if buffer.uri is not None:
            refuse(f"the buffer lies outside of the BIN chunk ({buffer.uri[:60]!r})", where, "one whole GLB file")
        if buffer.byte_length > size:
            what = f"buffer 0 states {buffer.byte_length} bytes, {size} are there"
            refuse(what, where, "a buffer as long as it says")
    for index, view in enumerate(document.buffer_views):
        end = view.byte_offset + view.byte_length
        if view.buffer >= len(document.buffers) or end > document.buffers[view.buffer].byte_length:
            what = f"bufferView {index} ends at byte {end} of buffer {view.buffer}, which does not reach there"
            refuse(what, where, "views inside their buffer")
