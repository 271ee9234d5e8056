"""What a worker keeps from one case to the next never changes an answer: attacks on the sharing of meshes and trees."""

import io
import os
import shutil

import pyarrow.parquet as pq
import pytest
from case_world import ball, registration_section, structure, write_markers
from cohort_world import plan_of, table_bytes, task_of, tiny_text, write_patient

from puncture_twin.planning.base.cache.array_cache import MEMORY_BYTES, Memory
from puncture_twin.planning.batch.run_case import STALE, run_case


@pytest.fixture
def memory():
    return Memory(MEMORY_BYTES)


def held(path, tmp_path, memory, number, **options):
    """Asserts that a case gives the same bytes with and without what was kept before; returns them."""
    shared = table_bytes(path, tmp_path / f"shared{number}", memory, **options)
    assert shared == table_bytes(path, tmp_path / f"alone{number}", **options)
    return shared[0]


def test_the_same_patient_again_and_another_target(tmp_path, memory):
    """The same bytes as alone; and something was kept."""
    path = write_patient(tmp_path / "a")
    first = held(path, tmp_path, memory, 0)
    kept = memory.held_bytes
    assert kept > 0
    assert held(path, tmp_path, memory, 1) == first
    assert held(path, tmp_path, memory, 2, target={"position_mm": [4.0, 0.0, 0.0]}) != first
    assert held(path, tmp_path, memory, 3, margins={"rib": 40.0}) != first
    assert held(path, tmp_path, memory, 4, margins={"rib": 3.0})
    assert memory.held_bytes < kept + 1000


def test_two_patients_with_the_same_file_names(tmp_path, memory):
    """Another rib under the name of the first: nothing goes by the path."""
    one, other = write_patient(tmp_path / "a"), write_patient(tmp_path / "b")
    ball(other.parent / "rib.stl", 12.0, (0, -40, 10))
    assert held(one, tmp_path, memory, 0) != held(other, tmp_path, memory, 1)
    assert held(one, tmp_path, memory, 2) == held(one, tmp_path, memory, 3)


def test_a_mesh_that_is_edited_between_two_cases(tmp_path, memory):
    """In place, of the same size and with the old date: the new bytes count, and the old plan has no such case."""
    path = write_patient(tmp_path / "a")
    rib, (planned,) = path.parent / "rib.stl", plan_of(path)
    before = held(path, tmp_path, memory, 0)
    seen = rib.stat()
    ball(rib, 12.0, (0, -40, 10))
    os.utime(rib, ns=(seen.st_atime_ns, seen.st_mtime_ns))
    assert rib.stat().st_size == seen.st_size
    end = run_case(task_of(planned, tmp_path / "late"), memory)
    assert (end.exit_code, end.reason) == (None, STALE)
    assert list((tmp_path / "late" / "work").iterdir()) == []
    assert held(path, tmp_path, memory, 1) != before


def test_the_same_bytes_in_another_unit_space_role_or_margin(tmp_path, memory):
    """All that decides a surface or a verdict beside the bytes is part of what is kept, or is not kept."""
    rib, second = 'role = "avoid"\nmargin_mm = 3.0', structure("second", "unknown", {"mesh": "rib.stl", "unit": "mm"})
    wide, crossed = rib.replace("3.0", "30.0"), f'role = "traverse"\n{second}margin_mm = 1.0'
    found = set()
    for number, new in enumerate((rib, wide, crossed, f'{rib}\nspace = "RAS"', f'{rib}\nspace = "LPS"')):
        path = write_patient(tmp_path / f"p{number}", text=tiny_text().replace(rib, new))
        found.add(held(path, tmp_path, memory, number))
    assert len(found) == 5


def test_the_unit_is_part_of_a_mesh(tmp_path, memory):
    """A rib in centimetres, ten times as far away and as large, is not the rib in millimetres."""
    mm, cm = (write_patient(tmp_path / unit) for unit in ("mm", "cm"))
    ball(cm.parent / "rib.stl", 0.5, (4, 0, 4))
    cm.write_text('unit = "cm"'.join(cm.read_text().rsplit('unit = "mm"', 1)))
    shutil.copy(cm.parent / "rib.stl", mm.parent / "rib.stl")
    assert held(mm, tmp_path, memory, 0) != held(cm, tmp_path, memory, 1)


MOUNT = {"position_mm": [350.0, -150.0, -300.0], "x_axis": [1.0, 0.0, 0.0], "z_axis": [0.0, 0.0, 1.0]}


def test_the_arm_and_its_workcell(tmp_path, memory):
    """Another mount, needle, model or table is another workcell; the same is the same to the byte."""
    table = '[[obstacle]]\nname = "table"\nframe = "ct"\ncenter_mm = [0, {}, 0]\nsize_mm = [400, 40, 800]\n'
    text = tiny_text(search="theta_deg = [0, 30]\nstep_deg = 30.0")
    plain, moved = (write_patient(tmp_path / f"{y}", text=text + table.format(y)) for y in (150, 130))
    far = {**MOUNT, "position_mm": [800.0, 0.0, 0.0]}
    options = [
        (plain, {"mount": MOUNT}),
        (plain, {"mount": far}),
        (plain, {"mount": MOUNT, "needle": {"length_mm": 250.0}}),
        (plain, {"mount": MOUNT, "arm": {"model": "ur5"}}),
        (moved, {"mount": MOUNT}),
        (plain, {"mount": MOUNT}),
    ]
    found = [held(path, tmp_path, memory, n, with_arm=True, **chosen) for n, (path, chosen) in enumerate(options)]
    assert found[0] == found[5] and len(set(found)) == 5


def test_memory_is_bounded_and_forgets_the_least_recently_used():
    """What does not fit goes; what alone is too large is never kept; a failure is not kept."""
    memory, made = Memory(10), []

    def get(key, size=4):
        return memory.get((key,), lambda: made.append(key) or key, lambda _: size)

    for key in ("a", "b", "a", "c", "a", "b", "huge", "huge"):
        get(key, 11 if key == "huge" else 4)
        assert memory.held_bytes <= 10
    assert made == ["a", "b", "c", "b", "huge", "huge"]
    with pytest.raises(ZeroDivisionError):
        memory.get(("bad",), lambda: 1 / 0, lambda _: 1)
    assert memory.get(("bad",), lambda: 5, lambda _: 1) == 5


def test_other_markers_on_the_same_skin(tmp_path, memory):
    """How markers lie on the skin is kept by their coordinates: one that is moved off it is warned of again."""
    text = tiny_text() + registration_section()
    paths = [write_patient(tmp_path / name, text=text) for name in "abc"]
    for path, height in zip(paths, (90, 90, 140), strict=True):
        lines = f"A,0,0,{height}\nB,63.6,0,63.6\nC,0,54,72\nD,-36,-48,-67.1\nE,-70,20,52.9\n"
        write_markers(path.parent, *2 * [f"name,x_mm,y_mm,z_mm\n{lines}"])
    found = [held(path, tmp_path, memory, number) for number, path in enumerate(paths)]
    assert found[0] == found[1] != found[2]
    told = [pq.read_schema(io.BytesIO(table)).metadata[b"run"].decode() for table in found]
    assert "markers far from the skin: A (50 mm)" in told[2] and "markers far" not in told[0]
