"""The command line end to end on the carton: every file, every exit code."""

import io
import json
import re
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from case_world import coarse_carton
from PIL import Image
from refusals import refused_command
from uncertainty_world import MARKERS, ball

from puncture_twin.planning.base import errors
from puncture_twin.planning.base.files import sha256
from puncture_twin.planning.base.output.manifest import problems, read_manifest
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import ANSWER_IS_NO, BAD_INPUT, OK, PROGRAM_FAILED
from puncture_twin.twin.jobs.options import prepared
from puncture_twin.twin.jobs.patient import main_job
from puncture_twin.twin.report.progress import LineDisplay, progress_display

pytestmark = pytest.mark.usefixtures("short_film")


@pytest.fixture(scope="module")
def carton(tmp_path_factory):
    """The carton with a grid of 12°."""
    return coarse_carton(tmp_path_factory.mktemp("carton") / "case")


def copied(carton, here, change=str):
    """A copy of the case, whose text is changed; its file."""
    shutil.copytree(carton.parent, here)
    (here / carton.name).write_text(change((here / carton.name).read_text()))
    return here / carton.name


@pytest.fixture(scope="module")
def rehearsed(carton, short_film, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert main(["rehearse", str(carton), "--out", str(out)]) == OK
    return out


def test_a_demo_without_the_simulator_plans(carton, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(errors, "find_spec", lambda name: None if name == "pybullet" else name)
    monkeypatch.setattr(main_job, "plan_case", lambda *asked: asked)
    with prepared(carton) as context:
        assert main_job.demo_case(context, tmp_path) == (context, tmp_path)
    assert "warning: planned, not rehearsed: demo: it needs the extra 'twin'" in capfd.readouterr().err


def test_a_rehearsal_writes_every_file(rehearsed):
    names = "candidates.parquet map.png scene.png slices.png plan.json rehearsal.json rehearsal.mp4 report.html"
    names = {*names.split(), "manifest.json", "timings.json"}
    assert {path.name for path in rehearsed.iterdir()} == names
    assert all(path.stat().st_size > 0 for path in rehearsed.iterdir())


def test_the_page_says_where_the_needle_enters_as_check_does(carton, rehearsed, run):
    plan = json.loads((rehearsed / "plan.json").read_text())
    code, told = run("check", carton, "--theta", plan["theta_deg"], "--beta", plan["beta_deg"], "--no-arm")
    words = told["entry_from"]["text"]
    assert code == OK and "from marker " in words
    assert f"<td>{words}</td>" in (rehearsed / "report.html").read_text()


def test_an_expected_error_says_of_what_it_is(carton, rehearsed, run, capfd):
    """Of the markers alone register and page say the same number; of the tip, page and plan do."""
    _, registered = run("register", carton)
    page = (rehearsed / "report.html").read_text()
    tre = registered["expected_tre_target_mm"]
    tip = json.loads((rehearsed / "plan.json").read_text())["expected_target_error_mm"]
    assert abs(tre - tip) > 0.1  # else they may be mixed up here
    assert f"expected TRE at the target (rms), from the markers alone</th><td><b>{tre:.2f} mm" in page
    assert f"expected tip error (rms), in the arm configuration of the plan</th><td>{tip:.2f} mm" in page
    assert main(["register", str(carton)]) == OK
    said = capfd.readouterr().out
    assert re.search(rf"expected TRE at the target \(rms\), from the markers alone +{tre:.2f} mm", said)
    assert re.search(r"Expected tip error of this insertion, markers and arm together: .* inserted at theta", said)


@pytest.mark.parametrize("name", ["urscript", "moveit"])
def test_an_export_carries_the_warnings_of_its_plan(carton, rehearsed, name, tmp_path, run, capfd):
    """Printed, in the answer, and in a file that is written; with the direction that it goes."""
    plan = json.loads((rehearsed / "plan.json").read_text())
    assert plan["warnings"]
    case = ["--case", str(carton)] if name == "moveit" else []
    export = ["export", str(rehearsed / "plan.json"), "--format", name, *case, "--out", str(tmp_path)]
    assert main(export) == OK
    printed = capfd.readouterr().out
    assert all(f"warning: {warning}" in printed for warning in plan["warnings"])
    assert f"direction: theta {plan['theta_deg']:g} deg, beta {plan['beta_deg']:g} deg" in printed
    written = " ".join(path.read_text(encoding="ascii") for path in tmp_path.glob("plan.*"))
    assert written.count("warning: ") == len(plan["warnings"])
    code, told = run(*export)
    assert (code, told["warnings"], told["theta_deg"]) == (OK, plan["warnings"], plan["theta_deg"])


def test_the_carton_errs_like_the_paper(rehearsed):
    """The truth is where the robot really touched the lesion: 2-3 mm off, as Chen 2019 measured (Table 3: 2.94 mm)."""
    found = json.loads((rehearsed / "rehearsal.json").read_text())
    assert found["tip_error_mm"] == pytest.approx(2.94, abs=0.2)
    assert found["tip_error_mm"] ** 2 == pytest.approx(found["lateral_mm"] ** 2 + found["depth_mm"] ** 2)
    assert {contact.split(" at ")[0] for contact in found["contacts"]} <= {"wrist_3 touches table"}
    speeds = zip(found["max_joint_speed_deg_s"], found["joint_speed_limit_deg_s"], strict=True)
    assert all(speed <= limit for speed, limit in speeds)


def test_a_written_plan_is_rehearsed_again_with_the_same_result(carton, rehearsed, run, tmp_path):
    """Checked and executed, it ends where it ended before."""
    copy = tmp_path / "copy"
    shutil.copytree(rehearsed, copy)
    code, again = run("rehearse", copy / "plan.json", "--case", carton, "--out", copy)
    assert code == OK
    before = json.loads((rehearsed / "rehearsal.json").read_text())
    assert again["rehearsal"]["tip_error_mm"] == pytest.approx(before["tip_error_mm"], abs=1e-6)
    assert {path.name for path in copy.iterdir()} == {path.name for path in rehearsed.iterdir()} - {"report.html"}
    assert problems(copy) == ()


@pytest.fixture
def no_encoder(monkeypatch):
    """Nothing that makes an MP4 of a film."""

    def absent(*arguments, **options):
        raise RuntimeError("no ffmpeg")

    monkeypatch.setattr("puncture_twin.twin.report.scene.film.imageio_ffmpeg.write_frames", absent)


@pytest.mark.usefixtures("no_encoder")
def test_of_many_rooms_the_median_is_shown(carton, rehearsed, run, tmp_path):
    """Headline, film and numbers are of the room in the middle, which the simulator confirms."""
    errors = "touch_mm = 0.2\nct_in_plane_mm = 0.3\nct_slice_mm = 0.3\n"
    case = ball(tmp_path, errors=errors, base=f"insertion_speed_mm_s = 40.0\n{MARKERS}")
    code, found = run("rehearse", case, "--seeds", 201, "--physics", 1, "--out", tmp_path / "out")
    assert code == OK
    one, rooms = found["rehearsal"], found["distribution"]
    assert one["percentile"] == pytest.approx(50, abs=2) and one["percentile_of"] == "rooms"
    assert one["tip_error_mm"] == pytest.approx(rooms["median_mm"], abs=0.05)
    assert rooms["physics"]["rooms"] == 1 and rooms["physics"]["largest_apart_mm"] < 0.05
    page = (tmp_path / "out/report.html").read_text()
    (place,) = set(re.findall(r"median of 201 trials \((\d+)(?:st|nd|rd|th) percentile", page))
    assert int(place) == round(one["percentile"])
    assert 'href="rehearsal.gif"' in page and "rehearsal.mp4" not in page
    assert 'href="rehearsal.mp4"' in (rehearsed / "report.html").read_text()
    assert {"rehearsal.gif", "report.html"} <= {path.name for path in (tmp_path / "out").iterdir()}
    assert problems(tmp_path / "out") == ()
    assert main(["rehearse", str(carton), "--physics", "1", "--out", str(tmp_path / "no")]) == BAD_INPUT


def test_a_plan_whose_marker_file_changed_is_refused(carton, rehearsed, tmp_path, capfd):
    """One touched marker moved by a hundredth: the plan is stale, and nothing is written."""
    other, out = copied(carton, tmp_path / "case"), tmp_path / "out"
    touched = other.with_name("touch.csv")
    touched.write_text(touched.read_text().replace("417.67", "417.68"))
    command = ["rehearse", rehearsed / "plan.json", "--case", other, "--out", out]
    refused_command(command, capfd, "input_changed", "touch.csv")
    assert not out.exists()


def test_a_new_search_leaves_nothing_of_an_old_one(carton, run, tmp_path, capfd):
    """Counts are the table's; pictures and page of an earlier search go with it; notes kept there by somebody stay."""
    code, found = run("search", carton, "--no-arm", "--out", tmp_path)
    verdicts = pq.read_table(tmp_path / "candidates.parquet")["verdict"].to_pylist()
    assert code == OK and (found["directions"], found["plan"]) == (len(verdicts), None)
    assert found["counts"]["safe"] == verdicts.count("safe") and (tmp_path / "report.html").is_file()
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["search", str(carton), "--no-arm", "--no-pictures", "--out", str(tmp_path)]) == OK
    went = "map.png, report.html, scene.png, slices.png of an earlier run removed: not part of this search"
    assert f"{tmp_path}: {went}" in capfd.readouterr().err
    names = {"candidates.parquet", "manifest.json", "timings.json", "notes.txt"}
    assert {path.name for path in tmp_path.iterdir()} == names and problems(tmp_path) == ()


def test_a_plan_of_a_set_is_read_only_as_it_was_written(rehearsed, tmp_path, capfd):
    """Edited beside its manifest: refused, one line. Outside of any set: read, with one line of warning."""
    copy = tmp_path / "copy"
    shutil.copytree(rehearsed, copy)
    plan = copy / "plan.json"
    assert main(["export", str(plan), "--format", "csv", "--out", str(copy)]) == OK
    assert capfd.readouterr().err == "" and problems(copy) == ()
    plan.write_text(plan.read_text().replace('"roll_deg": ', '"roll_deg": 1'))
    refused_command(
        ["export", plan, "--format", "csv", "--out", copy], capfd, "output_not_whole", "does not match its entry"
    )
    loose = tmp_path / "loose.json"
    shutil.copy(rehearsed / "plan.json", loose)
    assert main(["export", str(loose), "--format", "csv", "--out", str(tmp_path / "out")]) == OK
    said = capfd.readouterr().err
    assert "not part of an output set" in said and len(said.splitlines()) == 1


def test_an_export_lists_what_decided_it(rehearsed, tmp_path, run):
    """``--json``: the plan with its hash, then everything that the plan was made from; as in the manifest."""
    plan = rehearsed / "plan.json"
    code, told = run("export", plan, "--format", "csv", "--out", tmp_path)
    listed = told["inputs"]
    assert code == OK
    assert listed[0] == {"role": "plan", "path": "plan.json", "sha256": sha256(plan)}
    assert listed[1:] == json.loads(plan.read_text())["inputs"] != []
    assert listed == json.loads((tmp_path / "manifest.json").read_text())["entries"]["export plan.csv"]["inputs"]


def test_nothing_safe_is_exit_code_1_with_the_closest_miss(carton, tmp_path, capfd):
    """All bolts demand 80 mm: no candidate is safe, and the one that came closest is named with what it lacked."""
    other = copied(carton, tmp_path / "case", lambda text: text.replace("margin_mm = 2.0", "margin_mm = 80.0"))
    searched = ["search", str(other), "--no-arm", "--no-pictures", "--out", str(tmp_path / "out")]
    assert main(searched) == ANSWER_IS_NO
    said = capfd.readouterr().out
    assert "no candidate is safe; the closest, theta" in said and "too_close (bolt" in said
    assert main(["plan", str(other), "--out", str(tmp_path / "plan")]) == ANSWER_IS_NO
    assert "no plan: no candidate is safe" in capfd.readouterr().err
    assert "Planning failed: no candidate is safe" in (tmp_path / "plan" / "report.html").read_text(encoding="utf-8")
    assert (tmp_path / "plan" / "map.png").is_file() and not (tmp_path / "plan" / "plan.json").exists()


def test_check_draws_slices(carton, run, tmp_path):
    """Of a refused direction too, as an entry of the folder's set; what is no PNG is refused."""
    arguments = ["check", carton, "--theta", 45, "--beta", 270, "--no-arm", "--picture"]
    code, found = run(*arguments, tmp_path / "one.png")
    assert (code, found["verdict"]) == (ANSWER_IS_NO, "rejected")
    assert Image.open(tmp_path / "one.png").format == "PNG"
    assert list(read_manifest(tmp_path).entries) == ["check one.png"] and problems(tmp_path) == ()
    assert main([*map(str, arguments), str(tmp_path / "one.jpg")]) == BAD_INPUT
    assert not (tmp_path / "one.jpg").exists()


def test_check_explains_a_refusal(carton, capfd):
    """Exit code 1, the reason with structure, depth and mm, and every constraint."""
    assert main(["check", str(carton), "--theta", "45", "--beta", "270"]) == ANSWER_IS_NO
    said = capfd.readouterr().out
    assert "rejected" in said
    assert "too_close (bolt_h) at" in said
    assert ": the needle crosses it, at least 1 mm deep; 2 mm clearance is demanded" in said
    assert "-1.00 mm clearance" not in said and "too close, crossed" in said
    for line in ("skin entry", "path length", "skin angle", "standoff", "bolt_l", "arm reaches it"):
        assert line in said


def test_an_arm_that_was_switched_off_is_named(carton, run):
    """--no-arm on a case that says where the base is: the verdict is for the organs, and why is said."""
    code, found = run("check", carton, "--theta", 0, "--beta", 0, "--no-arm")
    assert (code, found["arm"]) == (OK, "not checked: switched off (--no-arm)")
    assert not any("states a robot" in warning for warning in found["warnings"])


def test_an_arm_that_is_asked_for_must_have_a_base(carton, tmp_path, capfd):
    def without(text):
        return text[: text.index("[registration]")] + text[text.index("[robot]") :]

    other = copied(carton, tmp_path / "without_base", without)
    for command in (["search"], ["check", "--theta", "0", "--beta", "0"]):
        refused_command([*command, other, "--arm"], capfd, "no_base")


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc on this system")
def test_a_folder_that_only_looks_writable_is_refused(carton, capfd):
    """Permissions say yes and the system says no: one line all the same."""
    command = ["search", carton, "--no-arm", "--no-pictures", "--out", "/proc/nowhere"]
    refused_command(command, capfd, "unwritable", "cannot be written")


def test_a_bug_is_exit_code_3(monkeypatch, capfd):
    monkeypatch.setattr("puncture_twin.twin.jobs.papers.papers.PAPERS", {"chen2019": lambda *_: 1 / 0})
    assert main(["reproduce", "chen2019"]) == PROGRAM_FAILED
    assert "ZeroDivisionError" in capfd.readouterr().err


def test_progress_in_a_log_is_a_line_now_and_then(monkeypatch):
    """No bars where nobody watches: a line with rate and remaining time, at most every few seconds."""
    stream = io.StringIO()
    clock = iter(range(0, 1000, 3))
    monkeypatch.setattr("puncture_twin.twin.report.progress.LINE_EVERY_S", 5.0)
    monkeypatch.setattr("puncture_twin.twin.report.progress.time.monotonic", lambda: float(next(clock)))
    display = progress_display(stream)
    assert isinstance(display, LineDisplay)
    with display:
        for done in range(1, 9):
            display.count("directions", done, 8)
    lines = stream.getvalue().splitlines()
    assert 1 < len(lines) <= 8
    assert lines[0] == "directions: 1/8"  # no time is behind it: a rate would be made up
    assert all("directions: " in line and "/min, " in line and "s left" in line for line in lines[1:])
