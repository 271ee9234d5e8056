"""What is refused has a code, and every sentence stands on one page."""

import difflib
import re
import runpy

from places import ROOT

PAGE = ROOT / "docs" / "reference" / "sentences.md"
WRITER = runpy.run_path(str(ROOT / "docs" / "sentences.py"), run_name="sentences")


def test_the_page_holds_the_sentences_of_the_source():
    """A polished sentence changes the page alone; ``python docs/sentences.py`` writes it again."""
    held, said = PAGE.read_text(encoding="utf-8").splitlines(), WRITER["page"]().splitlines()
    changed = "\n".join(difflib.unified_diff(held, said, "sentences.md", "the source", lineterm="", n=0))
    assert held == said, f"python docs/sentences.py writes:\n{changed}"


def test_a_code_is_a_few_words_in_snake_case():
    """What a user or a test looks up; a value that fills it in is no code."""
    codes = {
        line[3:].partition("`")[0] for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")
    }
    codes -= {WRITER["VALUE"]}
    assert not [code for code in codes if not re.fullmatch(r"[a-z]+(_[a-z0-9]+){0,4}", code)]
    assert 100 < len(codes) < 500
