"""A navigation program's side of `run-twin live`, by OpenIGTLink (pip install pyigtl): map of a target, verdict.

It starts the planner itself; where one is running already, state its port.
python examples/09_ask_a_live_planner.py [PORT]
"""

import json
import subprocess
import sys

import numpy as np
import pyigtl

from puncture_twin.meshes import folder

SERVE = [sys.executable, "-m", "puncture_twin.run_twin", "live", str(folder() / "abdomen"), "--port", "0"]


def ask(client, message, *answers):
    """Send a message; its answers by name."""
    client.send_message(message)
    return {name: client.wait_for_message(name, timeout=30) for name in answers}


if __name__ == "__main__":
    planner, port = None, int(sys.argv[1]) if len(sys.argv) > 1 else 0
    if not port:
        planner = subprocess.Popen(SERVE, stderr=subprocess.PIPE, text=True)
        port = next(int(line.split("port ")[1].split(";")[0]) for line in planner.stderr if "Ctrl-C ends" in line)
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)

    target = np.array([90.0, 10.0, 62.0])  # RAS, mm, as everything here
    found = ask(client, pyigtl.PointMessage([target], device_name="Target"), "SafeGrid", "SafeMapInfo")
    grid, info = found["SafeGrid"].image[0], json.loads(found["SafeMapInfo"].string)
    print(f"{(grid == 0).sum()} of {grid.size} directions keep every margin; not tested: {info['not_tested']}")

    axis = np.array([-0.118, -0.990, -0.074]) / np.linalg.norm([-0.118, -0.990, -0.074])  # z, from hub to tip
    aside = np.cross(axis, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(axis, [0.0, 0.0, 1.0]))
    needle = np.eye(4)
    needle[:3] = np.column_stack([aside, np.cross(axis, aside), axis, target - 120.0 * axis])
    found = ask(client, pyigtl.TransformMessage(needle, device_name="Needle"), "Verdict")
    said = json.loads(found["Verdict"].string)
    print(
        f"{said['verdict']}: {said['text']}; joints {np.round(said['joints_deg'], 1)}, slack {said['slack_mm']:.1f} mm"
    )
    client.stop()
    if planner is not None:
        planner.terminate()
