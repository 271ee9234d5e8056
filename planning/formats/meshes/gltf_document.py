"""The part of a glTF 2.0 document that holds geometry, validated; everything else in it is left aside.

Source: Khronos glTF 2.0 specification, section 5 (properties reference).
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel

from puncture_twin.planning.formats.raw_mesh import refuse

_HARMLESS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_")
"""Required extensions with these beginnings change colours only, not the surface."""
_INSTANCING = "EXT_mesh_gpu_instancing"

MAX_NODES = 10_000
"""Nodes, accessors or views of a file; a scene of anatomy has some hundred, and each one costs its own time."""

MAX_BUFFERS = 16
"""A writer makes one, or one for each kind of data; each may name a file that is read."""

Index = Annotated[int, Field(ge=0, le=2**53)]
Number = Annotated[float, Field(allow_inf_nan=False)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, alias_generator=to_camel, extra="ignore")


class Asset(_Part):
    """The version of the standard."""

    version: str


class Buffer(_Part):
    """A run of bytes: in the file, beside it, or in the text."""

    byte_length: Index
    uri: str | None = None


class BufferView(_Part):
    """A part of a buffer."""

    buffer: Index
    byte_length: Index
    byte_offset: Index = 0
    byte_stride: Annotated[int, Field(ge=4, le=252)] | None = None


class Accessor(_Part):
    """Numbers of one type in a buffer view."""

    component_type: int
    count: Annotated[int, Field(ge=1, le=2**40)]
    type: str
    buffer_view: Index | None = None
    byte_offset: Index = 0
    normalized: bool = False
    sparse: dict[str, Any] | None = None


class Primitive(_Part):
    """A part of a mesh with one material."""

    attributes: dict[str, Index]
    indices: Index | None = None
    mode: int = 4
    targets: list[dict[str, Any]] | None = None


class Mesh(_Part):
    """Primitives that are placed together."""

    primitives: Annotated[list[Primitive], Field(min_length=1)]


class Node(_Part):
    """A place in the scene: a mesh, children, and the transform to its parent."""

    children: list[Index] = []
    mesh: Index | None = None
    skin: Index | None = None
    matrix: Annotated[list[Number], Field(min_length=16, max_length=16)] | None = None
    translation: Annotated[list[Number], Field(min_length=3, max_length=3)] = [0.0, 0.0, 0.0]
    rotation: Annotated[list[Number], Field(min_length=4, max_length=4)] = [0.0, 0.0, 0.0, 1.0]
    scale: Annotated[list[Number], Field(min_length=3, max_length=3)] = [1.0, 1.0, 1.0]
    extensions: dict[str, Any] = {}


class GltfScene(_Part):
    """The nodes at the top."""

    nodes: Annotated[list[Index], Field(max_length=MAX_NODES)] = []


class Document(_Part):
    """The geometry of a glTF file."""

    asset: Asset
    scene: Index | None = None
    scenes: list[GltfScene] = []
    nodes: Annotated[list[Node], Field(max_length=MAX_NODES)] = []
    meshes: list[Mesh] = []
    accessors: Annotated[list[Accessor], Field(max_length=MAX_NODES)] = []
    buffer_views: Annotated[list[BufferView], Field(max_length=MAX_NODES)] = []
    buffers: Annotated[list[Buffer], Field(max_length=MAX_BUFFERS)] = []
    extensions_required: list[str] = []

    def check_supported(self, where: str) -> None:
        """Refuse what would change the surface in a way that this reader does not know.

        Raises:
            InputError: If the version is not 2, or an extension, skin or instancing decides the shape.
        """
        if not self.asset.version.startswith("2."):
            refuse(f"glTF version {self.asset.version[:20]!r}", where, "version 2")
        for name in self.extensions_required:
            if not name.startswith(_HARMLESS):
                refuse(f"needs the extension {name[:60]!r}", where, "glTF without compression or other extensions")
        for index, node in enumerate(self.nodes):
            if node.skin is not None or _INSTANCING in node.extensions:
                refuse(f"node {index} is bent by a skin or instanced", where, "rigid meshes, one per node")
