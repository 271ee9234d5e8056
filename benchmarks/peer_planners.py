"""Two planners of others on problems of :mod:`benchmarks.approach_peers`, which starts this file with their Python.

    PYTHON benchmarks/peer_planners.py mplib|pybullet-planning TASK.json ANSWER.json

It stands alone, since they ask for an older numpy than the project: nothing of the project is imported here. Lengths
become metres, which both expect.
"""

# mypy: ignore-errors
# the peers are not installed where types are checked

import contextlib
import json
import os
import random
import sys
import tempfile
from itertools import combinations
from pathlib import Path
from time import process_time

import numpy as np

LINKS = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


def written(task):
    """The arm as a URDF with its convex pieces beside it; where the file is."""
    folder, parts = Path(tempfile.mkdtemp()), ['<robot name="arm">']
    for number, link in enumerate(LINKS):
        shapes = ""
        for row, piece in enumerate(task["pieces"][link]):
            lines = [f"v {x / 1e3} {y / 1e3} {z / 1e3}" for x, y, z in piece["corners"]]
            lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in piece["faces"]]
            (folder / f"{link}_{row}.obj").write_text("\n".join(lines))
            (folder / f"{link}_{row}.obj.convex.stl").write_text(stl(piece))  # where mplib looks for it
            mesh = f'<mesh filename="{link}_{row}.obj"/>'
            shapes += f"<collision><geometry>{mesh}</geometry></collision>"
        mass = '<mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
        parts.append(f'<link name="{link}"><inertial>{mass}</inertial>{shapes}</link>')
        if number:
            x, y, z, roll, pitch, yaw = task["origins"][number - 1]
            low, high = task["limits"][number - 1]
            parts.append(
                f'<joint name="joint_{number}" type="revolute"><parent link="{LINKS[number - 1]}"/>'
                f'<child link="{link}"/><axis xyz="0 0 1"/>'
                f'<origin xyz="{x / 1e3} {y / 1e3} {z / 1e3}" rpy="{roll} {pitch} {yaw}"/>'
                f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/></joint>'
            )
    (folder / "arm.urdf").write_text("".join([*parts, "</robot>"]))
    return folder / "arm.urdf"


def stl(piece):
    """A piece as text, m."""
    rows = np.array(piece["corners"])[np.array(piece["faces"])] / 1e3
    corners = ["\n".join(f"vertex {x!r} {y!r} {z!r}" for x, y, z in row.tolist()) for row in rows]
    facets = "\n".join(f"facet normal 0 0 0\nouter loop\n{row}\nendloop\nendfacet" for row in corners)
    return f"solid piece\n{facets}\nendsolid piece\n"


def with_mplib(task):
    """RRT-Connect of OMPL and FCL, in C++."""
    import mplib
    from mplib.collision_detection import fcl
    from mplib.planning.ompl import OMPLPlanner

    def solid(shapes, name):
        placed = [fcl.CollisionObject(shape) for shape in shapes]
        return fcl.FCLObject(name, mplib.Pose(), placed, [mplib.Pose()] * len(placed))

    arm, never = (
        written(task),
        "".join(f'<disable_collisions link1="{a}" link2="{b}" reason="Adjacent"/>' for a, b in task["never"]),
    )
    arm.with_suffix(".srdf").write_text(f'<robot name="arm">{never}</robot>')
    model = mplib.ArticulatedModel(str(arm), str(arm.with_suffix(".srdf")), convex=True)
    model.set_move_group(LINKS[-1])
    room = []
    for number, box in enumerate(task["boxes"]):
        T = np.array(box["T"])
        T[:3, 3] /= 1e3
        shape = fcl.CollisionObject(fcl.Box(np.array(box["size_mm"]) / 1e3))
        room.append(fcl.FCLObject(f"box_{number}", mplib.Pose(T), [shape], [mplib.Pose()]))
    if task["skin"]:
        tree = fcl.BVHModel()
        tree.begin_model(len(task["skin"]["faces"]), len(task["skin"]["corners"]))
        tree.add_sub_model(
            list(np.array(task["skin"]["corners"]) / 1e3), list(np.array(task["skin"]["faces"], np.int32))
        )
        tree.end_model()
        room.append(solid([tree], "skin"))
    world = mplib.PlanningWorld([model], room)
    for thing in room:  # the base is bolted to what it stands on: it is asked about nowhere
        world.get_allowed_collision_matrix().set_entry("base", thing.name, True)
    planner = OMPLPlanner(world)

    def plan(home, goals, seed):
        mplib.set_global_seed(seed)
        status, path = planner.plan(home, goals, time=task["seconds"], range=task["range_rad"], simplify=True)
        return path if status.startswith("Exact solution") else None

    def free(q):
        model.set_qpos(q, True)
        return not world.check_collision()

    return plan, free


def with_pybullet_planning(task):
    """RRT-Connect in Python over PyBullet's distances; one goal, no skin."""
    import pybullet
    import pybullet_planning as pp

    with contextlib.redirect_stdout(sys.stderr):
        pp.connect(use_gui=False)
        body = pybullet.loadURDF(str(written(task)), useFixedBase=True)
        joints, obstacles = pp.get_movable_joints(body), []
        for box in task["boxes"]:
            made = pp.create_box(*(np.array(box["size_mm"]) / 1e3), mass=0)
            T = np.array(box["T"])
            T[:3, 3] /= 1e3
            pp.set_pose(made, pp.pose_from_tform(T))
            obstacles.append(made)
    links = {name: pp.link_from_name(body, name) for name in LINKS}
    never = {frozenset((links[a], links[b])) for a, b in task["never"]}
    pairs = [pair for pair in combinations(links.values(), 2) if frozenset(pair) not in never]
    moving = [link for name, link in links.items() if name != "base"]

    def collides(q, **_):
        pp.set_joint_positions(body, joints, q)
        if any(pybullet.getClosestPoints(body, thing, 0.0, linkIndexA=link) for link in moving for thing in obstacles):
            return True
        return any(pybullet.getClosestPoints(body, body, 0.0, linkIndexA=a, linkIndexB=b) for a, b in pairs)

    extend = pp.get_extend_fn(body, joints, resolutions=np.full(6, 0.05))
    sample, distance = pp.get_sample_fn(body, joints), pp.get_distance_fn(body, joints)

    def plan(home, goals, seed):
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002  # the generator that it draws from
        limit = {"max_time": task["seconds"], "max_iterations": task["iterations"], "smooth": 50}
        with contextlib.redirect_stdout(sys.stderr):
            return pp.birrt(home, goals[0], distance, sample, extend, collides, **limit)

    return plan, lambda q: not collides(q)


PEERS = {"mplib": with_mplib, "pybullet-planning": with_pybullet_planning}


def main():
    """Every problem of a task, timed."""
    name, task_file, answer_file = sys.argv[1:]
    task = json.loads(Path(task_file).read_text())
    plan, free = PEERS[name](task)
    agree = [free(np.array(q)) for q in task["states"]]
    found = []
    for number, (home, goals) in enumerate([task["problems"][0], *task["problems"]]):  # the first one once more: warm
        begin = process_time()
        path = plan(np.array(home), [np.array(goal) for goal in goals], 1 + number)
        seconds = process_time() - begin
        found.append({"s": seconds, "path": None if path is None else np.array(path).tolist()})
    Path(answer_file).write_text(json.dumps({"free": agree, "found": found[1:]}))
    os._exit(0)


if __name__ == "__main__":
    main()
