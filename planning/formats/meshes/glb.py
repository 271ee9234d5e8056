"""GLB, which is glTF 2.0 in one file: the triangles of its scene, placed by its nodes.

Sizes and indices are checked in three steps before any array is made: chunks against the file, buffer views against the
buffer (`glb_document`), accessors against views. Only geometry is read; materials, images and lights are never opened.
Source: Khronos glTF 2.0 specification, sections 3.5 (nodes), 3.6 (binary data) and 3.7 (meshes).
"""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.alias_generators import to_camel

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse, schema_words
from puncture_twin.planning.base.strict_json import parse_json
from puncture_twin.planning.formats.guard import MAX_TRIANGLES, MAX_VERTICES, RawMesh, join

_GLB_ALLOWED = "glTF, version 2: its length, then a JSON chunk and at most one BIN chunk, of the stated lengths"
_DOCUMENT_ALLOWED = "a glTF 2.0 document in JSON"
_JSON_CHUNK, _BIN_CHUNK = b"JSON", b"BIN\0"
TRIANGLES = 4
"""Mode of a primitive of separate triangles."""
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
    """The root nodes of a scene."""

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


def _chunks(data: bytes, where: str) -> tuple[bytes, bytes]:
    """The JSON chunk and the BIN chunk, which may be empty."""
    if len(data) < 20 or data[:4] != b"glTF" or int.from_bytes(data[4:8], "little") != 2:
        refuse(f"not a GLB file of version 2 ({len(data)} bytes, {data[:4]!r})", where, _GLB_ALLOWED, "wrong_format")
    stated = int.from_bytes(data[8:12], "little")
    if stated != len(data):
        refuse(f"header states {stated} bytes, but the file has {len(data)}", where, _GLB_ALLOWED, "size_mismatch")
    chunks, position = [], 12
    while position < len(data):
        length, kind = int.from_bytes(data[position : position + 4], "little"), data[position + 4 : position + 8]
        end = position + 8 + length
        if end > len(data):
            refuse(f"chunk {kind!r} states {length} bytes, beyond the end of the file", where, _GLB_ALLOWED, "file_cut")
        chunks.append((kind, data[position + 8 : end]))
        position = end
    binaries = [body for kind, body in chunks if kind == _BIN_CHUNK]
    if chunks[0][0] != _JSON_CHUNK or len(binaries) > 1:
        refuse(f"chunks {[kind for kind, _ in chunks]}", where, _GLB_ALLOWED, "wrong_format")
    return chunks[0][1], binaries[0] if binaries else b""


def _check_sizes(document: Document, size: int, where: str) -> None:
    """Hold the buffer against the BIN chunk, and the views against the buffer."""
    for buffer in document.buffers:
        if buffer.uri is not None:
            what = f"the buffer is outside the BIN chunk ({buffer.uri[:60]!r})"
            refuse(what, where, "one whole GLB file", "data_elsewhere")
        if buffer.byte_length > size:
            what = f"buffer 0 states {buffer.byte_length} bytes, but has {size}"
            refuse(what, where, "a buffer of the stated length", "size_mismatch")
    for index, view in enumerate(document.buffer_views):
        end = view.byte_offset + view.byte_length
        if view.buffer >= len(document.buffers) or end > document.buffers[view.buffer].byte_length:
            what = f"bufferView {index} ends at byte {end} of buffer {view.buffer}, beyond its end"
            refuse(what, where, "views inside their buffer", "size_mismatch")


_TREE_ALLOWED = "nodes that form trees below one scene"
_FLOAT = 5126
_INDEX_TYPES: dict[int, np.dtype[Any]] = {5121: np.dtype("<u1"), 5123: np.dtype("<u2"), 5125: np.dtype("<u4")}
MAX_PARTS = 10_000
"""Primitives in all places: each one is built by itself."""
MAX_REPEATED_VERTICES = 3_000_000
"""Beyond what the file's own data hold: what it may place again. They take 70 MB."""
_VERTEX_BYTES, _TRIANGLE_BYTES = 12, 3
"""Least size of a vertex, and of a triangle by indices of one byte."""


