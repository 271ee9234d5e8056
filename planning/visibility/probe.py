"""Where the ultrasound probe goes: on the skin about the entry, with needle and target in its image plane.

A footprint is where a direction from the target meets the skin; direction and needle span the image plane, and the
middle of the image looks back along the direction. What is in the way of the sound (bone, air), of the probe, or of the
arm that holds it, rules the footprint out; of the rest the one with the least depth is taken.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType

import numpy as np

from puncture_twin.planning.anatomy.anatomy import UNNAMED_DENSE, UNNAMED_GAS, Anatomy
from puncture_twin.planning.anatomy.default_roles import default_role, plain_name
from puncture_twin.planning.anatomy.scan import Scan
from puncture_twin.planning.anatomy.skin import Skin, skin_paths
from puncture_twin.planning.anatomy.structure import Role
from puncture_twin.planning.arm.inverse_kinematics import inverse as branches, nearest_within_limits
from puncture_twin.planning.arm.kinematics import away_from_singularities
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, Ints, read_only
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.text import Facts, Shown, brief
from puncture_twin.planning.case.case import bed_frame
from puncture_twin.planning.case.settings import Ultrasound
from puncture_twin.planning.collision.bodies import FclSkin
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.two_arms import BetweenArms, handle_tool, head_body
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM, case_boxes, outside_surface
from puncture_twin.planning.geometry.containment import contains, first_crossing
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined
from puncture_twin.planning.geometry.rigid import exp_rotation, frame_about, inverse, pose
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.visibility.cameras import Watched

HEAD_MM, HANDLE_MM, LENGTH_MM = (8.0, 30.0, 20.0), 40.0, 150.0
"""Of the probe: how much wider than its footprint the head is, how long, and how thick; the handle's diameter; flange
to face. As the probe of the workcell that calibrates itself."""
ASIDE, AROUND = np.radians(np.arange(10.0, 81.0, 5.0)), np.radians(np.arange(0.0, 360.0, 15.0))
"""Footprints that are looked at: angle of the image's middle from the needle, and of the image plane about it."""
TILT = np.radians(30.0)
"""Between the image's middle and the skin's inward normal: farther a face of 20 mm lifts off."""
RAYS = 21
"""Lines from the target to the footprint that must be free: every 2 mm of a face of 40 mm."""
AIR_HU, AIR_STEP_MM, RIM_MM = -300.0, 1.0, 3.0
"""In a CT what is thinner is air; how densely a line is looked at; next to the skin voxels hold both."""
CLEARANCE_MM = 4.0
"""What probe and its arm keep from needle, holder and the needle's arm, as where it calibrates itself, at states of the
insertion that are so close that none between them is farther from one: so nothing touches there either."""
BONE = (
    *("vertebrae, spine", "ribs", "costal cartilages, sternum", "pelvis", "limbs and girdles", "skull and face"),
    "devices",
)
"""Groups of `planning.anatomy.default_roles` that no sound passes."""
GAS = frozenset({"gas", "air", "pneumothorax"})
"""Words of a name that say it."""
AIRY = ("lungs", "airways", "stomach and bowel")
"""Groups that hold air; of the last a CT says where."""
ABOUT_UP, ABOUT_BED = (180, 135, 225, 90, 270), (90, -90, 60, -60, 120, -120)
"""Turns of the needle's arm about the target, degrees: where the second arm is assumed, in this order."""
BASES_APART_MM = 300.0
"""The least distance of an assumed base from the needle's."""


class Ruled(StrEnum):
    """Reasons that rule out a footprint; of several the last one reached."""

    NO_SKIN = "no_skin"
    TOO_DEEP = "too_deep"
    TILTED = "tilted"
    UNKNOWN = "unknown_region"
    AIR = "air"
    BONE = "bone"
    OUT_OF_REACH = "out_of_reach"
    PROBE_ARM = "probe_arm_collision"
    ARMS = "arms_collide"


MOUNT, ASIDE_OF_IT = "another [ultrasound.mount]", "another direction, or a narrower probe (width_mm)"
WHY: Mapping[Ruled, tuple[str, str]] = MappingProxyType(
    {
        Ruled.NO_SKIN: ("are where no skin is known", "a CT that shows more of the skin about the entry"),
        Ruled.TOO_DEEP: ("are farther from the target than the probe sees", "a larger depth_mm in [ultrasound]"),
        Ruled.TILTED: ("lean too far against the skin", "an entry where the skin is flatter"),
        Ruled.UNKNOWN: ("have what nobody knows in the way of the sound", ASIDE_OF_IT),
        Ruled.AIR: ("have air in the way of the sound", ASIDE_OF_IT),
        Ruled.BONE: ("have bone in the way of the sound", ASIDE_OF_IT),
        Ruled.OUT_OF_REACH: ("are beyond the reach of the probe's arm", f"{MOUNT}, or a longer arm (model)"),
        Ruled.PROBE_ARM: ("have the probe's arm in the patient, in an obstacle or in itself", MOUNT),
        Ruled.ARMS: ("have probe and needle, or their arms, touch each other", f"{MOUNT}, or another direction"),
    }
)
"""What is said of footprints, and what would let most of them pass."""
STAGES = (tuple(Ruled)[6:], tuple(Ruled)[3:6], tuple(Ruled)[:3])
"""By arm, by sound, by skin: what came to a later stage says more."""


