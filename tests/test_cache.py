"""The cache: right when it is right, and never trusted when it is not."""

import numpy as np
import pytest

from planning.cache import Cache, user_cache


@pytest.fixture
def cache(tmp_path):
    """An empty folder."""
    return Cache(tmp_path / "cache")


def counted(calls):
    """A maker that says how often it was asked."""

    def make():
        calls.append(1)
        return {"vertices": np.arange(12.0).reshape(4, 3), "names": np.array(["a", "bc"])}

    return make


def test_the_second_time_nothing_is_made(cache):
    """The same inputs give the stored arrays, bit for bit."""
    calls = []
    first = cache.arrays({"file": "abc", "what": "label 5"}, counted(calls))
    second = cache.arrays({"file": "abc", "what": "label 5"}, counted(calls))
    assert len(calls) == 1
    assert set(second) == set(first)
    for name in first:
        np.testing.assert_array_equal(second[name], first[name])


@pytest.mark.parametrize("other", [{"file": "abd"}, {"what": "label 6"}, {"extra": 1}])
def test_other_inputs_are_made_anew(cache, other):
    """Any difference in what it was made from is another entry."""
    calls = []
    cache.arrays({"file": "abc", "what": "label 5"}, counted(calls))
    cache.arrays({"file": "abc", "what": "label 5"} | other, counted(calls))
    assert len(calls) == 2


@pytest.mark.parametrize("spoil", [b"", b"PK garbage", None, "half", "flip"])
def test_a_spoiled_file_is_made_anew_and_replaced(cache, spoil):
    """Empty, foreign, missing, cut or with one bit turned: not used, and whole again afterwards."""
    calls = []
    made = cache.arrays({"file": "abc"}, counted(calls))
    (path,) = cache.folder.glob("*.npz")
    content = bytearray(path.read_bytes())
    if spoil is None:
        path.unlink()
    elif spoil == "half":
        path.write_bytes(content[: len(content) // 2])
    elif spoil == "flip":
        place = content.index(np.float64(7.0).tobytes())
        content[place + 1] ^= 1
        path.write_bytes(content)
    else:
        path.write_bytes(spoil)
    again = cache.arrays({"file": "abc"}, counted(calls))
    np.testing.assert_array_equal(again["vertices"], made["vertices"])
    assert len(calls) == 2
    cache.arrays({"file": "abc"}, counted(calls))
    assert len(calls) == 2


def test_a_file_of_another_key_is_not_believed(cache):
    """An honest file under the wrong name would give one label another's surface; its digest says whose it is."""
    calls = []
    cache.arrays({"file": "one"}, lambda: {"vertices": np.zeros((1, 3))})
    (path,) = cache.folder.glob("*.npz")
    cache.arrays({"file": "two"}, counted(calls))
    (other,) = set(cache.folder.glob("*.npz")) - {path}
    other.write_bytes(path.read_bytes())
    np.testing.assert_array_equal(cache.arrays({"file": "two"}, counted(calls))["vertices"].shape, (4, 3))
    assert len(calls) == 2


def test_a_folder_that_cannot_be_written_costs_nothing_but_time(tmp_path):
    """A file stands where the folder should be: the result is made all the same."""
    (tmp_path / "taken").write_text("")
    calls = []
    Cache(tmp_path / "taken" / "cache").arrays({"file": "abc"}, counted(calls))
    assert len(calls) == 1


def test_the_environment_names_the_folder(monkeypatch, tmp_path):
    """Its own variable first, then XDG; empty switches it off."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("PUNCTURE_TWIN_CACHE", raising=False)
    assert user_cache().folder == tmp_path / "puncture-twin"
    monkeypatch.setenv("PUNCTURE_TWIN_CACHE", str(tmp_path / "own"))
    assert user_cache().folder == tmp_path / "own"
    monkeypatch.setenv("PUNCTURE_TWIN_CACHE", "")
    assert user_cache().folder is None