def read_glb(data: bytes, where: str) -> RawMesh:
    """The triangles of a GLB file's scene, in its own unit and axes, y up by the standard (section 3.4).

    Raises InputError: it is cut, contradicts itself, or uses what is not supported.
    """
    written, binary = _chunks(data, where)
    tree = parse_json(written, where=where, allowed=_DOCUMENT_ALLOWED)
    try:
        document = Document.model_validate(tree)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        what = f"{'.'.join(map(str, first['loc']))!a}: {schema_words(first)}"
        raise InputError(what, where=where, allowed=_DOCUMENT_ALLOWED, code="bad_value") from error
    if not document.asset.version.startswith("2."):
        refuse(f"glTF version {document.asset.version[:20]!r}", where, "version 2", "unknown_version")
    for name in document.extensions_required:
        if not name.startswith(_HARMLESS):
            what = f"needs the extension {name[:60]!r}"
            refuse(what, where, "glTF without compression or other extensions", "unsupported_feature")
    for index, node in enumerate(document.nodes):
        if node.skin is not None or _INSTANCING in node.extensions:
            what = f"node {index} is bent by a skin or instanced"
            refuse(what, where, "rigid meshes, one per node", "unsupported_feature")
    _check_sizes(document, len(binary), where)
    glb = _Glb(document, binary, where)
    placed = glb.placed()
    glb.check_total([mesh for mesh, _ in placed])
    return join([part for mesh, T_scene_mesh in placed for part in glb.parts(mesh, T_scene_mesh)])


