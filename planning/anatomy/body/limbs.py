"""Limbs that are pressed against the trunk: one body in the CT, but no way for a needle to go from one into the other.

The skin between an arm and the trunk that it touches is not seen. Two things tell them apart: the neck (a ball that
fits into either does not fit through where they touch), and a bone with air on many sides. A rib lies below skin that
is nearly flat: of a sphere about it, 1.6 times as wide as it is deep, .19 is air; about a forearm's bones a third.

Labels explain bones: what has a known name is no evidence, unless that is an arm's, or of bones altogether. No part
that is larger than a limb can be is one, nor the part that holds the target. All of it on a grid of 4 mm.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.anatomy.body.body_mask import BONE_HU, MIN_BONE_ML, CtImage, nearest_parts
from puncture_twin.planning.anatomy.default_roles import default_role, plain_name
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Bools, Floats, Ints32
from puncture_twin.planning.geometry.parts import in_blocks, voxels_inside

SAMPLING_MM = 4.0
"""Spacing of the grid on which limbs are looked for."""
MOST_ML = 9000.0
"""An adult's leg has 8 to 10 l, an arm 3 to 4 l: of two parts the smaller one is no larger, or neither is a limb."""
NECK_MM = 30.0
"""Radius of a ball that fits into an upper arm (35 to 50 mm) not through where it touches the trunk (50 mm wide)."""
NAMED_DENSE = 0.4
"""Of a structure's voxels so many are dense, or it is no bone, as a label "tissue" that holds bones."""
LIMBS, NO_ARM = "limbs and girdles", re.compile(r"scapula|clavic|femur|tibia|fibula|patella|tarsal")
"""In the table of names: the line that has those of arms and of bones altogether, and its others."""
DEEPEST_MM, DEEPEST_FRACTION = 60.0, 0.45
"""From a limb's bone to the air, and as a fraction of what the trunk's middle has: a spine lies deeper."""
GAP_MM = 16.0
"""Bones of one limb are so near to each other, at a wrist or an elbow."""
SPHERE, DIRECTIONS = 1.6, 200
"""Radius of the sphere about a bone, as a multiple of its depth, and how many points of it are asked."""
PARTLY, EXPOSED = 0.26, 0.32
"""Air about every voxel of a limb's bones, and its median. Of a real chest's shoulder blades and ribs the median is
.30 at most, of forearms across drawn trunks .33 and more."""
LEAST_MM, LINE_MM = 60.0, 12.0
"""A limb's bones are so long (a nose's and a spinous process's are not), and what continues them so near to their line.
"""
FLAT, SLACK_MM, BEYOND_ENDS_MM = 1.25, 5.0, 30.0
"""From its bone a limb pressed flat reaches so many times as far as the air is away, and so much farther, and beyond
the bone's ends: that holds .994 and more of the arms of drawn patients."""
FULL = np.ones((3, 3, 3), bool)


class Piece(NamedTuple):
    """A piece that may be a limb, as blocks; it is none where the target lies in ``near``."""

    near: Bools  # alone a limb's where the target lies in ``whole``
    whole: Bools
    ml: float = 0.0
    """Of a part beyond a neck: if neither it nor what holds the target is as small as a limb, it is none. Else 0."""


class LimbSearch(NamedTuple):
    """Limbs of a body: all that takes long is found once, and chosen of for each target.

    ``parts`` numbers the parts of blocks (nx, ny, nz), 0 outside; ``pieces`` are those of a part by its number: beyond
    a narrow neck, and what lies about exposed bones.
    """

    parts: Ints32
    T_ct_index: Floats  # shape (4, 4), LPS mm
    pieces: Callable[[int], tuple[Piece, ...]]

    def chosen(self, target_ct: Floats) -> tuple[int, ...]:
        """The number of the part that holds a target (3,), LPS mm; what each piece gives: 0 none, 1 near, 2 whole."""
        index = np.rint(np.linalg.solve(self.T_ct_index, np.append(target_ct, 1.0))[:3]).astype(int)
        at = tuple(np.clip(index, 0, np.array(self.parts.shape) - 1).tolist())
        pieces = self.pieces(int(self.parts[at]))
        own_ml = max((piece.ml for piece in pieces if piece.whole[at]), default=0.0)
        none = (piece.near[at] or min(own_ml, piece.ml) > MOST_ML for piece in pieces)
        answers = (0 if no else 2 - int(piece.whole[at]) for no, piece in zip(none, pieces, strict=True))
        return int(self.parts[at]), *answers

    def limbs(self, chosen: Sequence[int]) -> Bools:
        """Blocks of the body that belong to a limb without the target, by what was `chosen` for it."""
        limbs = np.zeros(self.parts.shape, bool)
        for piece, how in zip(self.pieces(chosen[0]), chosen[1:], strict=True):
            limbs |= piece[how - 1] if how else False
        return limbs & (self.parts == chosen[0])


def limb_search(image: CtImage, body: Bools, structures: Sequence[Structure]) -> LimbSearch:
    """The limbs of a CT and its body, sampled; bones that structures name are no evidence."""
    stride = np.maximum(1, (SAMPLING_MM / image.spacing_mm).astype(int))
    T = image.T_ct_index.copy()
    T[:3, 3] += T[:3, :3] @ ((stride - 1) / 2.0)
    T[:3, :3] *= stride
    coarse = in_blocks(body, stride) > 0
    solid = coarse | (2 * in_blocks(image.unscanned, stride) >= np.prod(stride))  # neither is air
    bone = 8 * in_blocks(body & (image.hu > BONE_HU), stride) >= np.prod(stride)  # of a block, which noise is not
    bone &= ~_explained(bone, T, structures)
    parts, _ = scipy.ndimage.label(coarse)

    @cache
    def pieces(number: int) -> tuple[Piece, ...]:
        return tuple(_pieces(parts == number, solid, bone & (parts == number), image.spacing_mm * stride))

    return LimbSearch(parts, T, pieces)


