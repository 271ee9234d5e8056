"""The first command on a new machine: half of its kernels are compiled by a second process beside it.

A kernel is compiled when it is first called, on one thread, and that is most of what a first command takes. A command
needs the organs' kernels first and those of arm, chances, planner and pictures later: these a second process compiles
meanwhile, by using each once on a small workcell, and the command then loads them from their files. Two that compile
the same at once lose time, not more: files are written whole, and what does not fit is compiled anew.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from puncture_twin.twin.jobs.collector import LATER_EVERY


@contextmanager
def compiling_beside() -> Iterator[None]:
    """While the block runs, compile in a second process, where nothing is compiled yet and a core is free for it."""
    from puncture_twin.planning.base.cache.kernel_cache import is_compiled
    from puncture_twin.planning.base.processes import worker_count
    from puncture_twin.planning.collision.kernels.settled import first_not_clear

    if is_compiled(first_not_clear) or worker_count(2, 2) == 1:
        yield
        return
    other = _begin()
    try:
        yield
    finally:
        other.terminate()
        other.wait()


def _begin() -> subprocess.Popen[bytes]:
    """A process that Ctrl-C at the terminal does not reach: whoever began it ends it."""
    words = [sys.executable, "-c", f"from {__name__} import {use_once.__name__}; {use_once.__name__}()"]
    places = {"PYTHONPATH": os.pathsep.join(place for place in sys.path if place)}
    nowhere = subprocess.DEVNULL
    return subprocess.Popen(
        words, env={**os.environ, **places}, stdin=nowhere, stdout=nowhere, stderr=nowhere, start_new_session=True
    )


def use_once() -> None:
    """Use what a first command needs last, in the order in which it will: arm, chances, planner, pictures."""
    import numpy as np

    from puncture_twin.planning.motion.approach import plan_approach
    from puncture_twin.planning.reach.reach import ask_arm, small_workcell

    gc.set_threshold(LATER_EVERY)
    checker = small_workcell()
    reached = [answer for answer in ask_arm(checker) if answer.reachable]
    _err_once()
    plan_approach(checker, np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0]), reached[0].insertion_q[0], seed=0)
    draw_once()


def _err_once() -> None:
    """A needle that may lie off, into a body and beside it: the chances to hit and to touch."""
    import numpy as np

    from puncture_twin.planning.base.arrays import read_only
    from puncture_twin.planning.clearance.fast_engine import near_faces
    from puncture_twin.planning.clearance.kernels.blocks import pack
    from puncture_twin.planning.reach.reach import TARGET, octahedron
    from puncture_twin.planning.uncertainty.hit import hit_in_mesh, target_rays
    from puncture_twin.planning.uncertainty.lines import line_chance, needle_doubt

    target, up, cov = read_only(TARGET), np.array([0.0, 0.0, 1.0]), np.diag([1.0, 1.0, 1.0, 1e-4, 1e-4, 1e-4])
    hit_in_mesh(target_rays(octahedron(target, 5.0), target), cov[None, :3, :3])
    doubt, length, threshold = needle_doubt(target, up, cov, 0.5), 100.0, 1.0
    beside = pack(octahedron(target + [23.0, 0.0, 40.0], 20.0))
    near = near_faces(beside, target, up, length, doubt.reach(length, threshold))
    line_chance(near, doubt, length, threshold, np.array([-1.0, 0.0, 0.0, 0.0, -40.0, 0.0]))


def draw_once() -> None:
    """A body in another that is see-through, and one that moves; a map."""
    import numpy as np

    from puncture_twin.planning.reach.reach import TARGET, octahedron
    from puncture_twin.twin.report.map_view import MapCells, MapView
    from puncture_twin.twin.report.raster.camera import ViewCamera
    from puncture_twin.twin.report.raster.render import Layer, MovingPicture, Surface

    body, shell = (octahedron(TARGET, radius_mm) for radius_mm in (40.0, 80.0))
    opaque, glass = Layer([Surface(body, (200, 130, 100))]), Layer([Surface(shell, (230, 200, 180), alpha=0.3)])
    camera = ViewCamera(TARGET + [300.0, 0.0, 0.0], TARGET, np.array([0.0, 0.0, 1.0]), fov=0.6, width=64, height=48)
    MovingPicture(opaque, glass, [Layer([Surface(body, (50, 100, 200))])], camera).at([np.eye(4)])
    opaque.sees(camera.eye, TARGET[None])
    cells = MapCells(np.arange(1), np.zeros(1), np.array([0, 1]), np.zeros(1), 0.5, np.full(1, np.pi))
    cells.picture(MapView(turn=0.0, theta_max=1.0, rim=(), centre=""), size=8)
