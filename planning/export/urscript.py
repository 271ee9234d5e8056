"""A program in URScript: written, and read back. The one language here that speaks metres.

It looks before it moves: the arm must stand at the plan's start, and the controller's own kinematics must put the
needle where the plan does. It stops at the standoff, sets the tip on the planned line, and waits for the operator.
While it inserts, the controller's own `tool_contact` stops it; when the operator says so it retracts as it came.
The text is one function and nothing else, not even a comment before it: a controller runs what it gets on its socket
as soon as that is whole, and a second piece would replace the first.
"""

import re
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.export.program import STREAM_S, JointMove, Program, heading, plain_sentence
from puncture_twin.planning.geometry.rigid import exp_rotation, log_rotation, pose
from puncture_twin.planning.plan.plan import Plan

M_PER_MM = 1e-3
DIGITS = 12
"""Digits after the point: 1e-12 rad and 1e-9 mm. Never an exponent, which not every controller reads."""
START_TOLERANCE_RAD = 0.002
"""How far each joint may be from a planned one: 0.1 deg, 2 mm at a metre; a controller stops closer than that."""
KINEMATICS_TOLERANCE_RAD = 0.02
"""How far the controller's own joints for the target may be from the plan's: the calibration of one arm moves them by
some thousandths, another model of the family or another TCP by much more."""
STANDOFF_TOLERANCE_M = 0.002
"""How far the controller may say that the tip is from the standoff: its calibration against the model's lengths."""
ALIGN_M_S = 0.005
"""Tip speed of the correction by that distance."""
FIRST_WORDS = 90
"""Most characters of the first warning that the popup before the insertion shows."""
_NUMBER = r"-?\d+\.\d+"
_LIST = rf"\[{_NUMBER}(?:, {_NUMBER}){{5}}\]"
_MOVEJ = re.compile(rf"  movej\(({_LIST}), a=({_NUMBER}), v=({_NUMBER}), r=({_NUMBER})\)")
_SERVOJ = re.compile(rf"  servoj\(({_LIST}), 0, 0, {_NUMBER}, 0.1, 300\)")
_SETTLE = "  movej(standoff_q, a=0.1, v=0.05)"
_VALUE = re.compile(rf"  (start_q|standoff_q|target_q|standoff_m|target_m|tcp_m) = (p?{_LIST})")
_INSERTION = re.compile(rf"    movel\(target_m, a=({_NUMBER}), v=({_NUMBER})\)")
_RETRACTION = re.compile(rf"    movel\(standoff_m, a=({_NUMBER}), v=({_NUMBER})\)")
_RUN = "  insertion = run insert()"
_GUARD = "    if tool_contact(direction=get_target_tcp_speed()) > 0:"
_WAIT = '  popup("Needle at standoff. {warnings}Continue inserts it.", title="Insertion", blocking=True)'
_WAITS = re.compile(re.escape(_WAIT).replace(re.escape("{warnings}"), r"(?:[A-Za-z0-9 ._+:/(),-]+ )?"))

_FUNCTIONS = """\
  def far_from(wanted_q, tolerance):
    local actual_q = get_actual_joint_positions()
    local i = 0
    while i < 6:
      if norm(actual_q[i] - wanted_q[i]) > tolerance:
        return True
      end
      i = i + 1
    end
    return False
  end

  def differ_but_for_turns(first_q, second_q, tolerance):
    local i = 0
    while i < 6:
      if 2.0 * norm(sin((first_q[i] - second_q[i]) / 2.0)) > tolerance:
        return True
      end
      i = i + 1
    end
    return False
  end

  def refuse(message):
    popup(message, title="Refused", error=True, blocking=True)
    halt
  end
"""


def urscript_text(program: Program, plan: Plan, *, case_checked: bool) -> str:
    """The program as URScript: radians, metres, the controller's base frame."""
    blended = any(move.blend_mm > 0.0 for move in program.moves)
    notes = [
        "units: metres and radians; poses in the controller's base frame; TCP at the needle tip",
        "corners of the approach: " + ("rounded where they are free in the plan's case" if blended else "not rounded"),
        "not set here: payload, safety limits. While it inserts, tool_contact stops the arm, with the controller's own",
        "threshold: it does not distinguish tissues and does not protect people.",
    ]
    lines = ["def puncture():", *(f"  {line}" for line in heading(plan, notes, case_checked=case_checked))]
    lines += [
        f"  tcp_m = p{_list([0.0, 0.0, program.tcp_mm * M_PER_MM, 0.0, 0.0, 0.0])}",
        f"  start_q = {_list(program.start_q)}",
        f"  standoff_q = {_list(program.standoff_q)}",
        f"  target_q = {_list(program.target_q)}",
        f"  standoff_m = p{_list(_pose_m(program.T_base_standoff))}",
        f"  target_m = p{_list(_pose_m(program.T_base_target))}",
        "",
        *_FUNCTIONS.splitlines(),
        "",
        "  set_tcp(tcp_m)",
        f"  if far_from(start_q, {START_TOLERANCE_RAD}):",
        '    refuse("The arm is not at the start of the plan.")',
        "  end",
        f"  if differ_but_for_turns(get_inverse_kin(target_m, target_q), target_q, {KINEMATICS_TOLERANCE_RAD}):",
        '    refuse("This arm or its TCP is not the one of the plan.")',
        "  end",
        "",
    ]
    for move in program.moves:
        rates = f"a={_number(move.acceleration)}, v={_number(move.speed)}, r={_number(move.blend_mm * M_PER_MM)}"
        lines.append(f"  movej({_list(move.q)}, {rates})")
    if len(program.stream_q):
        lines += [f"  servoj({_list(q)}, 0, 0, {_number(STREAM_S)}, 0.1, 300)" for q in program.stream_q]
        lines += ["  stopj(1.4)", _SETTLE]
    return "\n".join([*lines, "", *_insertion(program, plan.warnings), "end"]) + "\n"