@dataclass(frozen=True)
class _Glb:
    """A checked document with the bytes of its buffer, and its name for errors."""

    document: Document
    binary: bytes
    where: str

    def placed(self) -> list[tuple[int, Floats]]:
        """Every mesh with its place T_scene_mesh, shape (4, 4), affine, in the order of the nodes."""
        T_scene_node, meshes = self._walk(), self.document.meshes
        placed = []
        for index, node in enumerate(self.document.nodes):
            if node.mesh is None:
                continue
            if node.mesh >= len(meshes):
                allowed = f"one of the {len(meshes)} meshes"
                refuse(f"node {index} uses mesh {node.mesh}", self.where, allowed, "index_out_of_range")
            if index not in T_scene_node:
                what = f"node {index} has a mesh but is not in the scene"
                refuse(what, self.where, "every mesh in the one scene", "mesh_not_placed")
            placed.append((node.mesh, T_scene_node[index]))
        lost = set(range(len(meshes))) - {mesh for mesh, _ in placed}
        if lost or not placed:
            what = f"mesh {min(lost)} is not used by any node" if lost else "no mesh"
            refuse(what, self.where, "at least one mesh, each placed by a node of the scene", "mesh_not_placed")
        return placed

    def _walk(self) -> dict[int, Floats]:
        """The transform of every node that is below the scene's top."""
        scenes, nodes = self.document.scenes, self.document.nodes
        if self.document.scene is None and len(scenes) != 1:
            refuse(f"{len(scenes)} scenes, none of them chosen", self.where, _TREE_ALLOWED, "several_scenes")
        number = self.document.scene or 0
        if number >= len(scenes):
            refuse(f"scene {number} of {len(scenes)}", self.where, _TREE_ALLOWED, "index_out_of_range")
        placed: dict[int, Floats] = {}
        waiting = [(index, np.eye(4)) for index in scenes[number].nodes]
        while waiting:
            index, T_scene_parent = waiting.pop()
            if index >= len(nodes) or index in placed:
                refuse(f"node {index} is missing or used twice", self.where, _TREE_ALLOWED, "not_a_tree")
            node, where = nodes[index], f"{self.where}, node {index}"
            allowed = "an invertible affine transform with last row 0 0 0 1"
            if node.matrix is not None:
                T = np.array(node.matrix, dtype=np.float64).reshape(4, 4).T
            else:
                if np.linalg.norm(node.rotation) == 0.0:
                    refuse("rotation quaternion of length 0", where, allowed, "not_invertible")
                T = np.eye(4)
                T[:3, :3] = scipy.spatial.transform.Rotation.from_quat(node.rotation).as_matrix() * np.array(node.scale)
                T[:3, 3] = node.translation
            determinant = np.linalg.det(T[:3, :3])
            if not np.isfinite(determinant) or determinant == 0.0 or T[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
                what = f"transform with determinant {determinant:.4g}, last row {T[3].tolist()}"
                refuse(what, where, allowed, "not_invertible")
            placed[index] = T_scene_parent @ T
            waiting.extend((child, placed[index]) for child in node.children)
        return placed

    def check_total(self, placed: list[int]) -> None:
        """Refuse too much before building: a small file may place a mesh many times, or an array in many parts."""

        def count(accessor: int | None) -> int:  # the reader refuses one that is not there by its name
            accessors = self.document.accessors[accessor : accessor + 1] if accessor is not None else []
            return accessors[0].count if accessors else 0

        number_of_parts = sum(len(self.document.meshes[mesh].primitives) for mesh in placed)
        if number_of_parts > MAX_PARTS:
            refuse(f"{number_of_parts} parts in all instances", self.where, f"at most {MAX_PARTS}", "too_many")
        parts = [one for mesh in placed for one in self.document.meshes[mesh].primitives]
        corners = [count(one.attributes.get("POSITION")) for one in parts]
        used = [own if one.indices is None else count(one.indices) for one, own in zip(parts, corners, strict=True)]
        vertices, triangles, size = sum(corners), sum(number // 3 for number in used), len(self.binary)
        most_vertices = min(MAX_VERTICES, size // _VERTEX_BYTES + MAX_REPEATED_VERTICES)
        most_triangles = min(MAX_TRIANGLES, size // _TRIANGLE_BYTES + MAX_REPEATED_VERTICES // 3)
        if triangles > most_triangles or vertices > most_vertices:
            what = f"{triangles} triangles and {vertices} vertices in all instances"
            allowed = f"at most {most_triangles} and {most_vertices} from {size} bytes of data"
            refuse(what, self.where, allowed, "too_many")

    def parts(self, mesh: int, T_scene_mesh: Floats) -> list[RawMesh]:
        """The primitives of a mesh at one place."""
        mirrored = np.linalg.det(T_scene_mesh[:3, :3]) < 0.0  # section 3.7.4: then the winding turns
        parts = []
        for number, primitive in enumerate(self.document.meshes[mesh].primitives):
            raw = self._primitive(primitive, f"{self.where}, mesh {mesh}, primitive {number}")
            vertices = raw.vertices @ T_scene_mesh[:3, :3].T + T_scene_mesh[:3, 3]
            parts.append(RawMesh(vertices, raw.faces[:, ::-1] if mirrored else raw.faces))
        return parts

    def _primitive(self, primitive: Primitive, where: str) -> RawMesh:
        position = primitive.attributes.get("POSITION")
        if primitive.mode != TRIANGLES:
            what = f"primitive mode {primitive.mode}"
            refuse(what, where, f"{TRIANGLES} (separate triangles)", "unsupported_feature")
        if position is None or primitive.targets:
            refuse("no POSITION, or morph targets", where, "a rigid mesh with POSITION", "unsupported_feature")
        accessor = self._accessor(position, where)
        if (accessor.component_type, accessor.type) != (_FLOAT, "VEC3"):
            refuse(f"POSITION of type {accessor.component_type} {accessor.type}", where, f"{_FLOAT} VEC3", "wrong_type")
        vertices = self._array(position, np.dtype("<f4"), 3, where).astype(np.float64)
        indices = np.arange(len(vertices), dtype=np.int64)
        if primitive.indices is not None:
            accessor = self._accessor(primitive.indices, where)
            if accessor.component_type not in _INDEX_TYPES or accessor.type != "SCALAR":
                what = f"indices of type {accessor.component_type} {accessor.type}"
                refuse(what, where, f"SCALAR of {list(_INDEX_TYPES)}", "wrong_type")
            dtype = _INDEX_TYPES[accessor.component_type]
            indices = self._array(primitive.indices, dtype, 1, where).reshape(-1).astype(np.int64)
        if len(indices) % 3 or len(indices) > 3 * MAX_TRIANGLES:
            what = f"{len(indices)} indices"
            refuse(what, where, f"three per triangle, at most {MAX_TRIANGLES} triangles", "wrong_count")
        if indices.max() >= len(vertices):
            refuse(f"index {indices.max()} out of range", where, f"0 to {len(vertices) - 1}", "index_out_of_range")
        return RawMesh(vertices, indices.reshape(-1, 3))

    def _accessor(self, index: int, where: str) -> Accessor:
        if index >= len(self.document.accessors):
            what = f"accessor {index} of {len(self.document.accessors)}"
            refuse(what, where, "an accessor of the file", "index_out_of_range")
        return self.document.accessors[index]

    def _array(self, index: int, dtype: np.dtype[Any], width: int, where: str) -> NDArray[Any]:
        """The numbers of an accessor, shape (count, width)."""
        accessor, views = self._accessor(index, where), self.document.buffer_views
        if accessor.buffer_view is None or accessor.sparse is not None or accessor.normalized:
            what = f"accessor {index} is sparse, normalized or without data"
            refuse(what, where, "plain data in a buffer view", "unsupported_feature")
        if accessor.buffer_view >= len(views):
            what = f"accessor {index} uses bufferView {accessor.buffer_view}"
            refuse(what, where, "a view of the file", "index_out_of_range")
        view, row = views[accessor.buffer_view], dtype.itemsize * width
        stride = view.byte_stride or row
        needed = accessor.byte_offset + (accessor.count - 1) * stride + row
        if needed > view.byte_length or stride < row:
            what = f"accessor {index} takes {needed} bytes of a view of {view.byte_length}, {stride} per row"
            refuse(what, where, "accessors inside their view", "size_mismatch")
        start, strides = view.byte_offset + accessor.byte_offset, (stride, dtype.itemsize)
        return np.ndarray((accessor.count, width), dtype, self.binary, offset=start, strides=strides)
