"""The command line: parses, calls, prints.

Exit codes: 0 done, 1 done and the answer is no, 2 bad input, 3 the program failed, 130 interrupted, 141 not read.

A command imports what it needs itself: the help and a wrong argument answer at once.
"""

from __future__ import annotations

import os
import sys
import time
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer import Argument, Option

from puncture_twin.meshes import folder as meshes_folder
from puncture_twin.planning.base.errors import require_extra
from puncture_twin.planning.geometry.spaces import Space, Unit, Up
from puncture_twin.twin.jobs.batch.commands import batch_app
from puncture_twin.twin.jobs.exit_codes import exit_code_of, finish
from puncture_twin.twin.jobs.options import (
    ArmOption,
    CaseArgument,
    EngineOption,
    JobsOption,
    JsonOption,
    OutOfCaseOption,
    OutOption,
    PicturesOption,
    SourceArgument,
    VersionOption,
    out_folder,
    prepared,
    with_choice,
)
from puncture_twin.twin.jobs.terminal import leave, look_seldom, print_whole
from puncture_twin.twin.report.progress import progress_display

if TYPE_CHECKING:
    from puncture_twin.planning.search.choice import Choice

MOST_SEEDS = 10_000  # trials or draws of one command; each takes seconds
app = typer.Typer(no_args_is_help=False, pretty_exceptions_enable=False, rich_markup_mode=None)
"""Plain help: in boxes, a terminal of 40 columns shows names of options cut off."""
app.add_typer(batch_app, name="batch", help="Many cases: plan, run, status, merge, compare.")
calibrate_app = typer.Typer(no_args_is_help=False, pretty_exceptions_enable=False, rich_markup_mode=None)
app.add_typer(calibrate_app, name="calibrate", help="Calibrate an arm: hand-eye, dynamics.")


@app.callback(invoke_without_command=True, epilog="Terms in the output: docs/words.md.")
def _without_command(context: typer.Context, version: VersionOption = False) -> None:
    """Plan a needle puncture and rehearse it. Research software, not a medical device."""
    del version  # its callback has printed it
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command()
def demo(out_dir: OutOption = Path("out/demo"), as_json: JsonOption = False) -> None:
    """Search, plan, rehearse and report on the embedded abdomen."""
    from puncture_twin.twin.jobs.patient import main_job

    with prepared(meshes_folder() / "abdomen") as context:
        run = main_job.demo_case(context, out_dir)
    finish("demo", run, run.summary(), run.text(), as_json)


@app.command()
def schema() -> None:
    """Print the JSON Schema of case.toml. Editors use it to complete keys."""
    import json

    from puncture_twin.planning.case.case_file import case_schema

    document = case_schema()
    finish("schema", document, document, json.dumps(document, indent=1), as_json=False)


