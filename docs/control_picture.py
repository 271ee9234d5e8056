"""Draw what a wall feels of each control of the tip: ``PYTHONPATH=tests python -m docs.control_picture``."""

from pathlib import Path

import matplotlib.pyplot as plt
from control_world import TIP_M, UR3, impedance, press

from puncture_twin.twin.world.control import Admittance, Motors, VirtualMass

PICTURE = Path(__file__).parent / "pictures" / "control.png"
BLUE, ORANGE, GREEN, RED, GREY = "#1f4e8c", "#b9770e", "#1e8449", "#c0392b", "#8a8a8a"
WALL_N_M = 1e5


def main():
    """Two panels: every control on a wall of 1e5 N/m, and admittance on a rigid one."""
    stiff = {K: press(lambda world, K=K: impedance(world, K, K_i=0.0), WALL_N_M) for K in (1e4, 1e3)}
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2))
    motors = press(lambda world: Motors(), WALL_N_M)
    soft, rigid = (press(lambda world: Admittance(UR3, TIP_M, VirtualMass(), 1e-3), wall) for wall in (WALL_N_M, None))
    curves = (
        (motors, RED, "position motors"),
        (stiff[1e4], BLUE, "impedance, 10 N/mm"),
        (stiff[1e3], GREEN, "impedance, 1 N/mm"),
        (soft, ORANGE, "admittance, 1 N/mm"),
    )
    for pressed, colour, name in curves:
        left.plot(pressed.times_s, pressed.force_n, color=colour, label=f"{name}: {pressed.steady_n:.1f} N")
    left.set(xlabel="s", ylabel="N on the wall", yscale="symlog", title="A wall of 100 N/mm, driven 3 mm past its face")
    left.legend(fontsize=8)
    right.plot(rigid.times_s, rigid.force_n, color=ORANGE, linewidth=0.7, label="admittance, 1 N/mm")
    right.plot(soft.times_s, soft.force_n, color=GREY, label="the same on 100 N/mm")
    right.set(xlabel="s", ylabel="N on the wall", title="A rigid wall: admittance leaves it and strikes again")
    right.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(PICTURE, dpi=100)


if __name__ == "__main__":
    main()
