"""Limbs that are pressed against the trunk: one body in the CT, but no way for a needle to go from one into the other.

The skin between an arm and the trunk that it touches is not seen. Two things tell them apart: the neck (a ball that
fits into either does not fit through where they touch), and a bone with air on many sides. A rib lies below skin that
is nearly flat: of a sphere about it, 1.6 times as wide as it is deep, .19 is air; about a forearm's bones a third.

Labels explain bones: what has a known name is no evidence, unless that is an arm's, or of bones altogether. No part
that is larger than a limb can be is one, nor the part that holds the target. All of it on a grid of 4 mm.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.body_mask import BONE_HU, MIN_BONE_ML, CtImage, nearest_parts
from puncture_twin.planning.anatomy.default_roles import default_role, plain_name
from puncture_twin.planning.anatomy.unnamed import Named
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
    """What may be a limb, as blocks; it is none where the target lies in ``near``.

    Attributes:
        near: Alone a limb's where the target lies in ``whole``.
        ml: Of a part beyond a neck: if neither it nor what holds the target is as small as a limb, it is none. Else 0.
    """

    near: Bools
    whole: Bools
    ml: float = 0.0


@dataclass(frozen=True, eq=False)
class BodyPart:
    """A part of the body that holds together, on a grid of some 4 mm, axes running to the left, back and head.

    Attributes:
        body: Shape (nx, ny, nz); a block counts where any of its voxels does.
        solid: Same shape, the whole body, and what was not scanned: neither is air.
        bone: Same shape, bone that is evidence of a limb; a block counts where an eighth of it is, which noise is not.
        spacing_mm: Shape (3,).
    """

    body: Bools
    solid: Bools
    bone: Bools
    spacing_mm: Floats

    def volume_ml(self, mask: Bools) -> float:
        """Of a mask."""
        return float(np.count_nonzero(mask) * np.prod(self.spacing_mm)) / 1000.0

    @cached_property
    def depth_mm(self) -> Floats:
        """From the air, shape of ``body``; beyond the border the body goes on."""
        padded = np.pad(self.solid, 1, mode="edge")
        return np.asarray(scipy.ndimage.distance_transform_edt(padded, sampling=self.spacing_mm)[1:-1, 1:-1, 1:-1])

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """Parts beyond a narrow neck, and what lies about exposed bones; the same for every target."""
        parts = [self._core == number for number in range(1, int(self._core.max(initial=0)) + 1)]
        necks = (Piece(part, part, self.volume_ml(part)) for part in parts if len(parts) > 1)
        return (*necks, *map(self._about, self._exposed()))

    def chosen(self, at: tuple[int, ...]) -> Iterator[int]:
        """Of each piece: no limb (0), near (1) or whole (2), where a block holds the target."""
        own_ml = self.volume_ml(self._core == self._core[at]) if self.pieces else 0.0
        for piece in self.pieces:
            none = piece.near[at] or min(own_ml, piece.ml) > MOST_ML
            yield 0 if none else 2 - int(piece.whole[at])

    @cached_property
    def _core(self) -> Ints32:
        parts = nearest_parts(self.body, NECK_MM, self.spacing_mm)
        return np.where(self.body, parts, 0).astype(np.int32) if parts.any() else self.body.astype(np.int32)

    def _exposed(self) -> Iterator[Bools]:
        """Bones about which air is on more sides than about a bone of the trunk, of one limb each."""
        deepest = min(DEEPEST_MM, DEEPEST_FRACTION * float(self.depth_mm[self.body].max()))
        near, air = self.bone & (self.depth_mm <= deepest), np.zeros(self.body.shape)
        air[near] = self._air_about(np.argwhere(near))
        partly = air >= PARTLY
        gap_mm = scipy.ndimage.distance_transform_edt(~partly, sampling=self.spacing_mm)
        groups, count = scipy.ndimage.label(gap_mm <= GAP_MM / 2.0, FULL)
        for number in range(1, count + 1) if partly.any() else ():
            group = partly & (groups == number)
            exposed = group & (air >= EXPOSED)
            long = exposed.any() and np.linalg.norm(np.ptp(np.argwhere(exposed), axis=0) * self.spacing_mm) >= LEAST_MM
            if long and self.volume_ml(exposed) >= MIN_BONE_ML and np.median(air[group]) >= EXPOSED:
                yield self._along(group)

    def _along(self, bones: Bools) -> Bools:
        """With what continues them in a line, where the limb lies deeper."""
        labels, _ = scipy.ndimage.label(self.bone, FULL)
        index = np.argwhere(np.isin(labels, np.unique(labels[bones])))
        middle, axis = _axis(np.argwhere(bones) * self.spacing_mm)
        off_mm = index * self.spacing_mm - middle
        off_mm -= np.outer(off_mm @ axis, axis)
        line = bones.copy()
        line[tuple(index[np.linalg.norm(off_mm, axis=1) <= LINE_MM].T)] = True
        return line

    def _air_about(self, index: NDArray[np.int64]) -> Floats:
        """How much of a sphere about each block (n, 3) is air; 0..1."""
        step = np.arange(DIRECTIONS) + 0.5
        z = 1.0 - 2.0 * step / DIRECTIONS
        angle, wide = np.pi * (1.0 + 5.0**0.5) * step, np.sqrt(1.0 - z * z)  # golden angle
        radius_mm, last = SPHERE * self.depth_mm[tuple(index.T)], np.array(self.body.shape) - 1
        air = np.zeros(len(index))
        for direction in np.stack([wide * np.cos(angle), wide * np.sin(angle), z], axis=1):
            at = np.clip(np.rint(index + radius_mm[:, None] * direction / self.spacing_mm).astype(int), 0, last)
            air += ~self.solid[tuple(at.T)]
        return air / DIRECTIONS

    def _about(self, bones: Bools) -> Piece:
        """What may belong to the limb about some bones, also some way beyond their ends."""
        gap, nearest = scipy.ndimage.distance_transform_edt(~bones, sampling=self.spacing_mm, return_indices=True)
        radius = self.depth_mm[tuple(nearest)]
        reach = gap <= FLAT * radius + SLACK_MM
        along = _axis(np.argwhere(bones) * self.spacing_mm)[1] / self.spacing_mm
        steps = np.arange(-BEYOND_ENDS_MM, BEYOND_ENDS_MM + 1e-9, 0.5 * float(self.spacing_mm.min()))
        line = np.rint(steps[:, None] * along).astype(int)
        rod = np.zeros(2 * np.abs(line).max(axis=0) + 1, bool)
        rod[tuple((line + np.array(rod.shape) // 2).T)] = True
        return Piece(np.asarray(gap < radius), scipy.ndimage.binary_dilation(reach, rod))


class LimbSearch(NamedTuple):
    """Limbs of a body: all that takes long is found once, and chosen of for each target.

    Attributes:
        parts: Shape (nx, ny, nz), from 1 the number of the part that a block belongs to, 0 outside.
        T_ct_index: Shape (4, 4), LPS mm.
    """

    parts: Ints32
    T_ct_index: Floats
    part: Callable[[int], BodyPart]

    def chosen(self, target_ct: Floats) -> tuple[int, ...]:
        """The number of the part that holds a target (3,), LPS mm, and what `BodyPart.chosen` says of its pieces."""
        index = np.rint(np.linalg.solve(self.T_ct_index, np.append(target_ct, 1.0))[:3]).astype(int)
        at = tuple(np.clip(index, 0, np.array(self.parts.shape) - 1).tolist())
        return int(self.parts[at]), *self.part(int(self.parts[at])).chosen(at)

    def limbs(self, chosen: Sequence[int]) -> Bools:
        """Blocks of the body that belong to a limb without the target, by what was `chosen` for it."""
        part, limbs = self.part(chosen[0]), np.zeros(self.parts.shape, bool)
        for piece, how in zip(part.pieces, chosen[1:], strict=True):
            limbs |= piece[how - 1] if how else False
        return limbs & part.body


def limb_search(image: CtImage, body: Bools, structures: Sequence[Named]) -> LimbSearch:
    """The limbs of a CT and its body, sampled; bones that structures name are no evidence."""
    stride = np.maximum(1, (SAMPLING_MM / image.spacing_mm).astype(int))
    T = image.T_ct_index.copy()
    T[:3, 3] += T[:3, :3] @ ((stride - 1) / 2.0)
    T[:3, :3] *= stride
    coarse = in_blocks(body, stride) > 0
    parts, _ = scipy.ndimage.label(coarse)
    solid = coarse | (2 * in_blocks(image.unscanned, stride) >= np.prod(stride))
    every_bone = 8 * in_blocks(body & (image.hu > BONE_HU), stride) >= np.prod(stride)
    bone = every_bone & ~_explained(every_bone, T, structures)
    spacing_mm = image.spacing_mm * stride

    @cache
    def part(number: int) -> BodyPart:
        own = parts == number
        return BodyPart(own, solid, bone & own, spacing_mm)

    return LimbSearch(parts, T, part)


def _explained(bone: Bools, T_ct_index: Floats, structures: Sequence[Named]) -> Bools:
    """Blocks within, or beside, a structure that is a bone of a known name, no arm's."""
    explained = np.zeros(bone.shape, bool)
    for name, mesh in structures:
        line = default_role(name, "other")
        if line is not None and (line.group != LIMBS or NO_ARM.search(plain_name(name))):
            inside = voxels_inside(mesh, T_ct_index, bone.shape)
            if np.count_nonzero(inside & bone) >= NAMED_DENSE * np.count_nonzero(inside):
                explained |= inside
    return np.asarray(scipy.ndimage.binary_dilation(explained, FULL))


def _axis(points: Floats) -> tuple[Floats, Floats]:
    """Middle (3,) of points (n, 3), and the direction in which they reach farthest."""
    middle = points.mean(axis=0)
    return middle, np.linalg.svd(points - middle, full_matrices=False)[2][0]