def _pieces(body: Bools, solid: Bools, bone: Bools, spacing_mm: Floats) -> Iterator[Piece]:
    """Parts of a body beyond narrow necks, and what lies about bones with air on more sides than a trunk's have.

    Of blocks that hold together, of what is no air (beyond the border it goes on), and of bones that are evidence.
    """
    block_ml = float(np.prod(spacing_mm)) / 1000.0
    cores = np.where(body, nearest_parts(body, NECK_MM, spacing_mm), 0)
    for number in range(1, int(cores.max()) + 1) if cores.max() > 1 else ():
        core = cores == number
        yield Piece(core, core, np.count_nonzero(core) * block_ml)
    padded = np.pad(solid, 1, mode="edge")
    depth_mm = scipy.ndimage.distance_transform_edt(padded, sampling=spacing_mm)[1:-1, 1:-1, 1:-1]
    deepest = min(DEEPEST_MM, DEEPEST_FRACTION * float(depth_mm[body].max()))
    index = np.argwhere(bone & (depth_mm <= deepest))
    air = np.zeros(body.shape)
    step = np.arange(DIRECTIONS) + 0.5
    z, angle = 1.0 - 2.0 * step / DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * step  # golden angle
    wide = np.sqrt(1.0 - z * z)
    for direction in np.stack([wide * np.cos(angle), wide * np.sin(angle), z], axis=1):
        away = SPHERE * depth_mm[tuple(index.T)][:, None] * direction / spacing_mm
        at = np.clip(np.rint(index + away).astype(int), 0, np.array(body.shape) - 1)
        air[tuple(index.T)] += ~solid[tuple(at.T)]
    air /= DIRECTIONS
    partly, exposed = air >= PARTLY, air >= EXPOSED
    if not partly.any():
        return
    gap_mm = scipy.ndimage.distance_transform_edt(~partly, sampling=spacing_mm)
    groups, count = scipy.ndimage.label(gap_mm <= GAP_MM / 2.0, FULL)
    for number in range(1, count + 1):
        group = partly & (groups == number)
        seen = np.argwhere(group & exposed) * spacing_mm
        large = len(seen) * block_ml >= MIN_BONE_ML and np.linalg.norm(np.ptp(seen, axis=0)) >= LEAST_MM
        if large and np.median(air[group]) >= EXPOSED:
            yield _about(_along(group, bone, spacing_mm), depth_mm, spacing_mm)


def _along(group: Bools, bone: Bools, spacing_mm: Floats) -> Bools:
    """Bones of a limb with what continues them in a line, where the limb lies deeper."""
    labels, _ = scipy.ndimage.label(bone, FULL)
    index = np.argwhere(np.isin(labels, np.unique(labels[group])))
    middle, axis = _axis(np.argwhere(group) * spacing_mm)
    off_mm = np.linalg.norm(np.cross(index * spacing_mm - middle, axis), axis=1)
    line = group.copy()
    line[tuple(index[off_mm <= LINE_MM].T)] = True
    return line


def _about(bones: Bools, depth_mm: Floats, spacing_mm: Floats) -> Piece:
    """What may belong to the limb about some bones, also some way beyond their ends."""
    gap, nearest = scipy.ndimage.distance_transform_edt(~bones, sampling=spacing_mm, return_indices=True)
    radius = depth_mm[tuple(nearest)]
    axis = _axis(np.argwhere(bones) * spacing_mm)[1] / spacing_mm
    steps = np.arange(-BEYOND_ENDS_MM, BEYOND_ENDS_MM + 1e-9, 0.5 * float(spacing_mm.min()))
    line = np.rint(steps[:, None] * axis).astype(int)
    rod = np.zeros(2 * np.abs(line).max(axis=0) + 1, bool)
    rod[tuple((line + np.array(rod.shape) // 2).T)] = True
    return Piece(np.asarray(gap < radius), scipy.ndimage.binary_dilation(gap <= FLAT * radius + SLACK_MM, rod))


def _explained(bone: Bools, T_ct_index: Floats, structures: Sequence[Structure]) -> Bools:
    """Blocks within, or beside, a structure that is a bone of a known name, no arm's."""
    explained = np.zeros(bone.shape, bool)
    for one in structures:
        line = default_role(one.name, "other")
        if line is not None and (line.group != LIMBS or NO_ARM.search(plain_name(one.name))):
            inside = voxels_inside(one.mesh, T_ct_index, bone.shape)
            if np.count_nonzero(inside & bone) >= NAMED_DENSE * np.count_nonzero(inside):
                explained |= inside
    return np.asarray(scipy.ndimage.binary_dilation(explained, FULL))


def _axis(points: Floats) -> tuple[Floats, Floats]:
    """Middle (3,) of points (n, 3), and the direction in which they reach farthest."""
    middle = points.mean(axis=0)
    return middle, np.linalg.svd(points - middle, full_matrices=False)[2][0]
