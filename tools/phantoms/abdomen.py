"""An abdomen with known truth: every structure as an implicit body, and as a mesh made from it.

Patient space LPS, mm. The shapes are our own; sizes and places follow textbook anatomy of an adult.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.geometry.mesh import TriangleMesh
from tools.phantoms import bones, torso, vessels, viscera
from tools.phantoms.implicit import Field
from tools.phantoms.mesher import SamplingBox, mesh_field

_SEARCH_STEP_MM = 10.0
"""Step of the search for a body's extent."""
_SEARCH_REACH_MM = 16.0
"""A body's surface is nearer than this to some node of the search grid, also where it is thin."""
_SEARCH_LOW, _SEARCH_HIGH = (-190.0, -140.0, -210.0), (190.0, 140.0, 280.0)


class Part(NamedTuple):
    """How one structure is made: the spacing of its grid, about as wide as triangles, and a plausible volume."""

    body: Callable[[], Field]
    spacing_mm: float
    volume_ml: tuple[float, float]
    basis: str


def _skin() -> Field:
    return torso.skin


_SCAN = "extent of the modelled trunk times its section"
_ADULT = "adult range of CT volumetry, rounded"
STRUCTURES: dict[str, Part] = {
    "skin": Part(_skin, 5.4, (22000.0, 34000.0), _SCAN),
    "spine": Part(bones.spine, 3.6, (600.0, 1300.0), _SCAN),
    "ribs_right": Part(bones.ribs_right, 3.1, (70.0, 220.0), _SCAN),
    "ribs_left": Part(bones.ribs_left, 3.1, (70.0, 220.0), _SCAN),
    "sternum": Part(bones.sternum, 2.6, (8.0, 40.0), _SCAN),
    "costal_cartilages": Part(bones.costal_cartilages, 2.6, (30.0, 120.0), _SCAN),
    "hip_right": Part(bones.hip_right, 3.2, (60.0, 220.0), _SCAN),
    "hip_left": Part(bones.hip_left, 3.2, (60.0, 220.0), _SCAN),
    "liver": Part(viscera.liver, 3.2, (1350.0, 1650.0), _ADULT),
    "lesion": Part(viscera.lesion, 1.5, (4.0, 8.0), "ellipsoid of 21 to 24 mm"),
    "gallbladder": Part(viscera.gallbladder, 2.2, (15.0, 50.0), _ADULT),
    "portal_vein": Part(vessels.portal_vein, 1.9, (20.0, 60.0), _SCAN),
    "hepatic_veins": Part(vessels.hepatic_veins, 1.9, (8.0, 35.0), _SCAN),
    "aorta": Part(vessels.aorta, 2.8, (90.0, 220.0), _SCAN),
    "vena_cava_inferior": Part(vessels.vena_cava_inferior, 2.8, (90.0, 200.0), _SCAN),
    "kidney_right": Part(viscera.kidney_right, 2.5, (120.0, 200.0), _ADULT),
    "kidney_left": Part(viscera.kidney_left, 2.5, (120.0, 200.0), _ADULT),
    "spleen": Part(viscera.spleen, 2.5, (150.0, 250.0), _ADULT),
    "pancreas": Part(viscera.pancreas, 2.2, (50.0, 120.0), _ADULT),
    "oesophagus": Part(viscera.oesophagus, 2.2, (12.0, 45.0), _SCAN),
    "stomach": Part(viscera.stomach, 3.0, (200.0, 600.0), "moderately filled"),
    "duodenum": Part(viscera.duodenum, 2.6, (50.0, 140.0), _ADULT),
    "colon": Part(viscera.colon, 3.3, (600.0, 1500.0), "moderately filled, sigmoid not included"),
    "small_bowel": Part(viscera.small_bowel, 3.4, (150.0, 500.0), "part of the loops only"),
    "heart": Part(viscera.heart, 4.2, (250.0, 600.0), "part below the upper end of the trunk"),
    "lung_right": Part(viscera.lung_right, 4.2, (500.0, 2000.0), "part below the upper end of the trunk"),
    "lung_left": Part(viscera.lung_left, 4.2, (400.0, 2000.0), "part below the upper end of the trunk"),
}
"""Every structure of the abdomen, bones and vessels before the organs that make room for them."""


def abdomen_field(name: str) -> Field:
    """The field of one structure: takes points_ct (n, 3), LPS mm; negative inside, 0 on the surface."""
    return STRUCTURES[name].body()


def abdomen_mesh(name: str) -> TriangleMesh:
    """The mesh of one structure, LPS mm, closed, triangles outward."""
    field = abdomen_field(name)
    return mesh_field(field, _box(field, STRUCTURES[name].spacing_mm))


def _box(field: Field, spacing_mm: float) -> SamplingBox:
    """A box about a body, found on a coarse grid over the trunk."""
    axes = [np.arange(low, high + 1.0, _SEARCH_STEP_MM) for low, high in zip(_SEARCH_LOW, _SEARCH_HIGH, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    near = nodes[field(nodes) < _SEARCH_REACH_MM]
    low, high = near.min(axis=0) - _SEARCH_STEP_MM / 2, near.max(axis=0) + _SEARCH_STEP_MM / 2
    return SamplingBox((low[0], low[1], low[2]), (high[0], high[1], high[2]), spacing_mm)