@dataclass(frozen=True, eq=False)
class ProbeView(Shown):
    """Place of the probe, or the reason why it has none."""

    T_ct_image: Floats | None
    """Shape (4, 4), mm: its origin in the middle of the face, x along the face toward the needle, y along the depth, z
    across the plane; None where there is no footprint."""
    q_probe: Floats | None  # shape (6,), rad, of the arm that holds it, or None
    T_base_ct: Floats | None  # shape (4, 4), mm, of that arm's base; None where no assumed place serves
    assumed: bool  # whether the case left that arm's place open
    depth_mm: float  # from the face to the target, or NaN
    counts: Mapping[str, int]
    """How many footprints are ruled out by what, and how many are left or were not needed (``free``)."""

    @property
    def sentence(self) -> str:
        """Sentence on the probe's place."""
        where = "an assumed place" if self.assumed else "its stated place"
        if self.T_ct_image is not None:
            return f"the probe sees needle and target at {self.depth_mm:.0f} mm of depth, its arm at {where}"
        stage = next(stage for stage in STAGES if any(why in self.counts for why in stage))
        why = max(stage, key=lambda one: self.counts.get(one, 0))
        failed = f"{self.counts[why]} of {sum(self.counts.values())} footprints {WHY[why][0]}"
        return f"no place for the probe, its arm at {where}: {failed}; allowed: {WHY[why][1]}"

    @brief
    def __repr__(self) -> str:
        return self.sentence

    def _facts(self) -> Facts:
        yield "probe", self.sentence
        if self.T_ct_image is not None and self.q_probe is not None:
            yield "middle of the face, CT", "({:.1f}, {:.1f}, {:.1f}) mm".format(*self.T_ct_image[:3, 3])
            yield "its arm's joints", ", ".join(f"{angle:.1f}°" for angle in np.degrees(self.q_probe))
        if self.T_base_ct is not None:
            yield "its arm's base, CT", "({:.0f}, {:.0f}, {:.0f}) mm".format(*inverse(self.T_base_ct)[:3, 3])
        yield "footprints", ", ".join(f"{count} {why}" for why, count in self.counts.items())


_ORDER = [str(why) for why in Ruled]
FREE = "free"


def probe_view(context: CaseContext, plan: Plan | Watched) -> ProbeView:
    """Where the probe of a case with ``[ultrasound]`` goes while a plan's needle is inserted.

    Raises:
        InputError: The case declares no probe, or a stated base of its arm is in the patient.
    """
    probe = context.case.ultrasound
    if probe is None:
        refuse("no probe is declared", context.case.path, "a table [ultrasound]", "no_ultrasound")
    feet = footprints(context.anatomy.skin, plan.target_ct, plan.outward_ct, probe.depth_mm)
    passing(feet, opaque(context.anatomy, context.case.region), context.anatomy.scan, probe.width_mm)
    rows, stated = feet.left, probe.T_base_ct_mount
    for T_base_ct in _mounts(context, plan) if stated is None else (stated,):
        arm = _arm(context, plan, probe, T_base_ct) if len(rows) else None
        if arm is not None and (placed := arm.place(feet, rows)) is not None:
            row, q = placed
            T_ct_image, depth_mm = read_only(feet.T_ct_image[row]), float(feet.depth[row])
            return ProbeView(T_ct_image, read_only(q), T_base_ct, stated is None, depth_mm, feet.counts)
    feet.rule_out(rows[feet.ruled[rows] < 0], Ruled.PROBE_ARM)  # where no place was free for its base
    return ProbeView(None, None, stated, stated is None, np.nan, feet.counts)


