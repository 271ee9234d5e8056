"""The page in a headless Chromium, spoken to over its debugging pipe; skipped where none is installed."""

import json
import os
import re
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import report_world as world

from puncture_twin.twin.report.map_view import map_view
from puncture_twin.twin.report.slices.panel import TONES

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",  # WebGL in software, without the browser's warning about it
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-pipe",
    "--window-size=1300,1000",
)

PATIENCE_S = 120
"""A slow shared machine needs some ten seconds; beyond this something hangs."""

ONTO_PIPES = """
import os, sys
for free, pipe in zip((103, 104), sys.argv[1:3]):
    os.dup2(int(pipe), free)  # out of the way first: the pipes may themselves be 3 or 4
os.dup2(103, 3)
os.dup2(104, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""Chromium reads commands from descriptor 3 and answers on 4."""


class Browser:
    """One page in one browser; collects what the browser reports while commands run."""

    def __init__(self, folder):
        into, self._write = os.pipe()
        self._read, out = os.pipe()
        os.set_inheritable(into, True)
        os.set_inheritable(out, True)
        command = [sys.executable, "-c", ONTO_PIPES, str(into), str(out), CHROMIUM, *FLAGS, f"--user-data-dir={folder}"]
        self._process = subprocess.Popen(command, pass_fds=(into, out), stderr=subprocess.DEVNULL)
        os.close(into)
        os.close(out)
        self._rest, self._number, self._session, self.events = b"", 0, None, []

    def __enter__(self):
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Runtime", "Log", "Network", "Page"):
            self.call(f"{domain}.enable")
        return self

    def __exit__(self, *reason):
        self._process.terminate()
        self._process.wait(timeout=PATIENCE_S)
        os.close(self._write)
        os.close(self._read)

    def call(self, method, **parameters):
        """Send one command and wait for its answer."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._number:
            self.events.append(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def evaluate(self, script):
        """The value of a JavaScript expression in the page."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def until(self, script):
        """Wait until an expression is true."""
        end = time.monotonic() + PATIENCE_S
        while not self.evaluate(script):
            assert time.monotonic() < end, f"never true: {script}"
            time.sleep(0.1)

    def open(self, path):
        """Load a file and wait for it."""
        self.call("Page.navigate", url=path.as_uri())
        while not any(event.get("method") == "Page.loadEventFired" for event in self.events):
            self.events.append(self._next())

    def _next(self):
        while b"\0" not in self._rest:
            assert select.select([self._read], [], [], PATIENCE_S)[0], "the browser does not answer"
            part = os.read(self._read, 1 << 20)
            assert part, "the browser ended"
            self._rest += part
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def complaints(self):
        """Errors of the console and uncaught exceptions; what a driver says about speed is none."""
        found = []
        for event in self.events:
            parameters = event.get("params", {})
            if event.get("method") == "Runtime.exceptionThrown":
                found.append(parameters["exceptionDetails"])
            if event.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
                found.append(parameters["entry"])
            if event.get("method") == "Runtime.consoleAPICalled" and parameters["type"] in {"error", "assert"}:
                found.append(parameters["args"])
        return found

    def requests(self):
        """Every address that the page asked for, but for data it carries itself."""
        urls = [e["params"]["request"]["url"] for e in self.events if e.get("method") == "Network.requestWillBeSent"]
        return [url for url in urls if not url.startswith(("data:", "blob:"))]


@pytest.fixture(scope="module")
def case():
    """The small patient."""
    return world.make_case()


@pytest.fixture(scope="module")
def candidates(case):
    """Its verdicts."""
    return world.make_candidates(case)


@pytest.fixture(scope="module")
def browser(case, candidates, tmp_path_factory):
    """A browser that shows its page."""
    if CHROMIUM is None:
        pytest.skip("no chromium, chromium-browser or google-chrome on this machine")
    folder = tmp_path_factory.mktemp("browser")
    path = folder / "report.html"
    world.make_page(path)
    with Browser(folder / "profile") as browser:
        browser.open(path)
        browser.until("document.body.dataset.ready === 'true'")
        yield browser


def map_box(browser):
    """Where the map stands; not before it does: while the page is laid out a click would miss it."""
    asked = "JSON.stringify(document.getElementById('map-image').getBoundingClientRect())"
    box, before, end = browser.evaluate(asked), None, time.monotonic() + PATIENCE_S
    while box != before:
        assert time.monotonic() < end, "the map does not stand still"
        time.sleep(0.1)
        box, before = browser.evaluate(asked), box
    return json.loads(box)


