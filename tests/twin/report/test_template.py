"""The pages' shell: texts are escaped, a missing part is an error, data cannot end its element."""

import base64
import gzip
import hashlib
import json
from importlib.resources import files

import jinja2
import pytest
from markupsafe import Markup

from puncture_twin.twin.report.page.template import plotly_script, script_json, write_html
from puncture_twin.twin.report.present import Card, Field, Section, Warn, facts, grid, html, text

EVIL = "</script><script>alert('1')</script>{{ title }}"
JOB = ("under", "sections", "inputs", "origin")


def job_parts(text):
    return dict.fromkeys(JOB, text) | {"title": text, "cards": [Card(text, text, text)]}


def test_plotly_is_the_published_bundle():
    """Every byte of the script and of its licence is what was pinned, and the page says whose it is."""
    folder = files("puncture_twin.twin.report") / "plotly_js"
    pinned = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["files"]
    assert {entry["path"] for entry in pinned} == {"LICENSE", "plotly-gl3d.min.js"}
    for entry in pinned:
        data = (folder / entry["path"]).read_bytes()
        assert (len(data), hashlib.sha256(data).hexdigest()) == (entry["bytes"], entry["sha256"])
    assert "Licensed under the MIT license" in plotly_head()


def plotly_head():
    return gzip.decompress(base64.b64decode(plotly_script())).decode()[:400]


def test_texts_are_escaped_wherever_they_stand(tmp_path):
    """Title, cards, figures, and every part that is not marked as HTML."""
    write_html("job.html", tmp_path / "page.html", **job_parts(EVIL))
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<script" not in text
    assert text.count("&lt;script&gt;") == len(JOB) + 2 + 3  # the title stands twice
    assert "{{ title }}" in text  # what is put in is not searched again


def test_a_part_that_is_missing_is_an_error_and_no_page(tmp_path):
    """Half a page must not look like a whole one."""
    parts = job_parts("words")
    del parts["sections"]
    with pytest.raises(jinja2.UndefinedError, match="sections"):
        write_html("job.html", tmp_path / "page.html", **parts)
    assert not list(tmp_path.iterdir())


def test_a_section_is_the_same_on_both_faces():
    """Every cell and sentence of the page in the terminal, plain there and escaped here; markup is the page's alone."""
    fields = (Field("name", "name"), Field("θ", "theta", 1, "°"), Field(EVIL, lambda row: row["name"]))
    rows = [{"name": EVIL, "theta": -1.25}, {"name": "b", "theta": None}]
    blocks = [grid(fields, rows), (facts(fields, rows[1]), "β first"), Warn((EVIL,)), Markup("<b>1</b>")]
    page, plain = html([Section("both", blocks)]), text([Section("both", blocks)])
    assert "<script" not in page and page.count("&lt;script&gt;") == 5 and "<b>1</b>" in page
    assert "θ, °" in page and "−1.2" in page and "<h2>Both</h2>" in page
    assert "theta, deg" in plain and "-1.2" in plain and "beta first" in plain and "<b>" not in plain
    assert plain.count(EVIL) == 5
    assert text([Section("nothing", [grid(fields, [])])]) == ""


def test_data_cannot_end_its_script_element():
    """No "<" is left, it unpacks to what it was, with the same bytes each time; what is not a number is refused."""
    packed = script_json({"a": EVIL})
    assert packed.count("<") == 0 and packed == script_json({"a": EVIL})
    assert json.loads(gzip.decompress(base64.b64decode(packed))) == {"a": EVIL}
    with pytest.raises(ValueError, match="Out of range"):
        script_json(float("nan"))
