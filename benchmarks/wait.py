"""How long a person waits, and for what: ``python -m benchmarks.wait``; beside an older state: ``--against CHECKOUT``.

Every command runs in a new process, in two states: with an empty cache folder (cold), and with everything there (warm,
the median of ``--times``); with ``--first-use`` also with nothing compiled. What is printed is processor time, which
other work on the machine changes less than the clock; `benchmarks.wait_probe` divides it. The last row is the clock's:
what a person waits, where nothing else runs. The probe itself takes 0.1 to 0.2 s: ``--bare`` leaves it out and prints
the last rows alone; ``--one-core`` lets a command use one core only. Two checkouts take turns. The real CT (61
structures, 1 degree, with the arm) is left out where it is not on this machine.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = REPOSITORY.parent / "shared" / "data" / "totalseg_abdomen_3mm"
PROBE = Path(__file__).with_name("wait_probe.py")
BARE = """import sys; sys.path.insert(0, sys.argv.pop(1))
import puncture_twin.run_twin as run
getattr(run, "program", lambda: sys.exit(run.main()))()"""
"""For Python: a checkout's command, as a person runs it; older ones have no ``program``."""
Seconds = dict[str, float]
END, ALL, CLOCK = "Python's end", "all", "by the clock"
"""The last rows: processor seconds after the answer was there and of everything, and seconds of the clock."""


@dataclass(frozen=True)
class Command:
    """One command line, under the name that the table has for it."""

    name: str
    words: tuple[str, ...]


def commands(folder: Path) -> Iterator[Command]:
    """What is waited for; paths of cases and outputs lie in the folder."""
    abdomen, out = str(folder / "abdomen"), str(folder / "out")
    yield Command("help", ("--help",))
    yield Command("check", ("check", abdomen, "--theta", "30", "--beta", "100", "--json"))
    yield Command("search", ("search", abdomen, "--no-pictures", "--json", "--out", out))
    if DATA.is_dir():
        case = str(real_case(folder))
        yield Command("real", ("search", case, "--no-pictures", "--json", "--out", out))
        yield Command("pictures", ("search", case, "--json", "--out", out))
    yield Command("demo", ("demo", "--json", "--out", out))


def real_case(folder: Path) -> Path:
    """The real CT at 1 degree, with its data beside it; no arms beside the trunk, so that the robot reaches it."""
    for file in (REPOSITORY / "tests" / "real").iterdir():
        shutil.copy(file, folder)
    for file in DATA.glob("*.nii.gz"):
        (folder / file.name).symlink_to(file)
    case = folder / "case_v2.toml"
    text = case.read_text().replace("step_deg = 2.0", "step_deg = 1.0")
    case.write_text(text.replace("[end]", '[ct]\narms = "none"\n\n[end]'))
    return case


@dataclass(frozen=True)
class Side:
    """One checkout, with a folder of its own for what it keeps, and for what it compiles if ``alone``.

    ``bare`` runs commands without the probe.
    """

    name: str
    checkout: Path
    folder: Path
    alone: bool
    bare: bool

    def run(self, command: Command) -> Seconds:
        """Seconds of one run in a new process, by what was waited for."""
        answer = self.folder / "answer.json"
        begin = ["-c", BARE, str(self.checkout)] if self.bare else [str(PROBE), str(self.checkout), str(answer)]
        start, before = perf_counter(), _used_by_others()
        words, environment = [sys.executable, *begin, *command.words], self._environment()
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
        passed, used = perf_counter() - start, _used_by_others() - before
        bare: dict[str, Any] = {"exit_code": done.returncode, "seconds": {ALL: used}}
        if not self.bare and done.returncode:
            raise SystemExit(done.stderr)
        found = bare if self.bare else json.loads(answer.read_text())
        if found["exit_code"] > 1 or "Traceback" in done.stderr:
            raise SystemExit(f"{self.name}: {command.name} ended with {found['exit_code']}\n{done.stderr}")
        return {**found["seconds"], END: used - found["seconds"][ALL], ALL: used, CLOCK: passed}

    def forget(self, *, compiled: bool) -> None:
        """Empty the cache folder, and that of compiled kernels too."""
        for name in ("kept", *(["kernels"] if compiled else [])):
            shutil.rmtree(self.folder / name, ignore_errors=True)

    def _environment(self) -> dict[str, str]:
        unset = ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE")
        environment = {key: value for key, value in os.environ.items() if key not in unset}
        kernels = {"NUMBA_CACHE_DIR": str(self.folder / "kernels")} if self.alone else {}
        return {**environment, "PUNCTURE_TWIN_CACHE": str(self.folder / "kept"), **kernels}


def _used_by_others() -> float:
    """Processor seconds of the processes that this one began and that ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def measured(command: Command, sides: list[Side], times: int, *, first_use: bool) -> dict[str, Seconds]:
    """Seconds by checkout and state."""
    found: dict[str, Seconds] = {}
    for side in sides:
        side.run(Command("help", ("--help",)))  # Python compiles its modules once
        if first_use:
            side.forget(compiled=True)
            found[f"{side.name} first use"] = side.run(command)
        else:
            side.run(command)
        side.forget(compiled=False)
        found[f"{side.name} cold"] = side.run(command)
    runs: dict[str, list[Seconds]] = {side.name: [] for side in sides}
    for _ in range(times):
        for side in sides:
            runs[side.name].append(side.run(command))
    for name, some in runs.items():
        stages = dict.fromkeys(stage for run in some for stage in run)
        found[f"{name} warm"] = {stage: median(run.get(stage, 0.0) for run in some) for stage in stages}
    return found


def print_table(command: Command, found: Mapping[str, Seconds]) -> None:
    """One row a stage, one column a checkout and state."""
    print(f"\n{command.name}: `{' '.join(Path(word).name for word in command.words)}`\n")
    print(f"| processor, s | {' | '.join(found)} |\n|{'---|' * (1 + len(found))}")
    stages = dict.fromkeys(stage for seconds in found.values() for stage in seconds if stage not in (ALL, CLOCK))
    for stage in (*stages, ALL, CLOCK):
        values = [seconds.get(stage, 0.0) for seconds in found.values()]
        if stage in (ALL, CLOCK) or max(values) >= 0.005:
            print(f"| {stage} | {' | '.join(f'{value:.2f}' for value in values)} |", flush=True)


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, help="another checkout, run in turn with this one")
    parser.add_argument("--only", help="some of help,check,search,real,pictures,demo")
    parser.add_argument("--times", type=int, default=3, help="warm runs")
    parser.add_argument("--first-use", action="store_true", help="with nothing compiled too: minutes")
    parser.add_argument("--bare", action="store_true", help="without the probe: as a person runs them")
    parser.add_argument("--one-core", action="store_true", help="on one core")
    chosen = parser.parse_args()
    if chosen.one_core:
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        shutil.copytree(REPOSITORY / "meshes" / "abdomen", folder / "abdomen")
        how = chosen.first_use, chosen.bare
        sides = [Side("this", REPOSITORY, folder / "this", *how)]
        if chosen.against is not None:
            sides.insert(0, Side("before", chosen.against.resolve(), folder / "before", *how))
        for side in sides:
            side.folder.mkdir()
        only = None if chosen.only is None else set(chosen.only.split(","))
        cores = len(os.sched_getaffinity(0))
        print(f"load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors, {cores} used")
        for command in commands(folder):
            if only is None or command.name in only:
                print_table(command, measured(command, sides, chosen.times, first_use=chosen.first_use))


if __name__ == "__main__":
    main()
