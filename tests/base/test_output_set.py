"""An output folder is one set: what a command writes comes in whole, what it outdates goes, and readers can tell."""

import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest
from refusals import refused

from puncture_twin.planning.base.errors import InputError, NoAnswerError
from puncture_twin.planning.base.output.manifest import (
    MANIFEST_NAME,
    TIMINGS_NAME,
    problems,
    read_manifest,
    read_output,
)
from puncture_twin.planning.base.output.output_set import locked, withdraw, writing
from puncture_twin.planning.base.provenance import Input

INPUTS = (Input("case", "case.toml", "ab"),)
OURS = {MANIFEST_NAME, TIMINGS_NAME}


def write(out, command, files, **options):
    with writing(out, command, inputs=INPUTS, **options) as draft:
        for name, content in files.items():
            path = draft.folder / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(content)
    return draft


def read(path):
    return read_output(path, max_bytes=1000)


def names(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def digest(text):
    return hashlib.sha256(text.encode()).hexdigest()


def contents(folder):
    return {name: (folder / name).read_bytes() for name in names(folder)}


@pytest.fixture
def planned(tmp_path):
    write(tmp_path, "plan", {"candidates.parquet": "c", "plan.json": "p", "map.png": "m"})
    for command, name in (("export plan.csv", "plan.csv"), ("rehearse", "rehearsal.json")):
        write(tmp_path, command, {name: "x"}, made_from={"plan.json": digest("p")})
    return tmp_path


def test_a_manifest_lists_every_file(planned):
    """An entry a command, with version, inputs, what it depends on, and each file's hash; nothing else lies there."""
    entries = json.loads((planned / MANIFEST_NAME).read_text())["entries"]
    assert list(entries) == ["export plan.csv", "plan", "rehearse"]
    assert entries["plan"]["files"]["map.png"] == digest("m")
    assert entries["plan"]["inputs"] == [{"role": "case", "path": "case.toml", "sha256": "ab"}]
    assert entries["rehearse"]["depends_on"] == ["plan"]
    assert problems(planned) == ()
    assert names(planned) == {"candidates.parquet", "plan.json", "map.png", "plan.csv", "rehearsal.json"} | OURS
    assert set(json.loads((planned / TIMINGS_NAME).read_text())) == set(entries)


def test_what_a_command_outdates_goes(planned):
    """A search replaces the plan's table, so the plan goes, and with it what was made from the plan."""
    said = []
    write(planned, "search", {"candidates.parquet": "new"}, note=said.append)
    assert names(planned) == {"candidates.parquet"} | OURS
    assert problems(planned) == ()
    assert len(said) == 1 and "export plan.csv, plan, rehearse were removed" in said[0]


def test_a_smaller_set_leaves_nothing_of_the_larger(tmp_path):
    """The same command without pictures: the old pictures go, and one line names them."""
    said = []
    write(tmp_path, "search", {"candidates.parquet": "1", "report.html": "72 safe", "map.png": "m"})
    write(tmp_path, "search", {"candidates.parquet": "0"}, note=said.append)
    assert names(tmp_path) == {"candidates.parquet"} | OURS
    assert said == [f"{tmp_path}: map.png, report.html of an earlier run removed: not part of this search"]


def test_commands_that_have_nothing_to_do_with_each_other_share_a_folder(planned):
    """A servo beside a plan: both entries stay whole; sub-folders work, and go when they are empty."""
    write(planned, "servo", {"servo.html": "s", "0001/a.parquet": "a"})
    assert problems(planned) == () and read(planned / "plan.json").note == ""
    write(planned, "servo", {"servo.html": "t"})
    assert problems(planned) == () and not (planned / "0001").exists()


def test_own_files_are_never_touched(planned):
    """Somebody's notes stay, whatever runs; a file of a name that is to be written is refused, before any work."""
    (planned / "notes.txt").write_text("mine")
    (planned / "report.html").write_text("mine too")
    write(planned, "plan", {"candidates.parquet": "c", "plan.json": "q"})
    assert (planned / "notes.txt").read_text() == "mine"
    with refused("foreign_file", "report.html"):
        write(planned, "plan", {}, names=("report.html",))
    with refused("foreign_file", "report.html"):
        write(planned, "plan", {"plan.json": "r", "report.html": "ours"})
    assert (planned / "report.html").read_text() == "mine too"
    assert read(planned / "plan.json").data == b"q"


@pytest.mark.parametrize("kind", ["file", "link"])
def test_a_sub_folder_that_is_somebody_elses_is_refused(tmp_path, kind):
    """A file where a sub-folder must be, or a link that leads out: refused before any work, and the old set stays."""
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    elsewhere.mkdir()
    write(out, "batch", {"batch.csv": "old"})
    (out / "0001").write_text("mine") if kind == "file" else (out / "0001").symlink_to(elsewhere)
    for known in ((), ("0001/a.parquet",)):
        with refused("foreign_file", "0001/a.parquet", "0001"):
            write(out, "batch", {} if known else {"batch.csv": "new", "0001/a.parquet": "a"}, names=known)
    assert problems(out) == () and read(out / "batch.csv").data == b"old"
    assert list(elsewhere.iterdir()) == []


def test_another_manifest_is_not_overwritten(tmp_path):
    for content, code in (
        ('{"version": 1, "files": []}', "not_an_output_folder"),
        ("", "file_size"),
        ("{", "not_json"),
        ('{"format": "puncture-twin output set"}', "missing_key"),
    ):
        (tmp_path / MANIFEST_NAME).write_text(content)
        with refused(code, MANIFEST_NAME):
            write(tmp_path, "search", {"candidates.parquet": "c"})
        assert (tmp_path / MANIFEST_NAME).read_text() == content
        assert names(tmp_path) == {MANIFEST_NAME}


def test_a_manifest_cannot_name_a_file_elsewhere(tmp_path):
    """What it lists is removed one day: a name that leads out of the folder is refused, and one that no file has."""
    out = tmp_path / "out"
    write(out, "search", {"a": "1"})
    manifest = json.loads((out / MANIFEST_NAME).read_text())
    (tmp_path / "mine.txt").write_text("mine")
    leading = ("../mine.txt", "/tmp/mine.txt", "a/../../mine.txt", "", "a//b", "./a", "..\\b")
    for name in (*leading, "a\0b", "x" * 256, "é" * 128, "a/" * 600 + "b", "\ud800"):
        manifest["entries"]["search"]["files"] = {name: digest("1")}
        (out / MANIFEST_NAME).write_text(json.dumps(manifest))
        with refused("bad_value"):
            write(out, "search", {"a": "2"})
    assert (tmp_path / "mine.txt").exists()


@pytest.mark.parametrize("also", ["plan", "unfinished"])
def test_a_manifest_that_lists_a_file_twice_is_damaged(planned, also):
    """Two entries with two hashes of one file: whichever counts, the other is no longer whole."""
    manifest = json.loads((planned / MANIFEST_NAME).read_text())
    manifest["entries"]["plan"]["files"]["plan.csv"] = digest("y")
    if also == "unfinished":
        del manifest["entries"]["plan"]["files"]["plan.csv"]
        manifest["unfinished"] = ["plan.csv"]
    (planned / MANIFEST_NAME).write_text(json.dumps(manifest))
    with refused("bad_value", "plan.csv"):
        read(planned / "plan.json")


def test_readers_refuse_what_the_manifest_does_not_list(planned, tmp_path_factory):
    """An edited file, and one that was put there: one line each; outside of any set a file is read with a warning."""
    link = tmp_path_factory.mktemp("elsewhere") / "my-plan.json"
    link.symlink_to(planned / "plan.json")
    assert read(planned / "plan.json").note == read(link).note == ""
    (planned / "plan.json").write_text("edited")
    for path in (planned / "plan.json", link):
        with refused("output_not_whole"):
            read(path)
    (planned / "other.json").write_text("p")
    with refused("output_not_whole"):
        read(planned / "other.json")
    loose = planned.parent / "loose.json"
    loose.write_text("p")
    assert "not part of an output set" in read(loose).note


def test_what_comes_from_another_plan_does_not_lie_beside_this_one(planned):
    """A rehearsal of a plan from elsewhere would pass as this folder's plan's."""
    with refused("folder_of_another", "plan.json"):
        write(planned, "rehearse", {"rehearsal.json": "y"}, made_from={"plan.json": digest("another")})
    assert problems(planned) == ()


def test_a_second_command_is_refused_while_one_writes(tmp_path):
    """One line that names the process; the first goes on and ends well."""
    with writing(tmp_path, "search") as draft:
        (draft.folder / "a").write_text("1")
        with refused("folder_in_use", os.getpid()):
            write(tmp_path, "plan", {"b": "2"})
    (tmp_path / ".puncture-twin-lock").write_text("1")  # of the dead
    with locked(tmp_path):
        pass
    assert names(tmp_path) == {"a"} | OURS


def test_whatever_ends_a_run_early_leaves_the_old_set(planned):
    before = contents(planned)
    full = [OSError(number, os.strerror(number)) for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)]
    odd = InputError("x", where="y", allowed="z", code="odd")
    for failure in (odd, KeyboardInterrupt(), NoAnswerError("no", code="odd"), *full):
        expected = refused("unwritable") if isinstance(failure, OSError) else pytest.raises(type(failure))
        with expected, writing(planned, "search") as draft:
            (draft.folder / "candidates.parquet").write_text("half")
            raise failure
        assert contents(planned) == before


