"""An id is the hash of inputs, options and version, and of nothing else."""

import shutil

from cohort_world import plan_of, write_patient
from refusals import refused

from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.batch import plan as plans
from puncture_twin.planning.batch.plan import identified, read_plan_table, write_plan_table


def id_of(path, **options):
    return plan_of(path, **options)[0].id


def test_the_same_bytes_have_the_same_id_wherever_they_lie(tmp_path):
    """In another folder, under another name of the case, through its folder, at another time."""
    path = write_patient(tmp_path / "a")
    shutil.copytree(path.parent, tmp_path / "b" / "c")
    assert id_of(path) == id_of(tmp_path / "b" / "c" / "case.toml") == id_of(tmp_path / "b" / "c")


def test_every_byte_and_option_decides(tmp_path, monkeypatch):
    """One bit of a mesh, a space in the case, an option, the arm, swapped files, the version: each gives another id."""
    path = write_patient(tmp_path / "a")
    rib, organ = (path.parent / f"{name}.stl" for name in ("rib", "organ"))
    ids = [id_of(path), *(id_of(path, margins={"rib": mm}) for mm in (3.0, 3.5)), id_of(path, with_arm=None)]
    content = bytearray(rib.read_bytes())
    content[100] ^= 1
    rib.write_bytes(content)
    ids.append(id_of(path))
    path.write_text(path.read_text() + " \n")
    ids.append(id_of(path))
    content = rib.read_bytes(), organ.read_bytes()  # the same bytes in other roles
    rib.write_bytes(content[1])
    organ.write_bytes(content[0])
    ids.append(id_of(path))
    monkeypatch.setattr(plans, "version", lambda _: "9.9")
    assert len({*ids, id_of(path)}) == 8


def test_a_case_that_cannot_be_read_is_planned_with_its_reason(tmp_path):
    """Without the folder in the text; mended, it has another id."""
    path = write_patient(tmp_path / "a")
    whole = id_of(path)
    (path.parent / "rib.stl").rename(path.parent / "away")
    (row,) = plan_of(path)
    assert row.refusal.startswith("case.toml: structure 'rib': file 'rib.stl' does not exist")
    assert str(tmp_path) not in row.refusal
    (path.parent / "away").rename(path.parent / "rib.stl")
    assert identified(row).id == whole != row.id
    assert "no such file" in plan_of(tmp_path / "gone" / "case.toml")[0].refusal


def test_a_plan_is_read_as_it_was_written(tmp_path):
    """And refused where it was edited, or is not there."""
    rows = plan_of(write_patient(tmp_path / "a"), tmp_path / "gone")
    with refused("no_batch_plan"):
        read_plan_table(tmp_path / "out")
    with writing(tmp_path / "out", "batch plan") as draft:
        write_plan_table(rows, draft.folder / "plan.parquet")
    assert list(read_plan_table(tmp_path / "out").cases) == rows
    path = tmp_path / "out" / "plan.parquet"
    path.write_bytes(path.read_bytes() + b" ")
    with refused("output_not_whole"):
        read_plan_table(tmp_path / "out")
