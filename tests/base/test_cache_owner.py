"""A cache that is another user's, or that others may write, is refused before anything in it is read."""

import os
import tempfile
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from case_world import ORGAN, SKIN, case_text, write_balls
from refusals import refused

from puncture_twin import run_twin
from puncture_twin.planning.base.cache import entry_file
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.cache.entry_file import check_own, check_own_folder
from puncture_twin.planning.base.errors import InputError

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="users have no numbers here")
MAKER = "puncture_twin.planning.geometry.rigid"


@pytest.fixture
def folder():
    with tempfile.TemporaryDirectory() as name:
        around = Path(name)
        around.chmod(0o755)
        if not entry_file._in_reach(around):
            pytest.skip("others cannot come to this machine's temporary folder")
        (around / "cache").mkdir(mode=0o755)
        yield around / "cache"


def entry(folder, name="entry", mode=0o644):
    (folder / name).write_bytes(b"content")
    (folder / name).chmod(mode)
    return folder / name


def caught(path):
    try:
        check_own(path)
    except InputError as error:
        assert error.code == "cache_not_own"
        assert "PUNCTURE_TWIN_CACHE" in str(error)
        return True
    return False


def test_a_file_of_ones_own_is_read_and_one_that_others_may_write_is_refused(folder):
    for mode in (0o644, 0o600, 0o444):
        assert not caught(entry(folder, mode=mode))
        (folder / "entry").unlink()
    assert not caught(folder / "missing")
    assert not caught(folder / "not" / "there")
    for mode in (0o646, 0o666, 0o602):
        folder.chmod(0o755)
        path = entry(folder, mode=mode)
        assert caught(path)
        folder.chmod(0o700)
        assert not caught(path)


def test_a_folder_that_others_may_write_is_refused_with_all_that_is_in_it(folder):
    """Also the one around it, where others could lay another in its place; the sticky bit forbids that."""
    path = entry(folder)
    for place in (folder, folder.parent):
        for mode, wrong in ((0o757, True), (0o777, True), (0o1777, False), (0o755, False)):
            place.chmod(mode)
            entry_file._known_in_reach.cache_clear()  # a process looks once at what is around
            assert (caught(path), caught(folder / "missing")) == (wrong, wrong), (place, oct(mode))


def test_what_another_user_owns_is_refused_wherever_it_lies(folder, monkeypatch):
    """Of a file in an own folder, of a folder, though nobody else may write either."""
    path = entry(folder)
    own = entry_file.trusted_owners()
    assert own == {os.geteuid(), 0, Path(entry_file.__file__).stat().st_uid}
    monkeypatch.setattr(entry_file, "trusted_owners", lambda: frozenset({4_000_000}))
    entry_file._known_in_reach.cache_clear()
    assert caught(path) and caught(folder / "missing")
    folder.chmod(0o700)
    assert caught(path)
    monkeypatch.undo()
    assert not caught(path)


def test_a_link_is_followed_to_its_folder_and_a_file_that_was_given_away_is_refused(folder):
    (folder / "open").mkdir()
    (folder / "open").chmod(0o777)
    (folder / "link").symlink_to("open")
    assert caught(folder / "link" / "missing")
    if os.geteuid() == 0:  # only root gives files away
        os.chown(entry(folder), 54_321, -1)
        assert caught(folder / "entry")


def test_a_group_of_the_user_alone_is_no_other(monkeypatch):
    """Systems that make a group for each user let it write; a group with members does not pass, nor another's."""
    status = SimpleNamespace(st_mode=0o775, st_gid=7)
    user = SimpleNamespace(pw_gid=7, pw_name="anna")
    groups = [("anna", [], False), ("anna", ["anna"], False), ("anna", ["bo"], True), ("staff", [], True)]
    monkeypatch.setattr("pwd.getpwuid", lambda uid: user)
    for name, members, is_open in groups:
        group = SimpleNamespace(gr_name=name, gr_mem=members)
        monkeypatch.setattr("grp.getgrgid", lambda gid, group=group: group)
        entry_file._alone_in.cache_clear()
        assert entry_file._open_to_others(status, 0o020, 0o002) == is_open
    entry_file._alone_in.cache_clear()


def test_where_users_have_no_numbers_nothing_is_refused(folder, monkeypatch):
    path = entry(folder, mode=0o666)
    monkeypatch.delattr(os, "geteuid")
    assert not caught(path)


def test_kept_arrays_that_others_may_write_are_neither_read_nor_made_anew(folder):
    """They were made by the user; since then anybody may have written them."""
    cache = Cache(folder)
    made = cache.arrays({"n": 1}, lambda: {"a": np.zeros(3)}, by=MAKER)
    assert np.array_equal(made["a"], cache.arrays({"n": 1}, pytest.fail, by=MAKER)["a"])
    (kept,) = folder.iterdir()
    kept.chmod(0o666)
    with refused("cache_not_own"):
        cache.arrays({"n": 1}, pytest.fail, by=MAKER)


def test_a_folder_of_compiled_code_is_the_users_alone(folder):
    """One that others may write is refused wherever it lies, and a link to an own one: it may lead elsewhere later.

    A place where others could lay another folder too, unless the sticky bit forbids that.
    """
    check_own_folder(folder)
    folder.chmod(0o700)
    for mode, wrong in ((0o777, True), (0o757, True), (0o1777, False), (0o755, False)):
        folder.parent.chmod(mode)
        entry_file._known_in_reach.cache_clear()
        with pytest.raises(InputError) if wrong else nullcontext():
            check_own_folder(folder)
    (folder / "link").symlink_to(folder)
    folder.parent.chmod(0o700)
    for place, mode in ((folder, 0o702), (folder / "link", 0o700)):
        folder.chmod(mode)
        with refused("cache_not_own"):
            check_own_folder(place)


def test_a_command_says_it_in_one_line(folder, tmp_path, monkeypatch, capfd):
    write_balls(tmp_path, "skin", "organ")
    (tmp_path / "case.toml").write_text(case_text(SKIN, ORGAN))
    folder.chmod(0o777)
    monkeypatch.setenv("PUNCTURE_TWIN_CACHE", str(folder))
    assert run_twin.main(["check", str(tmp_path), "--no-arm", "--theta", "0", "--beta", "0"]) == 2
    said = capfd.readouterr().err.strip().splitlines()
    assert str(folder) in said[-1] and "go-w" in said[-1]
