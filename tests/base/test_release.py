"""A release is one commit with a tag, or nothing: tried in small clones."""

import shutil
import subprocess
import sys
from datetime import date

import pytest
from places import ROOT

from tools.release import FILES, MOST_LINES, UNRELEASED, RefusedError, git, release

DAY = date(2027, 1, 2)
CHANGELOG = f"# Changelog\n\n{UNRELEASED}### Added\n- A thing.\n\n## [0.0.1] - 2020-01-01\n- The first.\n"


@pytest.fixture
def clone(tmp_path, monkeypatch):
    for name, value in {"AUTHOR": "A", "COMMITTER": "B"}.items():
        monkeypatch.setenv(f"GIT_{name}_NAME", value)
        monkeypatch.setenv(f"GIT_{name}_EMAIL", "a@b")
    for name in FILES:
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / "CHANGELOG.md").write_text(CHANGELOG)
    text = (tmp_path / "pyproject.toml").read_text()
    (tmp_path / "pyproject.toml").write_text(text.replace(line_of(text), 'version = "0.9.9"', 1))
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "begin")
    return tmp_path


def line_of(text):
    return next(line for line in text.splitlines() if line.startswith("version = "))


def state(clone):
    return [git(clone, *words) for words in (("log", "--oneline"), ("tag",), ("status", "--porcelain"))]


def test_a_release_is_a_commit_and_a_tag(clone):
    """The checks see the files with the new version; the section keeps its lines under a heading with the day."""
    seen = []
    assert release(clone, "0.10.0", DAY, lambda root, _: seen.append((root / "CITATION.cff").read_text())) == "v0.10.0"
    assert "\nversion: 0.10.0\n" in seen[0]
    assert line_of((clone / "pyproject.toml").read_text()) == 'version = "0.10.0"'
    log = (clone / "CHANGELOG.md").read_text()
    assert log == CHANGELOG.replace(UNRELEASED, f"{UNRELEASED}\n## [0.10.0] - 2027-01-02\n")
    assert git(clone, "status", "--porcelain") == ""
    assert git(clone, "show", "--no-patch", "--format=%s", "HEAD").strip() == "release: 0.10.0"
    said = git(clone, "tag", "--list", "--format=%(objecttype) %(contents)", "v0.10.0")
    assert said.split() == ["tag", "0.10.0", "###", "Added", "-", "A", "thing."]
    with pytest.raises(RefusedError, match="has 0 lines"):
        release(clone, "0.11.0", DAY, lambda *_: None)


def test_what_is_refused_changes_nothing(clone):
    """A version that is not higher, a tree with changes, a tag that is there, a section of many pages, a check."""

    def fails(*_):
        raise RefusedError("a test fails")

    def interrupted(*_):
        raise KeyboardInterrupt

    def is_refused(match, version="0.10.0", check=lambda *_: None, error=RefusedError):
        begun = state(clone)
        with pytest.raises(error, match=match):
            release(clone, version, DAY, check)
        assert state(clone) == begun

    for version in ("", "0.9.9", "0.9.8", "0.10", "v0.10.0", "0.10.0rc1", "0.010.0", "1.0.0\n"):
        is_refused("higher than 0.9.9", version)
    is_refused("a test fails", check=fails)
    is_refused(None, check=interrupted, error=KeyboardInterrupt)
    before = (clone / "CITATION.cff").read_text()
    for name, text in (("CITATION.cff", before), ("new.txt", None)):
        (clone / name).write_text("another\n")
        is_refused(name)
        (clone / name).write_text(text) if text else (clone / name).unlink()
    git(clone, "tag", "v0.10.0")
    is_refused(r"tag v0\.10\.0")
    (clone / "CHANGELOG.md").write_text(CHANGELOG.replace("- A thing.\n", "- A thing.\n" * MOST_LINES))
    git(clone, "commit", "--quiet", "--all", "--message", "much")
    is_refused(f"{MOST_LINES + 1} lines", "0.11.0")


def test_this_changelog_can_be_released():
    text = (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert text.count(UNRELEASED) == 1
    assert len(text.partition(UNRELEASED)[2].partition("\n## ")[0].splitlines()) <= MOST_LINES


def test_make_refuses_without_a_version():
    command = [sys.executable, "-m", "tools.release"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "VERSION=" in done.stderr