@app.command()
def init(
    folder: Annotated[Path, Argument(metavar="FOLDER", help="Folder with a CT and a segmentation.")],
    target: Annotated[str | None, Option(help="Target position X,Y,Z, mm.")] = None,
    target_label: Annotated[str | None, Option(help="Its deepest point is the target.")] = None,
    hit_radius: Annotated[
        float | None, Option(metavar="MM", help="The target is a ball of this radius, in no structure.")
    ] = None,
    space: Annotated[Space | None, Option(help="Space of the target, the case and meshes.", show_default="LPS")] = None,
    region: Annotated[str | None, Option(help="Body region; default: inferred from organs.")] = None,
    naming: Annotated[str | None, Option(help="Label names: totalsegmentator-v1, -v2, or a table.")] = None,
    unit: Annotated[Unit | None, Option(help="Unit of meshes; default: inferred from size.")] = None,
    up: Annotated[
        Up | None, Option(help="Up axis of meshes: y (rotated to z) or z; required for GLB.", show_default="z")
    ] = None,
    ct: Annotated[str | None, Option(help="CT to use if FOLDER holds several.")] = None,
    segmentation: Annotated[str | None, Option(help="Segmentation to use if FOLDER holds several.")] = None,
    trust_labels: Annotated[
        bool, Option("--trust-labels", help="Accept the structures; you have checked them on the CT.")
    ] = False,
    skin: Annotated[
        str | None, Option(metavar="NAME", help="Structure that is the skin; default: found in the CT.")
    ] = None,
    ignore: Annotated[
        list[str] | None, Option(metavar="NAME", help="Structure or file to leave out; repeatable.")
    ] = None,
    unknown: Annotated[
        list[str] | None, Option(metavar="NAME", help="Structure no path may cross; repeatable.")
    ] = None,
    settings: Annotated[
        list[str] | None, Option("--set", metavar="KEY=VALUE", help="Set a case key, such as ct.arms=none.")
    ] = None,
    force: Annotated[bool, Option("--force", help="Replace an existing case.toml.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write FOLDER/case.toml from a CT and a segmentation. Roles and margins are the default ones."""
    from puncture_twin.planning.init.finder import Wanted
    from puncture_twin.planning.init.overrides import overrides_of
    from puncture_twin.planning.init.start import Request
    from puncture_twin.twin.jobs.patient.init_job import init_case, init_text

    stated = [*(settings or []), *(["search.trust_labels=true"] if trust_labels else [])]
    overrides = overrides_of(skin, ignore or [], unknown or [], stated)
    wanted = Wanted(space or Space.LPS, naming, unit, ct, segmentation, up, overrides)
    with progress_display() as progress:
        request = Request(folder, target, target_label, region, wanted, space is not None, hit_radius)
        run = init_case(request, force=force, watcher=progress)
    for warning in run.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    finish("init", run, run.summary(), init_text(run), as_json)


@app.command()
def search(
    case: CaseArgument,
    out_dir: OutOfCaseOption = None,
    arm: ArmOption = None,
    pictures: PicturesOption = True,
    engine: EngineOption = "fast",
    check_again: Annotated[int, Option("--cross-check", min=0, help="Directions to measure again with FCL.")] = 0,
    certified: Annotated[bool, Option("--certify", help="Also certify the angles between grid points.")] = False,
    certify_size: Annotated[
        float | None, Option(min=0.05, max=10, help="Smallest cell of --certify, degrees.", show_default="0.25")
    ] = None,
    certify_touch: Annotated[
        float | None, Option(metavar="P", help="With --certify: highest chance to touch any structure.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check every entry direction of a case. Write the table, the map, the scene and the page."""
    from puncture_twin.twin.jobs.patient import main_job

    folder = out_folder(out_dir, case, "search")
    certify = main_job.certify_options(certified, certify_size, certify_touch)
    with prepared(case, arm=arm, engine=engine) as context:
        checked = context.cross_check(check_again) if check_again else None
        run = main_job.search_case(context, folder, pictures=pictures, checked=checked, certify=certify)
    finish("search", run, run.summary(), run.text(), as_json)


@app.command()
def verify(
    certificate: Annotated[Path, Argument(metavar="CERTIFICATE", help="Written by search --certify.")],
    case: Annotated[Path, Option(help="The case that it certifies.")],
    as_json: JsonOption = False,
) -> None:
    """Prove every cell of a certificate again. The plain checker shares no code with the fast one."""
    from puncture_twin.twin.jobs.patient import answers

    with prepared(case, arm=False) as context:
        report = answers.verify_certificate(certificate, context)
    finish("verify", report, report, answers.certificate_text(report), as_json)


@app.command()
@with_choice
def check(
    case: CaseArgument,
    choice: Choice,
    arm: ArmOption = None,
    picture: Annotated[Path | None, Option(metavar="FILE.png", help="Write the CT slices through the path.")] = None,
    every: Annotated[bool, Option("--all", help="List every structure, not only the nearest.")] = False,
    entries: Annotated[
        Path | None, Option(metavar="FILE", help="Check every row of a list of entries or angles.")
    ] = None,
    targets: Annotated[Path | None, Option(metavar="FILE", help="Check every row of a list of targets.")] = None,
    out_dir: Annotated[
        Path | None, Option("--out", help="Folder for the checked.csv and checked.parquet of a list.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Explain one candidate in full, or check a list. Without a choice, the best candidate is explained."""
    from puncture_twin.planning.budget.guidance import explained_ways
    from puncture_twin.planning.search.choice import explain_choice
    from puncture_twin.planning.search.explain import NEAREST
    from puncture_twin.twin.jobs.choosing.list_job import check_list, checks_list

    if checks_list(entries, targets, choice, picture=picture, out_dir=out_dir):
        with progress_display() as progress:
            listed = check_list(case, entries, targets, choice, out_dir=out_dir, arm=arm, watcher=progress)
        finish("check", listed, listed.summary(), listed.text(), as_json)
        return
    with prepared(case, arm=arm) as context:
        explained = explained_ways(context, explain_choice(context, choice))
        if picture is not None:
            from puncture_twin.twin.jobs.patient.pictures import write_check_picture

            write_check_picture(context, explained, picture)
    finish("check", explained, explained.summary(), explained.text(None if every else NEAREST), as_json)


@app.command()
def compare(
    source: SourceArgument,
    other: Annotated[Path | None, Argument(metavar="PLAN_B", help="The second plan.json, to compare.")] = None,
    case: Annotated[Path | None, Option(help="Case of the two plans: checks them again.")] = None,
    theta: Annotated[list[float] | None, Option(min=0, max=180, help="See check; repeatable.")] = None,
    beta: Annotated[list[float] | None, Option(min=0, max=360, help="See check; repeatable.")] = None,
    rank: Annotated[list[int] | None, Option(min=1, help="See check; repeatable.")] = None,
    window: Annotated[list[int] | None, Option(min=1, help="See check; repeatable.")] = None,
    entry: Annotated[list[str] | None, Option(metavar="X,Y,Z", help="See check; repeatable.")] = None,
    arm: ArmOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare two paths of a case, or two plans. One choice is compared with the best. Exit 1 if one is rejected."""
    from puncture_twin.twin.jobs.choosing.compare_job import compare_source

    stated = (theta or [], beta or [], rank or [], window or [], entry or [])
    with progress_display() as progress:
        compared = compare_source(source, other, case, stated, arm, progress)
    finish("compare", compared, compared.summary(), compared.text(), as_json)


@app.command()
@with_choice
def plan(case: CaseArgument, choice: Choice, out_dir: OutOfCaseOption = None, as_json: JsonOption = False) -> None:
    """Plan the arm's motion to the best or a chosen candidate. Searches first, and writes plan.json."""
    from puncture_twin.twin.jobs.patient import main_job

    folder = out_folder(out_dir, case, "plan")
    with prepared(case) as context:
        run = main_job.plan_case(context, folder, choice)
    finish("plan", run, run.summary(), run.text(), as_json)


@app.command()
@with_choice
def rehearse(
    source: SourceArgument,
    choice: Choice,
    case: Annotated[Path | None, Option(help="The case of a plan.json.")] = None,
    out_dir: OutOfCaseOption = None,
    seeds: Annotated[int | None, Option(min=1, max=1_000_000, help="Trials, each with its own ground truth.")] = None,
    physics: Annotated[int, Option(min=0, max=MOST_SEEDS, help="Trials run in the simulator.")] = 0,
    guidance: Annotated[
        str | None, Option(metavar="WAY", help="What leads the needle in the trials: ct, us, ...; a list compares.")
    ] = None,
    steps: Annotated[
        int | None, Option(metavar="N", help="With --guidance ct: scan and correct after each step.")
    ] = None,
    sweep: Annotated[bool, Option("--sweep", help="Rotate the needle about the target, outside.")] = False,
    to: Annotated[
        str | None, Option(metavar="THETA,BETA", help="End of the sweep.", show_default="its window's farthest")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Execute a plan in the twin; report where the tip ended. The ground truth differs from the belief."""
    require_extra("twin", "rehearse")
    from puncture_twin.planning.budget.guidance import stepped, ways_of
    from puncture_twin.twin.jobs.experiment.sweep_job import sweep_case, sweep_end, sweep_text
    from puncture_twin.twin.jobs.patient import main_job
    from puncture_twin.twin.jobs.patient.run import trial_count

    guidances = () if guidance is None else ways_of(guidance)
    stepped(",".join(guidances), steps)
    trials = trial_count(seeds, physics, guidances[0] if guidances else None, steps)
    folder = out_folder(out_dir, source, "rehearse")
    if sweep or to is not None:
        end = sweep_end(source, to, sweep=sweep, alone=trials is None and case is None)
        with prepared(source) as context:
            swept = sweep_case(context, folder, choice, end)
        finish("rehearse --sweep", swept, swept.summary(), sweep_text(swept), as_json)
        return
    with prepared(main_job.rehearsed_case(source, case, choice)) as context:
        if trials is not None and len(guidances) > 1:
            from puncture_twin.twin.jobs.patient.guidance_job import compare_guidance

            compared = compare_guidance(context, source, folder, guidances, trials.trials, choice)
            finish("rehearse --guidance A,B", compared, compared.summary(), compared.text(), as_json)
            return
        if main_job.is_plan(source):
            run = main_job.rehearse_plan(context, source, folder, trials)
        else:
            run = main_job.rehearse_case(context, folder, trials, choice)
    finish("rehearse", run, run.summary(), run.text(), as_json)


@app.command()
def markers(
    source: Annotated[Path, Argument(metavar="SOURCE", help="Folder or file with a CT, or a case with one.")],
    kind: Annotated[str | None, Option(metavar="ball|disc|ring", help="Kind of all markers.")] = None,
    diameter: Annotated[float | None, Option(metavar="MM", help="Their diameter, 1 to 15.")] = None,
    count: Annotated[int | None, Option(metavar="N", help="How many there are.")] = None,
    layout: Annotated[
        Path | None, Option(metavar="FILE", help="Names them: points of any frame, by distances.")
    ] = None,
    propose: Annotated[
        int | None, Option(metavar="N", help="Propose places for N markers on the skin of a CASE.")
    ] = None,
    out_dir: OutOfCaseOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the markers on the skin of a CT, or propose places for them. Writes their list for case and Slicer."""
    from puncture_twin.twin.jobs.patient import markers_job

    stated = markers_job.stated_markers(kind, diameter, count, layout, propose)
    folder = out_folder(out_dir, source, "markers")
    if propose is not None:
        with prepared(source) as context:
            proposed = markers_job.propose_places(context, folder, propose)
        finish("markers", proposed, proposed.summary(), proposed.text(), as_json)
        return
    with progress_display() as progress:
        run = markers_job.find_markers(source, folder, stated, layout, progress)
    finish("markers", run, run.summary(), run.text(), as_json)


@app.command()
@with_choice
def touch(
    case: CaseArgument,
    choice: Choice,
    out_dir: OutOfCaseOption = None,
    seed: Annotated[int, Option(min=0, max=2**31 - 1, help="Seed of motions and ground truth.")] = 0,
    host: Annotated[str | None, Option(help="Address of a UR that is led by hand: read only, no twin.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Plan the marker touches and execute them in the twin, or read a UR's. Writes touch.csv. Exit 1 on too few."""
    if host is not None:
        from puncture_twin.planning.case.case import load_case
        from puncture_twin.twin.jobs.live.mirror import LedArm, connect, led_text, refuse_twin_options, touch_by_hand

        refuse_twin_options(choice, seed)
        loaded, arm = load_case(case), LedArm(connect(host, "touch --host"))
        read = touch_by_hand(loaded, arm, _led_to, out_folder(out_dir, case, "touch"))
        finish("touch", read, read.summary(), led_text(read), as_json)
        return
    require_extra("twin", "touch")
    from puncture_twin.twin.jobs.experiment.touch_job import touch_case, touch_text

    folder = out_folder(out_dir, case, "touch")
    with prepared(case) as context:
        run = touch_case(context, folder, choice, seed)
    finish("touch", run, run.summary(), touch_text(run), as_json)


def _led_to(marker: str) -> bool:
    """Ask for the tip on a marker; whether a line came from standard input."""
    print(f"{marker}: lead the tip onto it, let it rest, press Enter (Ctrl-D: no more)", file=sys.stderr, flush=True)
    return sys.stdin.readline() != ""


@app.command()
def pivot(
    case: CaseArgument,
    joints: Annotated[
        Path | None,
        Argument(metavar="JOINTS.csv", help="Touches of one point: one pose per line, with q1_deg to q6_deg."),
    ] = None,
    out_dir: OutOfCaseOption = None,
    poses: Annotated[int | None, Option(help="Poses in the twin, 4 to 12.", show_default="8")] = None,
    at: Annotated[
        str | None, Option(metavar="X,Y,Z", help="Touched point, mm, base frame.", show_default="beside the patient")
    ] = None,
    seed: Annotated[
        int | None, Option(min=0, max=2**31 - 1, help="Seed of the ground truth.", show_default="0")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find the tip on the flange from touches of one point. Read, or executed in the twin. Exit 1 on contradiction."""
    from puncture_twin.planning.case.case import load_case
    from puncture_twin.twin.jobs.experiment import pivot_job

    if joints is not None:
        pivot_job.refuse_twin_options(out_dir, poses, at, seed)
        read = pivot_job.pivot_case(load_case(case), joints)
        finish("pivot", read, read.summary(), pivot_job.pivot_text(read), as_json)
        return
    require_extra("twin", "pivot")
    place, folder = pivot_job.parse_place(at), out_folder(out_dir, case, "pivot")
    with prepared(case) as context:
        run = pivot_job.pivot_tour(context, folder, 8 if poses is None else poses, place, seed or 0)
    finish("pivot", run.calibration, run.summary(), pivot_job.pivot_tour_text(run), as_json)


@app.command()
def place(
    case: CaseArgument,
    out_dir: OutOfCaseOption = None,
    quick: Annotated[
        float, Option(metavar="SECONDS", min=1, help="Stop after about this time, with the best so far.")
    ] = 30.0,
    full: Annotated[bool, Option("--full", help="Search to the end, however long it takes.")] = False,
    jobs: JobsOption = 1,
    pictures: PicturesOption = True,
    as_json: JsonOption = False,
) -> None:
    """Find the base position from which the arm reaches most organ-safe directions; write a table and a map."""
    from puncture_twin.twin.jobs.patient.place_job import place_case, place_text

    folder, began = out_folder(out_dir, case, "place"), time.perf_counter()
    with prepared(case, arm=False) as context:
        run = place_case(context, folder, jobs=jobs, pictures=pictures, quick_s=None if full else quick, began=began)
    finish("place", run, run.summary(), place_text(run), as_json)


@app.command()
def mirror(
    case: Annotated[Path, Option(help="Case of the patient.")],
    host: Annotated[str | None, Argument(metavar="HOST", help="Address of a running UR (read only).")] = None,
    recorded: Annotated[
        Path | None, Option("--from", help="CSV with time_s and q1_rad to q6_rad, or a recording of RTDE.")
    ] = None,
    seconds: Annotated[float | None, Option(min=0, help="Duration; default: until Ctrl-C.")] = None,
    rate: Annotated[float, Option(min=0.1, max=125, help="Readings per second.")] = 10.0,
    as_json: JsonOption = False,
) -> None:
    """Show a running arm's needle in the CT. Prints tip and distance to the target; only reads the robot."""
    from puncture_twin.planning.base.provenance import inputs_document
    from puncture_twin.planning.case.case import load_case
    from puncture_twin.twin.jobs.live.mirror import Mirror, mirror_text, readings_of
    from puncture_twin.twin.jobs.terminal import ended_by_ctrl_c

    followed = load_case(case)
    read = readings_of(host, recorded, followed, period_s=1.0 / rate, seconds=seconds)
    for warning in read.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    shown = []
    with ended_by_ctrl_c():
        for one in map(Mirror.of(followed).show, read.states):
            shown.append(one.summary()) if as_json else print(mirror_text(one), flush=True)
    if as_json:
        summary = {"case": str(case), "inputs": inputs_document(read.inputs), "states": shown}
        finish("mirror", shown, summary, "", as_json)


@app.command()
def live(
    case: CaseArgument,
    port: Annotated[int, Option(min=0, max=65535, help="Port; 0 takes a free one.")] = 18944,
    host: Annotated[str, Option(help="Address to listen at; others than loopback are warned of.")] = "127.0.0.1",
    pose_s: Annotated[int, Option(min=1, max=86400, help="Seconds for which a needle's pose counts.")] = 2,
    arm: ArmOption = None,
) -> None:
    """Answer navigation programs by OpenIGTLink until Ctrl-C. Safe map of a target, verdict of a needle's pose."""
    from puncture_twin.twin.jobs.live.planner import Planner
    from puncture_twin.twin.jobs.live.server import bound, serve

    with bound(host, port) as listener:
        with prepared(case, arm=arm) as context:
            planner = Planner(context)
        print_whole("live: {} on {}, port {}; Ctrl-C ends".format(context.case.name, *listener.getsockname()[:2]))
        serve(listener, planner, pose_s)


@app.command()
@with_choice
def export(
    source: SourceArgument,
    choice: Choice,
    format_name: Annotated[
        str,
        Option(
            "--format",
            metavar="FORMAT",
            help="urscript, ros2, moveit, csv, slicer, dicom, candidates-csv, candidates-json, or another package's.",
        ),
    ],
    case: Annotated[Path | None, Option(help="Case of the plan: checks the plan again.")] = None,
    scan: Annotated[Path | None, Option(help="Of confirm.json: the control scan, for dicom.")] = None,
    out_dir: OutOfCaseOption = None,
    as_json: JsonOption = False,
) -> None:
    """Export a plan for a robot, or a path for Slicer or a DICOM archive. Research software, not a medical device."""
    from puncture_twin.twin.jobs.patient.export_jobs import export_source, refuse_format

    refuse_format(format_name)
    folder = out_folder(out_dir, source, f"export-{format_name}")
    with progress_display() as progress:
        done = export_source(source, case, format_name, folder, choice, progress, scan)
    finish("export", done, done.summary(), done.text(), as_json)


@app.command()
def register(
    source: Annotated[Path, Argument(metavar="CASE_OR_MARKERS_CT", help="A case, or markers read in the CT.")],
    markers_base: Annotated[
        Path | None, Argument(metavar="MARKERS_BASE", help="The same markers, touched by the robot.")
    ] = None,
    target: Annotated[str | None, Option(help="Target X,Y,Z, mm, for two lists of markers.")] = None,
    space: Annotated[Space, Option(help="Space of the CT list and the target, if the file states none.")] = Space.LPS,
    fle: Annotated[float | None, Option(min=0.001, help="Known localisation error (rms), mm.")] = None,
    picture: Annotated[
        Path | None, Option(metavar="FILE.png", help="Write a picture of the case's error budget.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Register markers; print residuals and expected error. They are a case's, or two lists."""
    from puncture_twin.twin.jobs.patient import answers

    if markers_base is None:
        report = answers.registration_report(source)
    else:
        report = answers.lists_report(source, markers_base, target, space, fle)
    if picture is not None:
        from puncture_twin.twin.jobs.patient.pictures import write_budget_picture

        write_budget_picture(report, picture)
    finish("register", report, report, answers.registration_text(report), as_json)


@app.command()
def selfcal(
    case: Annotated[Path | None, Argument(metavar="[CASE]", help="selfcal.toml or its folder.")] = None,
    recording: Annotated[Path | None, Option(help="Recording: a CSV, or its folder with pictures or without.")] = None,
    seeds: Annotated[int, Option(min=1, max=1000, help="Number of trials.")] = 3,
    out_dir: OutOption = Path("out/selfcal"),
    record: Annotated[
        Path | None, Option(metavar="FOLDER", help="Keep the first trial's pictures in this new folder.")
    ] = None,
    shots: Annotated[
        Path | None, Option(help="Recording of what was seen afterwards: each pose updates the answer.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Calibrate two arms by ultrasound, AXP = YBQ. Then send the needle to targets in the image."""
    require_extra("twin", "selfcal")
    from puncture_twin.twin.jobs.selfcal.selfcal import run_selfcal, selfcal_facts, selfcal_text

    case = meshes_folder() / "selfcal" if case is None and recording is None else case
    with progress_display() as progress:
        facts = selfcal_facts(run_selfcal(case, recording, seeds, out_dir, progress, record, shots))
    finish("selfcal", facts, facts, selfcal_text(facts), as_json)


@calibrate_app.callback()
def _calibrate() -> None:
    """Calibrate an arm and what it holds."""


@calibrate_app.command("hand-eye")
def _hand_eye(
    recording: Annotated[Path, Option(metavar="FILE", help="CSV with a pair of poses a row: flange and camera.")],
    motions: Annotated[
        bool, Option("--motions", help="Rows are motions from pose to pose (AX = XB), not poses (AX = ZB).")
    ] = False,
    noise: Annotated[
        str | None, Option(metavar="MM,DEG,MM,DEG", help="Known noise of flange and camera; default: found.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find where a camera is on the flange, from pairs of poses: AX = ZB or AX = XB. It only reports."""
    from puncture_twin.planning.registration.hand_eye import calibrate_hand_eye, read_pose_pairs
    from puncture_twin.twin.jobs.patient.answers import hand_eye_summary, hand_eye_text, parse_noise

    pairs = read_pose_pairs(recording, motions=motions)
    calibration = calibrate_hand_eye(pairs, parse_noise(noise))
    summary = hand_eye_summary(calibration)
    finish("calibrate hand-eye", calibration, summary, hand_eye_text(summary), as_json)


@calibrate_app.command("dynamics")
def _dynamics(
    case: CaseArgument,
    recording: Annotated[Path | None, Option(metavar="FILE", help="CSV of joints and torques over time.")] = None,
    record: Annotated[
        Path | None, Option(metavar="FILE", help="Write such a file with the simulated arm first.")
    ] = None,
    seed: Annotated[int, Option(min=0, help="Of what --record draws.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Identify the arm's dynamics from torques, and what their error costs at the tip."""
    require_extra("twin", "calibrate dynamics")
    from puncture_twin.twin.jobs.experiment.dynamics_job import calibrate_dynamics, recorded_or_given

    with prepared(case, arm=True) as context:
        dynamics = calibrate_dynamics(context, recorded_or_given(context, recording, record, seed))
    finish("calibrate dynamics", dynamics, dynamics.summary(), dynamics.text(), as_json)


@app.command()
def servo(
    case: Annotated[Path, Argument(metavar="CASE", help="Servo case, or the folder that holds servo.toml.")],
    out_dir: OutOfCaseOption = None,
    seeds: Annotated[int, Option(min=1, max=MOST_SEEDS, help="Number of trials.")] = 1,
    recording: Annotated[Path | None, Option(metavar="FOLDER", help="Read this recorded session instead.")] = None,
    record: Annotated[Path | None, Option(metavar="FOLDER", help="Keep the first session in this new folder.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Guide the tool to every target with two cameras. Errors are drawn per trial. Writes pictures, plot and page."""
    require_extra("twin", "servo")
    from puncture_twin.twin.jobs.servo.job import follow_recording, refuse_with_recording, run_servo

    if recording is not None:
        refuse_with_recording(out_dir, record, seeds)
        job = follow_recording(case, recording)
        finish("servo", job, job.summary, job.text, as_json)
        return

    with progress_display() as progress:
        out = out_folder(out_dir, case, "servo")
        job = run_servo(case, out, seeds, partial(progress.count, "seeds"), progress.note, record)
    finish("servo", job, job.summary, job.text, as_json)


@app.command()
def scan(
    case: CaseArgument,
    out_dir: OutOfCaseOption = None,
    spacing: Annotated[float, Option(min=0.3, max=10, help="Slice spacing (thickness), mm.")] = 2.5,
    pixel: Annotated[float, Option(min=0.2, max=5, help="Side of a pixel, mm.")] = 0.8,
    noise: Annotated[float, Option(min=0, max=200, help="Noise (standard deviation), HU.")] = 20.0,
    seed: Annotated[int, Option(min=0, help="Seed of noise, grid and true marker positions.")] = 0,
    fov: Annotated[
        float | None, Option(min=20, max=2000, help="Side of the image, mm.", show_default="the body")
    ] = None,
    length: Annotated[float | None, Option(min=5, max=5000, help="Scan length, mm.", show_default="the body")] = None,
    turn: Annotated[float, Option(min=-180, max=180, help="Rotation about the bed's axis, degrees.")] = 0.0,
    marker: Annotated[str, Option(metavar="disc|ball|none", help="Metal markers, 8 mm.")] = "disc",
    rehearsal: Annotated[Path | None, Option(metavar="rehearsal.json", help="Show the needle of a rehearsal.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Scan a case with a virtual CT. Write DICOM, NIfTI, labels, and its readings next to the ground truth."""
    from math import radians

    from puncture_twin.twin.jobs.experiment.scan_job import ScanRequest, parse_marker, scan_case, scan_text
    from puncture_twin.twin.plant.scanner.image import ScanSettings

    settings = ScanSettings(spacing, pixel, noise, seed=seed, fov_mm=fov, length_mm=length, turn=radians(turn))
    request = ScanRequest(settings, parse_marker(marker), rehearsal)
    with prepared(case, arm=False) as context:
        run = scan_case(context, out_folder(out_dir, case, "scan"), request)
    finish("scan", run, run.summary(), scan_text(run), as_json)


@app.command()
def confirm(
    case: Annotated[Path | None, Argument(metavar="CASE", help="Case file, or the folder that holds it.")] = None,
    scan: Annotated[Path | None, Option(metavar="SCAN", help="Control CT: DICOM folder, NIfTI or NRRD.")] = None,
    plan: Annotated[Path | None, Option(metavar="plan.json", help="The plan that was executed, to compare.")] = None,
    learn: Annotated[
        list[Path] | None, Option(metavar="confirm.json", help="Compare [errors] with confirmations; repeatable.")
    ] = None,
    out_dir: OutOfCaseOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the needle in a control CT; check the line that it takes; state the next aim. Exit 1 if it must move."""
    from puncture_twin.twin.jobs.patient import confirm_job

    source = confirm_job.confirm_source(case, scan, learn or [])
    if source is None or scan is None:
        learned = confirm_job.learn(learn or [])
        finish("confirm --learn", learned, learned.summary(), learned.text(), as_json)
        return
    with prepared(source) as context:
        done = confirm_job.confirm_case(context, scan, out_folder(out_dir, source, "confirm"), plan)
    finish("confirm", done, done.summary(), done.text(), as_json)


@app.command()
def reproduce(
    paper: Annotated[str, Argument(metavar="chen2019|liu2007|axp-ybq", help="Paper to reproduce.")],
    out_dir: OutOfCaseOption = None,
    seeds: Annotated[int | None, Option(min=1, max=MOST_SEEDS, help="Number of draws.")] = None,
    experiment: Annotated[
        bool, Option("--experiment", help="For chen2019: draw its experiment anew, --seeds times.")
    ] = False,
    runs: Annotated[int, Option(min=0, max=MOST_SEEDS, help="With --experiment: runs in the simulator.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Print a paper's numbers next to ours. Exit 0 only if all are within their limits."""
    require_extra("twin", "reproduce")
    from puncture_twin.twin.jobs.papers.papers import reproduced

    folder = out_folder(out_dir, Path(paper), "reproduce")
    with progress_display() as progress:
        result = reproduced(paper, folder, seeds, progress, experiment=experiment, runs=runs)
    finish("reproduce", result, result.summary, result.text, as_json)


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: more threads only wait for one another
    as_json = "--json" in (sys.argv[1:] if arguments is None else arguments)

    def command() -> Any:
        return _parser()(arguments, standalone_mode=False)

    return exit_code_of(command, print_whole, as_json=as_json)


@cache
def _parser() -> Any:
    """Every command and its options. Built once: whoever runs many commands in one process pays 15 ms once."""
    return typer.main.get_command(app)


def program() -> NoReturn:
    """Run a command as all that this process is for, and end it with the command's exit code."""
    look_seldom()
    leave(main())


if __name__ == "__main__":
    program()
