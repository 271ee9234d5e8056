"""How long `run-twin live` takes from a question to its answer: median, 99 % and longest, ms.

    python -m benchmarks.live [CASE [ROUNDS]]

The planner runs in a process of its own. A client that is compiled against the OpenIGTLink library
(tests/live_client.cpp) asks from another, over loopback. Each round moves the target by 0.01 mm: nothing that is kept
can answer. "map" ends when the last byte of the mesh has come. "verdict" is that of a needle alone. "both" is that of a
needle that is known, from the moment at which a new target is sent: map first, then `check` in full. Then a needle
is streamed at 50 Hz. The last two rows are the planner's processor time for the same, in this process: what a machine
that does nothing else waits, but for the line.
"""

import json
import platform
import subprocess
import sys
import tempfile
from pathlib import Path
from time import thread_time

import numpy as np

from puncture_twin.meshes import folder
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.jobs.live.messages import POINT, Message, Stamp
from puncture_twin.twin.jobs.live.planner import Planner, Question

ROOT = Path(__file__).parents[1]


def client(out: Path) -> Path:
    """The compiled client."""
    source = ROOT / "tests" / "live_client.cpp"
    options = ["-O2", "-I/usr/include/openigtlink", str(source), "-o", str(out), "-lOpenIGTLink", "-lpthread"]
    subprocess.run(["g++", *options], check=True)
    return out


def measured(case: Path, rounds: int) -> list[list[str]]:
    """The client's lines, in words."""
    x, y, z = load_case(case).target_ct * (-1.0, -1.0, 1.0)
    serve = [sys.executable, str(ROOT / "run_twin.py"), "live", str(case), "--port", "0"]
    with (
        tempfile.TemporaryDirectory() as scratch,
        subprocess.Popen(serve, stderr=subprocess.PIPE, text=True) as planner,
    ):
        try:
            assert planner.stderr is not None
            port = next(line.split("port ")[1].split(";")[0] for line in planner.stderr if "Ctrl-C ends" in line)
            ask = [client(Path(scratch) / "client"), port, str(rounds), str(x), str(y), str(z)]
            done = subprocess.run(ask, check=True, capture_output=True, text=True)
        finally:
            planner.terminate()
    return [line.split(" ", 4) for line in done.stdout.splitlines()]


def computed(case: Path, rounds: int) -> dict[str, list[float]]:
    """Processor time of the planner's thread, ms, up to the mesh of a map, and of a verdict."""
    context = prepare(case)
    planner, stamp, target = Planner(context), Stamp(1, 0, 0, 0), context.case.target_ct * (-1.0, -1.0, 1.0)
    session, found = planner.session(), {"map cpu": list[float](), "check cpu": list[float]()}
    needle = np.array([[1, 0, 0, 0], [0, 0, -1, 150], [0, 1, 0, 0.0]])
    needle[:, 3] += target
    for number in range(rounds):
        place = POINT.pack(b"", b"", 0, 0, 0, 0, *target + [0.0, 0.0, 0.01 * number], 0.0, b"")
        questions = (
            ("map cpu", "POINT", "Target", place),
            ("check cpu", "TRANSFORM", "Needle", needle.T.astype(">f4").tobytes()),
        )
        for name, kind, device, content in questions:
            message = Message(kind, device, stamp, content)
            begun = thread_time()
            next(iter(planner.answers(Question(1, session, device.lower(), stamp, message))))
            found[name].append(1e3 * (thread_time() - begun))
    return found


def row(name: str, ms: list[float]) -> str:
    """A line of the table."""
    middle, late = np.percentile(ms, [50, 99])
    return f"{name:9s} {len(ms):5d} {middle:8.1f} {late:8.1f} {max(ms):8.1f}"


def main() -> None:
    """Print the table."""
    case = Path(sys.argv[1]) if len(sys.argv) > 1 else folder() / "abdomen"
    rounds = int(sys.argv[2]) if len(sys.argv) > 2 else 200
    lines = measured(case, rounds)
    known: dict[str, list[float]] = {"map": [], "verdict": [], "both": []}
    for one, before in zip(lines, [[""], *lines], strict=False):
        if one[0] in ("map", "verdict"):
            kind = "both" if one[0] == "verdict" and before[0] == "info" and known["verdict"] else one[0]
            known[kind].append(float(one[1]))
    info = next(json.loads(" ".join(one[1:])) for one in lines if one[0] == "info")
    print(f"{case}: {len(info['structures'])} structures, {info['directions']} directions; {platform.machine()}, ms")
    print(f"{'':9s} {'count':>5s} {'median':>8s} {'99 %':>8s} {'most':>8s}")
    for name, ms in {**known, **computed(case, rounds)}.items():
        print(row(name, ms))
    sent, answers, oldest = lines[-1][1:4]
    print(f"tracked at 50 Hz: {answers} answers to {sent} poses, the oldest {oldest} ms old when it came")


if __name__ == "__main__":
    main()
