"""Where the nodes of a glTF scene put its meshes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from puncture_twin.planning.formats.guard import MAX_TRIANGLES
from puncture_twin.planning.formats.meshes.gltf_document import Document, Mesh, Node
from puncture_twin.planning.formats.raw_mesh import MAX_VERTICES, refuse

MAX_PARTS = 10_000
"""Primitives in all places: each one is built by itself."""

MAX_REPEATED_VERTICES = 3_000_000
"""Beyond what the file's own data hold: what it may place again. They take 70 MB."""

_VERTEX_BYTES, _TRIANGLE_BYTES = 12, 3
"""Least size of a vertex, and of a triangle by indices of one byte."""


class PlacedPrimitive(NamedTuple):
    """A mesh at one place of the scene.

    Attributes:
        mesh: Index into the document's meshes.
        T_scene_mesh: Shape (4, 4), affine, maps the mesh's coordinates to those of the scene, unit of the file.
    """

    mesh: int
    T_scene_mesh: NDArray[np.float64]


def placed_meshes(document: Document, data_bytes: int, where: str) -> list[PlacedPrimitive]:
    """Every mesh of the document with its place, in the order of the nodes.

    Args:
        document: The file's geometry.
        data_bytes: Bytes in its buffers, which bound what it may build.
        where: Its name, for the error.

    Raises:
        InputError: If the nodes are no tree, a transform is singular, a mesh has no place in the scene, or the places
            make more of the data than a file of its size may.
    """
    T_scene_node = _walk(document, where)
    placed = []
    for index, node in enumerate(document.nodes):
        if node.mesh is None:
            continue
        if node.mesh >= len(document.meshes):
            refuse(f"node {index} uses mesh {node.mesh}", where, f"one of the {len(document.meshes)} meshes")
        if index not in T_scene_node:
            refuse(f"node {index} holds a mesh but is not in the scene", where, "every mesh in the one scene")
        placed.append(PlacedPrimitive(node.mesh, T_scene_node[index]))
    lost = set(range(len(document.meshes))) - {each.mesh for each in placed}
    if lost or not placed:
        what = f"mesh {min(lost)} is placed by no node" if lost else "no mesh"
        refuse(what, where, "at least one mesh, each placed by a node of the scene")
    _check_total(document, placed, data_bytes, where)
    return placed


def _walk(document: Document, where: str) -> dict[int, NDArray[np.float64]]:
    """The transform of every node that can be reached from the scene's top."""
    allowed = "nodes that form trees below one scene"
    if document.scene is None and len(document.scenes) != 1:
        refuse(f"{len(document.scenes)} scenes and none of them chosen", where, allowed)
    number = document.scene or 0
    if number >= len(document.scenes):
        refuse(f"scene {number} of {len(document.scenes)}", where, allowed)
    found: dict[int, NDArray[np.float64]] = {}
    waiting = [(index, np.eye(4)) for index in document.scenes[number].nodes]
    while waiting:
        index, T_scene_parent = waiting.pop()
        if index >= len(document.nodes) or index in found:
            refuse(f"node {index} is missing, or reached twice", where, allowed)
        node = document.nodes[index]
        found[index] = T_scene_parent @ _local(node, f"{where}, node {index}")
        waiting.extend((child, found[index]) for child in node.children)
    return found


def _local(node: Node, where: str) -> NDArray[np.float64]:
    """T_parent_node, from its matrix (by columns) or as translation times rotation times scale."""
    allowed = "an invertible affine transform with last row 0 0 0 1"
    if node.matrix is not None:
        T = np.array(node.matrix, dtype=np.float64).reshape(4, 4).T
    else:
        if np.linalg.norm(node.rotation) == 0.0:
            refuse("rotation quaternion of length 0", where, allowed)
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(node.rotation).as_matrix() * np.array(node.scale)
        T[:3, 3] = node.translation
    determinant = np.linalg.det(T[:3, :3])
    if not np.isfinite(determinant) or determinant == 0.0 or T[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        refuse(f"transform with determinant {determinant:.4g}, last row {T[3].tolist()}", where, allowed)
    return T


class _Size(NamedTuple):
    parts: int
    vertices: int
    triangles: int


def _check_total(document: Document, placed: list[PlacedPrimitive], data_bytes: int, where: str) -> None:
    """Count before building: a small file may place one large mesh many times, or name one array in many parts."""
    sizes = [_size(document, mesh) for mesh in document.meshes]
    total = _Size(*(sum(sizes[each.mesh][kind] for each in placed) for kind in range(3)))
    if total.parts > MAX_PARTS:
        refuse(f"{total.parts} parts in all places", where, f"at most {MAX_PARTS}")
    vertices = min(MAX_VERTICES, data_bytes // _VERTEX_BYTES + MAX_REPEATED_VERTICES)
    triangles = min(MAX_TRIANGLES, data_bytes // _TRIANGLE_BYTES + MAX_REPEATED_VERTICES // 3)
    if total.triangles > triangles or total.vertices > vertices:
        what = f"{total.triangles} triangles and {total.vertices} vertices in all places"
        refuse(what, where, f"at most {triangles} and {vertices} from {data_bytes} bytes of data")


def _size(document: Document, mesh: Mesh) -> _Size:
    vertices = triangles = 0
    for primitive in mesh.primitives:
        corners = _count(document, primitive.attributes.get("POSITION"))
        vertices += corners
        triangles += (corners if primitive.indices is None else _count(document, primitive.indices)) // 3
    return _Size(len(mesh.primitives), vertices, triangles)


def _count(document: Document, accessor: int | None) -> int:
    if accessor is None or accessor >= len(document.accessors):
        return 0  # the reader refuses it by name
    return document.accessors[accessor].count