@dataclass(frozen=True, eq=False)
class Footprints:
    """Places of the probe's face on the skin, a row each."""

    skin: Skin
    target_ct: Floats  # shape (3,), mm
    T_ct_image: Floats  # shape (n, 4, 4), mm, see `ProbeView`; NaN without skin
    depth: Floats  # shape (n,), mm, from the face to the target
    ruled: Ints  # shape (n,), what rules each out, by its place among `Ruled`; -1 where nothing has yet

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of footprints by the reason that rules them out; ``free`` for the rest."""
        names = [*_ORDER, FREE]
        counts = np.bincount(np.where(self.ruled < 0, len(_ORDER), self.ruled), minlength=len(names))
        return MappingProxyType({name: int(count) for name, count in zip(names, counts, strict=True) if count})

    @property
    def left(self) -> Ints:
        """Rows that are not ruled out, the least depth first, of equal ones the farthest from the needle."""
        rows = np.flatnonzero(self.ruled < 0)
        return rows[np.argsort(self.depth[rows].round(6), kind="stable")]

    def rule_out(self, rows: Bools | Ints | int, why: Ruled) -> None:
        """Record a reason for some footprints, where they came farther than before."""
        self.ruled[rows] = np.maximum(self.ruled[rows], _ORDER.index(why))


def footprints(skin: Skin, target_ct: Floats, outward_ct: Floats, depth_mm: float) -> Footprints:
    """The footprints about a needle, those without skin, too deep and too tilted ruled out.

    Args:
        target_ct: Shape (3,), mm.
        outward_ct: Shape (3,), unit, from the target along the needle.
        depth_mm: How deep the probe sees.
    """
    across = frame_about(outward_ct)[:, :2]
    aside, around = (grid.ravel() for grid in np.meshgrid(ASIDE[::-1], AROUND, indexing="ij"))
    in_plane = np.stack([np.cos(around), np.sin(around)], axis=1) @ across.T
    middle = np.cos(aside)[:, None] * outward_ct + np.sin(aside)[:, None] * in_plane
    toward = np.sin(aside)[:, None] * outward_ct - np.cos(aside)[:, None] * in_plane  # the needle, along the face
    paths = skin_paths(skin, target_ct, middle, depth_mm)
    R = np.stack([toward, -middle, np.cross(toward, -middle)], axis=2)
    feet = Footprints(skin, target_ct, pose(R, paths.entry_ct), paths.path_length, np.full(len(middle), -1))
    feet.rule_out(paths.skin_angle > TILT, Ruled.TILTED)
    feet.ruled[paths.path_length > depth_mm] = _ORDER.index(Ruled.TOO_DEEP)
    feet.ruled[~np.isnan(paths.unknown_depth) | np.isnan(paths.path_length)] = _ORDER.index(Ruled.NO_SKIN)
    return feet


Opaque = Mapping[Ruled, Sequence[TriangleMesh]]
"""Reason to surfaces that no sound passes, CT frame; where two are in the way the later reason is named."""


def opaque(anatomy: Anatomy, region: str) -> Opaque:
    """What no sound passes in a body, by names and roles of its structures; gas in the bowel only without a CT."""
    surfaces: dict[Ruled, list[TriangleMesh]] = {Ruled.UNKNOWN: [], Ruled.AIR: [], Ruled.BONE: []}
    airy = AIRY if anatomy.scan is None else AIRY[:-1]
    for one in anatomy.structures:
        line = default_role(one.name, region)
        group = "" if line is None else line.group
        if one.name == UNNAMED_DENSE or group in BONE:
            surfaces[Ruled.BONE].append(one.mesh)
        elif one.name == UNNAMED_GAS or group in airy or not GAS.isdisjoint(plain_name(one.name).split("_")):
            surfaces[Ruled.AIR].append(one.mesh)
        elif one.role is Role.UNKNOWN:
            surfaces[Ruled.UNKNOWN].append(one.mesh)
    return surfaces


def passing(feet: Footprints, surfaces: Opaque, scan: Scan | None, width_mm: float) -> None:
    """Rule out the footprints whose sector, from the face to the target, meets a surface, or air in the CT."""
    rows, along = feet.left, np.linspace(-width_mm / 2.0, width_mm / 2.0, RAYS)
    faces = feet.T_ct_image[rows, None, :3, 3] + along[:, None] * feet.T_ct_image[rows, None, :3, 0]
    apart = (faces - feet.target_ct).reshape(-1, 3)
    far = np.linalg.norm(apart, axis=1)
    rays, farthest = apart / far[:, None], float(far.max(initial=0.0))
    for why, meshes in surfaces.items():
        for mesh in meshes:
            depth = first_crossing(mesh, feet.target_ct, rays, farthest)
            feet.rule_out(rows[((depth > 0.0) & (depth <= far)).reshape(-1, RAYS).any(axis=1)], why)
    if scan is not None and len(rows):
        ends = np.fmin(far, first_crossing(feet.skin.mesh, feet.target_ct, rays, farthest + RIM_MM)) - RIM_MM
        air = np.zeros(len(rays), np.bool_)
        for mm in np.arange(0.0, float(ends.max(initial=0.0)), AIR_STEP_MM):
            open_ = np.flatnonzero(~air & (mm <= ends))
            air[open_] = scan.hu_at(feet.target_ct + mm * rays[open_]) < AIR_HU  # NaN beyond the image is none
        feet.rule_out(rows[air.reshape(-1, RAYS).any(axis=1)], Ruled.AIR)


def _mounts(context: CaseContext, plan: Plan | Watched) -> Iterator[Floats]:
    """T_base_ct of the assumed places of the second arm: the needle's, turned about the target; the other side first.

    None is in an obstacle, in the patient's table or next to the needle's base.
    """
    T_ct_bed, T_ct_base = bed_frame(context.case), inverse(plan.T_base_ct)
    for axis, turns in ((T_ct_bed[:3, 2], ABOUT_UP), (T_ct_bed[:3, 0], ABOUT_BED)):
        for turn in turns:
            R = exp_rotation(np.radians(turn) * axis)
            T = pose(R, plan.target_ct - R @ plan.target_ct) @ T_ct_base
            near = np.linalg.norm(T[:3, 3] - T_ct_base[:3, 3]) < BASES_APART_MM
            if not near and not any(contains(one.mesh, T[:3, 3]) for one in context.anatomy.surroundings):
                yield inverse(T)


def probe_mount() -> Floats:
    """T_flange_image, shape (4, 4), mm: the face at the end of the flange's z axis, which is the depth."""
    return pose(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), [0.0, 0.0, LENGTH_MM])