def point_at(browser, case, candidates, theta_deg, beta_deg, *, click=False):
    """Move the pointer to a direction on the map; returns what the page says."""
    browser.evaluate("document.getElementById('map').scrollIntoView()")
    box = map_box(browser)
    x, y = map_view(case, candidates).place(np.radians(theta_deg), np.radians(beta_deg))
    at = {"x": box["x"] + (1 + x) / 2 * box["width"], "y": box["y"] + (1 - y) / 2 * box["height"]}
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", **at)
    if click:
        for kind in ("mousePressed", "mouseReleased"):
            browser.call("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **at)
    return browser.evaluate("document.getElementById('hover').innerText")


def test_hover_explains_a_refusal(browser, case, candidates):
    """Over a rejected cell: angles, verdict, reason with structure, depth and mm."""
    words = point_at(browser, case, candidates, 40, 60)
    assert "θ 40°, β 60°" in words
    assert "rejected" in words and "too_close" in words and "rib right 9" in words
    assert "55.5 mm from the target" in words and re.search(r"clearance 0\.3 mm", words)


def test_hover_shows_what_kept_the_arm(browser, case, candidates):
    """A reason that comes with a sentence shows it."""
    assert "the shaft ends at 150 mm" in point_at(browser, case, candidates, 80, 200)


def test_the_rims_own_angle_stands_within_it(browser):
    """Not over the line, as on the picture of the map."""
    script = """(() => {
        const circles = [...document.querySelectorAll("#map-lines circle")], rim = circles[0];
        const label = [...document.querySelectorAll("#map-lines text")].find((t) => t.textContent === "θ 90°");
        const at = (element, name) => Number(element.getAttribute(name));
        const aside = Math.hypot(at(label, "x") - at(rim, "cx"), at(label, "y") - at(rim, "cy"));
        return [aside, at(rim, "r")];
    })()"""
    aside, radius = browser.evaluate(script)
    assert radius - 30 < aside < radius - 8


def test_hover_shows_a_safe_direction(browser, case, candidates):
    """Over a safe cell: verdict, rank, clearance with the nearest structure, path."""
    words = point_at(browser, case, candidates, 40, 220)
    row = int(
        np.flatnonzero(np.isclose(candidates.theta, np.radians(40)) & np.isclose(candidates.beta, np.radians(220)))[0]
    )
    assert "θ 40°, β 220°" in words
    assert f"safe, rank {candidates.ranking.rank[row]}" in words
    assert "least clearance 9.0 mm (rib right 9)" in words and "100.0 mm" in words


def test_hover_outside_the_cap_says_what_is_chosen(browser, case, candidates):
    """Beyond the rim there is no verdict: the panel goes back to the chosen direction, at first the best."""
    point_at(browser, case, candidates, 40, 60)
    words = point_at(browser, case, candidates, 120, 45)
    assert "rank 1" in words and "θ 0°, β 0°" in words


def test_choosing_moves_everything(browser, case, candidates):
    """Table, sliders and map all set panel, sliders, command and slices, which say whose they are."""
    point_at(browser, case, candidates, 30, 200, click=True)
    assert browser.evaluate("document.getElementById('command').textContent") == (
        f"run-twin plan {Path.cwd().resolve()}/ball.toml --theta 30 --beta 200"
    )
    assert browser.evaluate("[document.getElementById('theta').value, document.getElementById('beta').value]") == [
        "30",
        "200",
    ]
    assert "θ 30°, β 200° · safe" in browser.evaluate("document.getElementById('slices-of').innerText")
    browser.evaluate("document.querySelector('button.pick').click()")
    assert browser.evaluate("document.querySelector('button.pick').getAttribute('aria-pressed')") == "true"
    assert "θ 0°, β 0° · safe" in browser.evaluate("document.getElementById('slices-of').innerText")
    slide = (
        "(() => { const s = document.getElementById('theta'); s.value = 80; s.dispatchEvent(new Event('input')); })()"
    )
    browser.evaluate(slide)
    assert browser.evaluate("document.getElementById('command').textContent").startswith("run-twin check /")
    assert "rejected" in browser.evaluate("document.getElementById('hover').innerText")


def test_slices_are_shown_in_every_window(browser):
    """The CT's bytes become greys of each window."""
    greys = "[...document.querySelector('#slices-a .ct').getContext('2d').getImageData(0, 0, 480, 480).data]"
    for tone in ("lung", "bone", "brain", "abdomen"):
        browser.evaluate(f"document.querySelector('#tones [data-tone={tone}]').click()")
        browser.until(f"document.getElementById('slices-a').dataset.tone === '{tone}'")
        shades = np.array(browser.evaluate(greys)).reshape(-1, 4)[:, 0]
        level, width = TONES[tone]
        brightest = 255 * min(1.0, (299 - level) / width + 0.5)  # the densest voxels, to half a step of the table
        assert abs(int(shades.max()) - brightest) <= 255 * 12 / width + 1


@pytest.mark.parametrize("width", [390, 768, 1280])
def test_no_width_needs_sideways_scrolling(browser, width):
    """A phone, a tablet and a desk: the page is as wide as the window; wide tables scroll in themselves."""
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width < 600)
    assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth")
    browser.call("Emulation.clearDeviceMetricsOverride")