def test_a_folder_that_a_run_made_for_nothing_goes_again(tmp_path):
    with pytest.raises(KeyboardInterrupt), writing(tmp_path / "a" / "b", "search"):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def interruptible():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_while_the_set_is_put_in_place_waits_for_it(planned, monkeypatch):
    """The renames take a millisecond: the interrupt comes after them, and the new set is whole."""
    replace = Path.replace

    def interrupted(self, target):
        os.kill(os.getpid(), signal.SIGINT)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(planned, "plan", {"plan.json": "q"})
    assert problems(planned) == ()
    assert names(planned) == {"plan.json"} | OURS


def test_an_answer_can_be_withdrawn(tmp_path):
    """A refused run takes its command's old answer away, keeps what may be its input, and makes no folder for it."""
    write(tmp_path, "selfcal", {"calibration.json": "c", "recording.csv": "r"})
    withdraw(tmp_path, "selfcal", keep=("recording.csv",))
    assert names(tmp_path) == {"recording.csv"} | OURS
    assert problems(tmp_path) == ()
    withdraw(tmp_path / "none", "selfcal")
    assert not (tmp_path / "none").exists()


def test_entries_split_from_a_command_go_with_it(tmp_path):
    """A rehearsal that was planned in the same run is an entry of its own, and depends on the plan."""
    with writing(tmp_path, "plan") as draft:
        for name in ("plan.json", "report.html"):
            (draft.folder / name).write_text(name)
        draft.split("rehearse", draft.folder / "report.html")
    manifest = read_manifest(tmp_path)
    assert manifest.owner("report.html") == "rehearse"
    assert manifest.entries["rehearse"].depends_on == ("plan",)