@dataclass(frozen=True, eq=False)
class _ProbeArm:
    """The arm that holds the probe, beside the needle's at states (k, 6), rad, of an insertion."""

    model: UrModel
    T_base_ct: Floats
    checker: CellChecker
    between: BetweenArms
    around: FclSkin | None
    q_needle: Floats

    def place(self, feet: Footprints, rows: Ints) -> tuple[int, Floats] | None:
        """The first of some footprints that the arm reaches and nothing is touched at, and its joints (6,), rad."""
        T_base_flange = self.T_base_ct @ feet.T_ct_image[rows] @ inverse(probe_mount())
        q = nearest_within_limits(self.model, branches(self.model, T_base_flange), np.zeros(6))
        reached = away_from_singularities(self.model, q)
        for row, solutions, good in zip(rows, q, reached, strict=True):
            feet.rule_out(row, Ruled.OUT_OF_REACH)
            for joints in solutions[good]:
                why = self._contact(joints)
                if why is None:
                    feet.ruled[row] = -1
                    return int(row), joints
                feet.rule_out(row, why)
        return None

    def _contact(self, q: Floats) -> Ruled | None:
        """What the arm with the probe touches at joints (6,), rad; the face alone may press on the skin."""
        if self.checker.contact(q, needle_may_touch_patient=True) or self.between.head_touches_own_arm(q):
            return Ruled.PROBE_ARM
        head = self.between.probe_bodies[-1]
        if self.around is not None and self.around.touches(head.full.surface, head.box):
            return Ruled.PROBE_ARM
        return None if all(self.between.apart(q, one) for one in self.q_needle) else Ruled.ARMS


def _arm(context: CaseContext, plan: Plan | Watched, probe: Ultrasound, T_base_ct: Floats) -> _ProbeArm | None:
    """The probe's arm at a place; None where the case leaves the place open and its base would be in the patient."""
    anatomy, needle = context.anatomy, context.require_arm().checker
    tool = handle_tool(LENGTH_MM - HEAD_MM[1], HANDLE_MM)
    T_base_needle = T_base_ct @ inverse(plan.T_base_ct)
    boxes = [
        replace(one, T_base_box=T_base_needle @ one.T_base_box) for one in case_boxes(context.case, plan.T_base_ct)
    ]
    surfaces = anatomy.skin.mesh, outside_surface(anatomy)
    skin, outside = (None if one is None else one.transformed(T_base_ct) for one in surfaces)
    try:
        checker = CellChecker(probe.model, tool, boxes, skin, outside=outside, padding_mm=ARM_PADDING_MM)
    except InputError as error:
        if probe.T_base_ct_mount is None and error.code.startswith("base_in"):
            return None
        raise error.at(f"{context.case.path}: ultrasound.mount") from error
    size = np.array([probe.width_mm + HEAD_MM[0], *HEAD_MM[1:]])
    head = head_body(probe_mount() @ pose(np.eye(3), [0.0, -HEAD_MM[1] / 2.0, 0.0]), size, CLEARANCE_MM)
    between = BetweenArms((probe.model, needle.model), (tool, needle.tool), head, T_base_needle, CLEARANCE_MM)
    around = [one.mesh for one in anatomy.surroundings]
    solids = FclSkin(joined(around).transformed(T_base_ct), "surroundings") if around else None
    states = plan.insertion.q[needle.swept.rows_within(plan.insertion.q, CLEARANCE_MM)]
    return _ProbeArm(probe.model, T_base_ct, checker, between, solids, states)