def test_every_control_has_a_name_and_a_visible_focus(browser):
    """What the keyboard reaches: buttons and sliders with names, and an outline where the focus is."""
    named = "(e.getAttribute('aria-label') || e.textContent).trim().length > 0"
    assert browser.evaluate(f"[...document.querySelectorAll('main button, button, input')].every(e => {named})")
    assert browser.evaluate("[...document.images].every(e => e.hasAttribute('alt'))")
    assert browser.evaluate("[...document.querySelectorAll('nav a')].every(a => document.querySelector(a.hash))")
    for kind in ("keyDown", "keyUp"):
        browser.call("Input.dispatchKeyEvent", type=kind, key="Tab", code="Tab", windowsVirtualKeyCode=9)
    assert browser.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"


def test_the_scene_is_drawn_and_answers_the_map(browser, case, candidates):
    """The scene holds its meshes; a click on the map draws that direction; the buttons change the arm's pose."""
    if browser.evaluate("document.getElementById('scene').hidden"):
        pytest.skip("this browser has no WebGL")
    browser.until("document.querySelector('#scene canvas') !== null")
    names = browser.evaluate("document.getElementById('scene').data.map(t => t.name)")
    assert {"liver", "aorta", "skin", "target", "safe region", "needle", "arm"} <= set(names)
    row = int(
        np.flatnonzero(np.isclose(candidates.theta, np.radians(30)) & np.isclose(candidates.beta, np.radians(200)))[0]
    )
    end = world.TARGET + 210 * candidates.outward_ct[row]
    point_at(browser, case, candidates, 30, 200, click=True)
    browser.evaluate("document.getElementById('scene').scrollIntoView()")  # what nobody sees is not drawn
    last = "document.getElementById('scene').data.at(-1)"
    browser.until(f"{last}.x.length === 2 && Math.abs({last}.x[1] - {end[0]}) < 0.01")  # not the line before it
    line = np.array(browser.evaluate(f"[{last}.x, {last}.y, {last}.z]")).T
    assert np.allclose(line[0], world.TARGET)
    assert np.allclose(line[1], end, atol=0.01)
    visible = (
        "document.getElementById('scene').data.filter(t => t.meta && t.meta.pose === '{}' && (!{} || t.meta.arm))"
        ".every(t => t.visible === {})"
    )
    browser.until(visible.format("target", "true", "false"))  # the arm is hidden at first
    browser.evaluate("document.getElementById('pose-standoff').click()")
    browser.until(visible.format("standoff", "false", "true"))
    browser.until(visible.format("target", "false", "false"))


def test_the_scene_is_true_to_scale(browser):
    """A millimetre is as long along every axis, whatever is hidden; of itself plotly scales by what is shown."""
    if browser.evaluate("document.getElementById('scene').hidden"):
        pytest.skip("this browser has no WebGL")
    for pose in ("none", "target"):
        browser.evaluate(f"document.getElementById('pose-{pose}').click()")
        drawn = "document.getElementById('scene')._fullLayout.scene"
        ratio, *ranges = json.loads(
            browser.evaluate(
                f"JSON.stringify([{drawn}.aspectratio, ...['x', 'y', 'z'].map(n => {drawn}[n + 'axis'].range)])"
            )
        )
        per_mm = [ratio[axis] / (high - low) for axis, (low, high) in zip("xyz", ranges, strict=True)]
        assert per_mm == pytest.approx([per_mm[0]] * 3)


def test_views_look_where_they_say(browser, case, candidates):
    """Along the needle the camera looks along the chosen direction; axial looks to the head."""
    if browser.evaluate("document.getElementById('scene').hidden"):
        pytest.skip("this browser has no WebGL")
    point_at(browser, case, candidates, 30, 200, click=True)
    row = int(
        np.flatnonzero(np.isclose(candidates.theta, np.radians(30)) & np.isclose(candidates.beta, np.radians(200)))[0]
    )
    for view, expected in (("along", candidates.outward_ct[row]), ("axial", [0, 0, -1]), ("coronal", [0, -1, 0])):
        browser.evaluate(f"document.querySelector('[data-view={view}]').click()")
        camera = browser.evaluate("JSON.stringify(document.getElementById('scene').layout.scene.camera)")
        eye, centre = (np.array([json.loads(camera)[key][axis] for axis in "xyz"]) for key in ("eye", "center"))
        assert np.allclose((eye - centre) / np.linalg.norm(eye - centre), expected, atol=1e-3), view


def test_no_error_and_no_request(browser):
    """After all of the above: nothing on the console, and nothing was asked for but the file itself."""
    assert browser.complaints() == []
    assert len(browser.requests()) == 1 and browser.requests()[0].startswith("file://")