@pytest.fixture
def small_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("may not mount a file system")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_disk_that_is_really_full_is_bad_input(small_disk):
    """A real file system without space, at every fill level around what a set needs: old or new, never between."""
    out = small_disk / "out"
    write(out, "plan", {"plan.json": "p" * 50_000})
    before = contents(out)
    refused = 0
    for size in range(40_000, 240_000, 20_000):
        try:
            write(out, "plan", {"plan.json": "q" * size, "b": "b" * 10_000})
        except InputError as error:
            assert "cannot be written" in str(error)
            assert contents(out) == before
            refused += 1
        else:
            before = contents(out)
        assert problems(out) == ()
    assert refused > 0


def die_at(count):
    left = iter(range(count))
    for name in ("replace", "unlink", "rmdir"):
        plain = getattr(Path, name)

        def counted(self, *arguments, plain=plain, **options):
            if next(left, None) is None:
                os.kill(os.getpid(), signal.SIGKILL)
            return plain(self, *arguments, **options)

        setattr(Path, name, counted)


def test_a_kill_between_any_two_steps_leaves_old_new_or_unfinished(tmp_path):
    """At every single move and removal: no mix passes, and the next run leaves a whole set and no temporaries."""
    ended = set()
    for count in range(40):
        out = tmp_path / str(count)
        write(out, "plan", {"plan.json": "old", "map.png": "old", "report.html": "old"})
        write(out, "export plan.csv", {"plan.csv": "old"}, made_from={"plan.json": digest("old")})
        child = os.fork()
        if child == 0:
            die_at(count)
            write(out, "plan", {"plan.json": "new", "map.png": "new"})
            os._exit(0)
        status = os.waitpid(child, 0)[1]
        state = what_passes(out)
        assert state in ({"old"}, {"new"}, set()), f"killed at step {count}: {state}"
        ended.add(frozenset(state))
        write(out, "plan", {"plan.json": "next"})
        assert names(out) == {"plan.json"} | OURS
        assert problems(out) == ()
        assert not [path for path in out.iterdir() if path.name.startswith(".")]
        if os.WIFEXITED(status):
            break
    assert os.WIFEXITED(status), "the run has more steps than were tried"
    assert ended == {frozenset({"old"}), frozenset({"new"}), frozenset()}


def what_passes(out):
    passing = set()
    for name in ("plan.json", "map.png", "report.html", "plan.csv"):
        if (out / name).exists():
            try:
                passing.add(read(out / name).data.decode())
            except InputError:
                continue
    return passing