def _insertion(program: Program, warnings: Sequence[str]) -> list[str]:
    """The insertion in a thread that a contact ends, then the retraction along the same line, at the same speed."""
    acceleration, speed = _number(program.insertion_mm_s2 * M_PER_MM), _number(program.insertion_mm_s * M_PER_MM)
    popup = ""
    if warnings:  # how many, and how the first begins
        first = textwrap.shorten(plain_sentence(warnings[0]), FIRST_WORDS, placeholder=" ...")
        popup = f"{plural(len(warnings), 'warning')}: {first} See the program. "
    return [
        f"  if far_from(standoff_q, {START_TOLERANCE_RAD}):",
        '    refuse("The arm did not come to the standoff.")',
        "  end",
        f"  if point_dist(get_actual_tcp_pose(), standoff_m) > {STANDOFF_TOLERANCE_M}:",
        '    refuse("The controller puts the needle elsewhere than the plan.")',
        "  end",
        f"  movel(standoff_m, a={acceleration}, v={_number(ALIGN_M_S)})",
        "  held_q = get_actual_joint_positions()",
        _WAIT.format(warnings=popup),
        f"  if far_from(held_q, {START_TOLERANCE_RAD}):",
        '    refuse("The arm moved while it waited.")',
        "  end",
        "  global inserted = False",
        "  global touched = False",
        "  thread insert():",
        f"    movel(target_m, a={acceleration}, v={speed})",
        f"    stopl({acceleration})",
        "    inserted = True",
        "  end",
        "  def retract():",
        f"    movel(standoff_m, a={acceleration}, v={speed})",
        f"    stopl({acceleration})",
        "  end",
        _RUN,
        "  while not (inserted or touched):",
        _GUARD,
        "      kill insertion",
        f"      stopl({acceleration})",
        "      touched = True",
        "    end",
        "    sync()",
        "  end",
        "  if touched:",
        '    popup("Contact. Continue retracts the needle; stop leaves it.", title="Stopped", blocking=True)',
        "  else:",
        '    popup("Needle at target. Continue retracts it; stop leaves it.", title="Inserted", blocking=True)',
        "  end",
        "  retract()",
    ]


def read_urscript(text: str, *, where: Path) -> Program:
    """Read a program back, as it is written here.

    Raises InputError: a value or a move is missing or stands twice, or the insertion does not wait for the operator.
    """
    lines = text.splitlines()
    values = {match[1]: _floats(match[2]) for line in lines if (match := _VALUE.fullmatch(line))}
    moves = [match for line in lines if (match := _MOVEJ.fullmatch(line))]
    streamed = [match for line in lines if (match := _SERVOJ.fullmatch(line))]
    insertions = [(at, match) for at, line in enumerate(lines) if (match := _INSERTION.fullmatch(line))]
    others = sum(line.lstrip().startswith(("movej", "movel", "movep", "movec", "servo", "speed")) for line in lines)
    settles = lines.count(_SETTLE) if streamed else 0
    waits = [at for at, line in enumerate(lines) if _WAITS.fullmatch(line)]
    back = [match for line in lines if (match := _RETRACTION.fullmatch(line))]
    if len(values) != 6 or len(insertions) != 1 or others != len(moves) + len(streamed) + 3 + settles:
        refuse("the program does not read back", where, "known moves and one insertion", "not_read_back")
    at, insertion = insertions[0]
    if len(back) != 1 or back[0].groups() != insertion.groups() or lines.count(_RUN) != 1 or _GUARD not in lines:
        what = "the insertion is not guarded, or does not retract"
        refuse(what, where, "a guard, and a retraction at the same speed", "insertion_unguarded")
    last = max((n for n, line in enumerate(lines) if line.startswith(("  movej", "  servoj"))), default=-1)
    if len(waits) != 1 or not last < waits[0] < at:
        refuse("the insertion does not wait for the operator", where, "a wait before it", "insertion_unguarded")
    return Program(
        tcp_mm=float(values["tcp_m"][2]) / M_PER_MM,
        start_q=values["start_q"],
        moves=tuple(JointMove(_floats(m[1]), float(m[3]), float(m[2]), float(m[4]) / M_PER_MM) for m in moves),
        stream_q=np.array([_floats(match[1]) for match in streamed]).reshape(-1, 6),
        T_base_standoff=_pose_mm(values["standoff_m"]),
        T_base_target=_pose_mm(values["target_m"]),
        standoff_q=values["standoff_q"],
        target_q=values["target_q"],
        insertion_mm_s=float(insertion[2]) / M_PER_MM,
        insertion_mm_s2=float(insertion[1]) / M_PER_MM,
    )


def _number(value: float) -> str:
    text = f"{value:.{DIGITS}f}"
    return text.lstrip("-") if float(text) == 0.0 else text


def _list(values: Floats | list[float]) -> str:
    return f"[{', '.join(_number(float(value)) for value in values)}]"


def _floats(text: str) -> Floats:
    return np.array([float(value) for value in text.strip("p[]").split(",")])


def _pose_m(T: Floats) -> Floats:
    """A pose as the controller writes it: position in metres, then the rotation vector in rad."""
    return np.concatenate([T[:3, 3] * M_PER_MM, log_rotation(T[:3, :3])])


def _pose_mm(pose_m: Floats) -> Floats:
    return pose(exp_rotation(pose_m[3:]), pose_m[:3] / M_PER_MM)
