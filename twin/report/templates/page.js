"use strict";
(() => {
  const map = data.map;
  const config = { displaylogo: false, responsive: true };
  const LEFT = 70, TOP = 60;
  const RAD = Math.PI / 180;
  const RIM_LABEL = 0.95; // of the disc's radius

  // ---- the map -------------------------------------------------------------------------------------------------
  const rows = new Int32Array(map.size * map.size);
  for (let run = 0, at = 0; run < map.runs.length; run += 2) {
    rows.fill(map.runs[run], at, at + map.runs[run + 1]);
    at += map.runs[run + 1];
  }
  document.getElementById("map-image").src = map.image;
  const svg = document.getElementById("map-lines");
  const radiusPx = map.size / 2, cx = LEFT + radiusPx, cy = TOP + radiusPx;

  function draw(tag, attributes, text) {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    if (text !== undefined) element.textContent = text;
    svg.appendChild(element);
    return element;
  }
  function label(x, y, text, attributes) {
    draw("text", {
      x, y, "text-anchor": "middle", "dominant-baseline": "central", "paint-order": "stroke",
      stroke: "#fff", "stroke-width": 3, "font-size": 11, ...attributes,
    }, text);
  }
  function placeAt(theta, beta) {
    const angle = (beta + map.turn_deg) * RAD, radius = theta / map.theta_max_deg * radiusPx;
    return [cx + radius * Math.cos(angle), cy - radius * Math.sin(angle)];
  }
  const place = (row) => placeAt(map.theta[row], map.beta[row]);
  draw("circle", { cx, cy, r: radiusPx, fill: "none", stroke: "#000", "stroke-width": 1.2 });
  const spacing = map.theta_max_deg <= 100 ? 15 : 30;
  for (let beta = 0; beta < 360; beta += 30) {
    const angle = (beta + map.turn_deg) * RAD, c = Math.cos(angle), s = Math.sin(angle);
    draw("line", { x1: cx, y1: cy, x2: cx + radiusPx * c, y2: cy - radiusPx * s, stroke: "#000", "stroke-opacity": 0.25 });
    label(cx + (radiusPx + 22) * c, cy - (radiusPx + 14) * s, `β ${beta}°`, { fill: "#444" });
  }
  for (let theta = spacing; theta <= map.theta_max_deg; theta += spacing) {
    const r = theta / map.theta_max_deg * radiusPx, thick = theta === 90 && map.theta_max_deg > 92 ? 2 : 0.8;
    draw("circle", { cx, cy, r, fill: "none", stroke: "#000", "stroke-opacity": 0.4, "stroke-width": thick });
    const at = Math.min(r, RIM_LABEL * radiusPx); // a ring's angle at the rim stands within it
    label(cx + at * Math.cos(67.5 * RAD), cy - at * Math.sin(67.5 * RAD), `θ ${theta}°`, {});
  }
  for (const rim of map.rim) {
    const c = Math.cos(rim.angle_deg * RAD), s = Math.sin(rim.angle_deg * RAD);
    const x = cx + (radiusPx + 52) * c, y = cy - (radiusPx + 40) * s;
    const side = Math.abs(c) > 0.8 && rim.text.length > 3;
    const turn = side ? { transform: `rotate(${c < 0 ? -90 : 90} ${x} ${y})` } : {};
    label(x, y, rim.text, { "font-size": 16, "font-weight": 700, ...turn });
  }
  document.getElementById("front").textContent = map.front;
  for (const row of map.pareto) {
    const [x, y] = place(row);
    draw("circle", { cx: x, cy: y, r: 1.8, fill: "#fff", stroke: "#000", "stroke-width": 0.6 });
  }
  for (const row of map.best) {
    const [x, y] = place(row);
    draw("circle", { cx: x, cy: y, r: 4.5, fill: "none", stroke: "#000", "stroke-width": 1.2 });
  }
  if (map.picked >= 0) {
    const [x, y] = place(map.picked);
    label(x, y, "★", { "font-size": 26, fill: "#fff", stroke: "#000", "stroke-width": 2.5 });
  }
  const marker = draw("circle", { cx: -9, cy: -9, r: 7, fill: "none", stroke: "#d6001e", "stroke-width": 2.5 });

  function rowAt(event) {
    const box = document.getElementById("map-image").getBoundingClientRect();
    const x = Math.floor((event.clientX - box.left) / box.width * map.size);
    const y = Math.floor((event.clientY - box.top) / box.height * map.size);
    return x < 0 || y < 0 || x >= map.size || y >= map.size ? -1 : rows[y * map.size + x];
  }
  const shown = (value, digits, unit) => value === null ? "–" : `${value.toFixed(digits)}${unit === "°" ? "" : " "}${unit}`.replace("-", "−");

  function chanceWords(chance) { // what is not sure never reads as 0 or 1
    if (chance < 5e-5) return "<0.0001"; // what the page was given is rounded: 0 may be 1e-10
    if (chance > 1 - 5e-5) return ">0.9999";
    return chance.toFixed(chance >= 0.0095 && chance <= 0.99 ? 2 : 4);
  }

  function explain(row) {
    const panel = document.getElementById("hover");
    panel.replaceChildren();
    const add = (tag, text, kind) => {
      const element = document.createElement(tag);
      element.textContent = text;
      if (kind) element.className = kind;
      panel.appendChild(element);
    };
    if (row < 0) { panel.textContent = "Point at the map."; return; }
    if (own && row === chosen) { // what was searched is another path
      add("b", own.title, "verdict bad");
      add("div", own.verdict);
      return;
    }
    const code = map.codes[map.reason[row]], safe = code === "safe";
    add("div", `${row === chosen && !own ? "chosen" : "pointed at"}: ${anglesOf(row)}`);
    add("b", safe ? `${map.safe}${map.rank[row] > 0 ? `, rank ${map.rank[row]}` : ""}` : `rejected: ${map.reasons[map.reason[row]]}`,
      safe ? "verdict" : "verdict bad");
    if (!safe) {
      const structure = map.structures[map.structure[row]], [what, unit] = map.details[map.reason[row]];
      const parts = [`reason ${code}`];
      if (structure) parts.push(structure === map.not_seen ? structure : `structure: ${words(structure)}`);
      if (map.depth[row] !== null) parts.push(`${shown(map.depth[row], 1, "mm")} from the target`);
      if (what === "clearance" && map.amount[row] < 0) parts.push("the needle crosses it");
      else if (map.amount[row] !== null) parts.push(`${what || "amount"} ${shown(map.amount[row], 1, unit || "mm")}`);
      add("div", parts.join("; "));
      const sentence = map.sentences[map.sentence[row]];
      if (sentence) add("div", sentence);
    }
    if (safe && map.window[row] > 0) {
      const cone = map.safe_cone[row] === null ? "" : `; safe cone ${shown(map.safe_cone[row], 1, "°")}`;
      add("div", `window ${map.window[row]}${cone}`);
    }
    if (map.near[row].length) {
      const [place, mm] = map.near[row], name = words(map.structures[place]);
      add("div", mm < 0 ? `crosses ${name}` : `least clearance ${shown(mm, 1, "mm")} (${name})`);
    }
    add("div", `path in the body ${shown(map.path[row], 1, "mm")}; skin angle ${shown(map.skin_angle[row], 0, "°")}`);
    if (map.p_hit && map.p_hit[row] !== null)
      add("div", `chance to hit ${chanceWords(map.p_hit[row])}, to touch a structure to avoid ${chanceWords(map.p_touch_any[row])}${map.touch_refined[row] ? "" : ", to first order"}`);
    add("div", `arm: ${map.reachable[row] === 1 ? "can reach it" : map.reachable[row] === 0 ? "cannot reach it" : map.arm === "checked" ? "not computed, the organs reject it" : map.arm}`);
  }
  const surface = document.getElementById("map");
  surface.addEventListener("mousemove", (event) => { const row = rowAt(event); explain(row < 0 ? chosen : row); });
  surface.addEventListener("mouseleave", () => explain(chosen));
  surface.addEventListener("click", (event) => choose(rowAt(event)));

  // ---- choosing ------------------------------------------------------------------------------------------------
  let chosen = -1;
  const sliders = { theta: byId("theta"), beta: byId("beta") };
  for (const [name, input] of Object.entries(sliders)) {
    const values = [...new Set(map[name].slice(0, map.searched))].sort((a, b) => a - b); // a row more may be beside the grid
    const gaps = values.slice(1).map((value, i) => value - values[i]).filter((gap) => gap > 1e-3);
    input.min = values[0];
    input.max = values[values.length - 1];
    input.step = gaps.length ? Math.min(...gaps).toFixed(5) : 1;
    input.addEventListener("input", () => choose(nearest(+sliders.theta.value, +sliders.beta.value)));
  }
  function nearest(theta, beta) {
    let best = -1, least = Infinity;
    for (let row = 0; row < map.theta.length; row++) {
      const aside = Math.abs((map.beta[row] - beta + 540) % 360 - 180), along = map.theta[row] - theta;
      const distance = along * along + aside * aside;
      if (distance < least) [best, least] = [row, distance];
    }
    return best;
  }
  function choose(row, { needle } = {}) {
    if (row < 0) return;
    chosen = row;
    own = needle ?? null;
    const [theta, beta] = own ? own.angles : [map.theta[row], map.beta[row]];
    sliders.theta.value = theta;
    sliders.beta.value = beta;
    byId("theta-out").value = `${+theta.toFixed(3)}°`;
    byId("beta-out").value = `${+beta.toFixed(3)}°`;
    const verb = !own && map.codes[map.reason[row]] === "safe" ? map.outcome : "check";
    byId("command").textContent = `run-twin ${verb} ${map.file} --theta ${+theta.toFixed(5)} --beta ${+beta.toFixed(5)}`;
    for (const button of document.querySelectorAll("button.pick"))
      button.setAttribute("aria-pressed", String(!own && +button.dataset.row === row));
    for (const note of document.querySelectorAll(".of-first")) {
      note.hidden = map.picked < 0 || (!own && row === map.picked);
      note.querySelector("b").textContent = anglesOf(map.first);
    }
    explain(row);
    probe(row);
    noteArm();
    present(own ?? needleOf(row));
  }
  for (const button of document.querySelectorAll("button.pick"))
    button.addEventListener("click", () => choose(+button.dataset.row));
  for (const button of document.querySelectorAll(".of-first button")) button.addEventListener("click", () => choose(map.picked));
  byId("copy").addEventListener("click", async () => {
    const text = byId("command").textContent;
    try { await navigator.clipboard.writeText(text); }
    catch {
      getSelection().selectAllChildren(byId("command"));
      document.execCommand("copy");
    }
    byId("copy").textContent = "copied";
    setTimeout(() => { byId("copy").textContent = "copy the command"; }, 1500);
  });

  // ---- the slices ----------------------------------------------------------------------------------------------
  const slices = data.slices, { NEAR_MM } = slicing;
  const outwardOf = (row) => [0, 1, 2].map((k) => map.outward[3 * row + k]);
  const anglesOf = (row) => `θ ${+map.theta[row].toFixed(3)}°, β ${+map.beta[row].toFixed(3)}°`;
  const nearOf = (row) => Array.from({ length: map.near[row].length / 2 }, (_, k) => ({ name: map.structures[map.near[row][2 * k]], mm: map.near[row][2 * k + 1] }));
  const verdictOf = (row) => map.codes[map.reason[row]] === "safe" ? map.safe : `rejected: ${map.reasons[map.reason[row]]}`;
  function needleOf(row) {
    const strong = nearOf(row).filter((one) => one.mm < NEAR_MM).map((one) => one.name);
    return {
      key: String(row), at: ORIGIN, outward: outwardOf(row), path: map.path[row] ?? NaN, strong: new Set(strong), row,
      margin: Math.max(0, ...strong.map((name) => slices.margins[name])), region: slices.regions[row], bent: slices.bent[row], title: anglesOf(row),
    };
  }
  const readout = (text) => { byId("cursor").textContent = text || `Point at a slice: ${data.ct ? "Hounsfield units, " : ""}structure, place.`; };
  const view = new slicing.View(byId("slices-a"), { readout, moved: moveNeedle });
  let beside = null, kept = null, own = null;
  const saidOf = (needle) => needle.verdict ?? verdictOf(needle.row);
  function present(needle) {
    view.show(needle);
    byId("slices-of").replaceChildren(make("b", {}, needle.title), ` · ${saidOf(needle)}`);
    byId("slices-of").classList.toggle("bad", Boolean(needle.verdict) || map.codes[map.reason[needle.row]] !== "safe");
    byId("slices-back").hidden = !own;
    slicing.drawUnits(byId("slices-units"), needle);
    showNumbers(needle);
    const named = nearOf(needle.row).filter((one, k) => !k || one.mm < NEAR_MM);
    const colourOf = Object.fromEntries(slicing.parts.map((part) => [part.name, part.colour]));
    const target = slicing.parts.find((part) => part.target);
    byId("slices-legend").replaceChildren(...[
      ["needle", "#00e5ff"], ["target", "#d6001e"], ...(needle.region || kept?.region ? [["95 % region of the tip", "#ff4df0"]] : []),
      ...(needle.bent ? [["range of bending by the bevel", "#b6ff00"]] : []), ...(target ? [[words(target.name), target.colour]] : []),
      ...(own ? [] : named.map((one) => [`${words(one.name)}: ${clearanceText(one.mm)}, margin ${slices.margins[one.name]}`, colourOf[one.name] ?? "#80808c"])),
    ].map(([name, colour]) => {
      const patch = make("span", { class: "patch" });
      patch.style.backgroundColor = colour;
      return make("li", {}, patch, name);
    }));
    byId("slices-notes").replaceChildren(...[
      slicing.voxelNote, slicing.surfaceNote,
      `Needle as thick as it is; dashed: with the greatest margin near it${needle.margin ? `, ${needle.margin} mm` : ""}. Beads: the edge of what is unknown.`,
      Object.keys(slices.bent).length && !needle.bent ? "The range of bending by the bevel is drawn only for the planned or best direction." : "",
    ].filter(Boolean).map((note) => make("div", slicing.coarse && note === slicing.surfaceNote ? { class: "bad" } : {}, note)));
  }
  const { halfVoxel } = slicing; // lengths have the digits that a voxel can carry
  const doubted = (mm) => halfVoxel === null ? `${mm.toFixed(1)} mm` : halfVoxel < 1 ? `${mm.toFixed(1)} ± ${halfVoxel.toFixed(1)} mm` : `${mm.toFixed(0)} ± ${Math.ceil(halfVoxel)} mm`;
  const clearanceText = (mm) => mm < 0 ? "crossed" : doubted(mm);
  function placesOf(needle) { // of a path, for whoever stands at the scanner
    const entry = plus(needle.at, needle.outward, needle.path), [left, back, head] = needle.outward, degrees = (radians) => `${Math.abs(radians / RAD).toFixed(1)}°`;
    const rows = [["skin entry", Number.isFinite(needle.path) ? slicing.placeText(entry) : needle.verdict ? "not on this page" : "none"], ["path in the body", Number.isFinite(needle.path) ? doubted(needle.path) : "–"]];
    const reaching = slices.catalogue.find(([, longest]) => longest >= needle.path);
    if (slices.catalogue.length && Number.isFinite(needle.path)) rows.push(["needle to take", reaching ? `${reaching[0]} mm, the shortest that reaches` : "none reaches"]);
    if (map.space === "local") return rows;
    if (slices.numbers && Number.isFinite(needle.path)) {
      const [[a, b, c, d], count] = slices.numbers, [x, y, z] = plus(entry, data.target), number = Math.round(a * x + b * y + c * z + d);
      rows.push(
        ["slice of the entry", number >= 1 && number <= count ? `${number} of ${count} from the feet, ${count + 1 - number} from the head` : "outside of the image"],
        ["table position", `z = ${z.toFixed(1)} mm, as DICOM has it`.replace("-", "−")],
        ["laser lines", `${Math.abs(x).toFixed(0)} mm to the ${x > 0 ? "left" : "right"} of the sagittal one, ${Math.abs(y).toFixed(0)} mm ${y > 0 ? "behind" : "in front of"} the coronal one, if x = y = 0 is the isocentre`]);
    }
    const inPlane = Math.atan2(left, -back), out = Math.asin(head), side = (angle, one, other) => Math.abs(angle) < 0.05 * RAD ? "" : angle > 0 ? one : other;
    return [...rows,
      ["in-plane angle", Math.hypot(left, back) > 1e-6 ? `${degrees(inPlane)} from the front${side(inPlane, ", hub to the left", ", hub to the right")}` : "none: the needle runs along the patient"],
      ["out-of-plane angle", degrees(out) + side(out, ", hub toward the head", ", hub toward the feet")]];
  }
  function numbersOf(needle) {
    const { row } = needle, near = nearOf(row)[0];
    if (needle.verdict) return [["verdict", needle.verdict], ...placesOf(needle)];
    return [["verdict", verdictOf(row)], ["rank", map.rank[row] > 0 ? String(map.rank[row]) : "–"], ["window", map.window[row] > 0 ? String(map.window[row]) : "–"],
      ["nearest structure", near ? `${words(near.name)}: ${clearanceText(near.mm)}` : "–"],
      ...(map.p_hit && map.p_hit[row] !== null ? [["chance to hit", chanceWords(map.p_hit[row])], ["chance to touch, at most", chanceWords(map.p_touch_any[row])]] : []),
      ["safe cone", shown(map.safe_cone[row], 1, "°")], ["angle at the skin", shown(map.skin_angle[row], 0, "°")], ...placesOf(needle)];
  }
  function showNumbers(needle) {
    const columns = [...(kept ? [["A, kept", kept]] : []), [kept ? "B, chosen" : "chosen", needle]];
    const texts = columns.map(([, one]) => new Map(numbersOf(one))), names = [...new Set(texts.flatMap((one) => [...one.keys()]))];
    const row = (tag, first, cells) => make("tr", {}, make(tag, {}, first), ...cells.map((text) => make(tag === "th" ? "th" : "td", {}, text)));
    byId("slices-numbers").replaceChildren(
      make("thead", {}, row("th", "", columns.map(([name, one]) => `${name}: ${one.title}`))),
      make("tbody", {}, ...names.map((name) => row("td", name, texts.map((one) => one.get(name) ?? "–")))));
  }
  function toward(outward) { // the searched direction nearest to another
    let best = 0, most = -2;
    for (let row = 0; row < map.theta.length; row++) {
      const along = map.outward[3 * row] * outward[0] + map.outward[3 * row + 1] * outward[1] + map.outward[3 * row + 2] * outward[2];
      if (along > most) [best, most] = [row, along];
    }
    return [best, Math.acos(Math.min(1, most)) / RAD];
  }
  function moveNeedle({ at, outward, frame }) {
    const moved = Math.sqrt(dot(at, at)), length = slicing.pathFrom(at, outward);
    const [row, away] = toward(outward), strong = nearOf(row).filter((one) => one.mm < NEAR_MM).map((one) => one.name);
    const entry = Number.isFinite(length) ? `from ${slicing.placeText(plus(at, outward, length))}` : "whose skin entry is not on this page";
    const [x, y, z] = [0, 1, 2].map((k) => dot([map.frame[k], map.frame[3 + k], map.frame[6 + k]], outward));
    const angles = [Math.atan2(Math.hypot(x, y), z) / RAD, (Math.atan2(y, x) / RAD + 360) % 360];
    const verdict = moved > 0.05
      ? `not known: the target was moved by ${slicing.lengthText(moved)} to ${slicing.placeText(at)}, and nothing was searched for it`
      : `not known for this path; the nearest searched direction (${anglesOf(row)}, ${away.toFixed(1)}° away) is ${verdictOf(row)}`;
    choose(row, { needle: { key: `own ${at} ${outward}`, at, outward, angles, path: length, frame, row, strong: new Set(strong), margin: Math.max(0, ...strong.map((name) => slices.margins[name])), title: `your path ${entry}`, verdict } });
    const plain = (point) => point.map((mm, k) => (k < 2 && map.space === "RAS" ? -mm : mm).toFixed(1)).join(",");
    if (moved > 0.05) byId("command").textContent = `run-twin check ${map.file} --targets FILE.csv  # name,x_mm,y_mm,z_mm: moved,${plain(plus(at, data.target))}`;
  }
  byId("slices-back").addEventListener("click", () => choose(chosen));
  byId("slices-centre").addEventListener("click", () => { for (const one of [view, beside]) if (one) { one.point = one.ruler = null; one.later(); } });
  byId("slices-keep").addEventListener("click", () => {
    kept = kept ? null : { ...view.needle, frame: undefined };
    byId("slices-keep").textContent = kept ? "let go of path A" : "keep this path beside the next";
    byId("slices-kept").hidden = !kept;
    byId("slices-paths").classList.toggle("both", Boolean(kept));
    if (kept) {
      beside ??= new slicing.View(byId("slices-b"), { readout, moved: null });
      beside.show(kept);
      byId("slices-kept-of").textContent = `A: ${kept.title} · ${saidOf(kept)}`;
    }
    showNumbers(view.needle);
  });
  const pressed = (group, act) => {
    for (const button of document.querySelectorAll(`#${group} button[aria-pressed]`))
      button.addEventListener("click", () => {
        for (const other of document.querySelectorAll(`#${group} button[aria-pressed]`)) other.setAttribute("aria-pressed", String(other === button));
        act(button.dataset);
        view.later();
        beside?.later();
      });
  };
  pressed("tones", ({ tone }) => slicing.setTone(tone));
  pressed("modes", ({ mode }) => {
    slicing.shared.mode = mode;
    byId("slices-paths").dataset.mode = mode;
  });
  readout("");

  // ---- the scene -----------------------------------------------------------------------------------------------
  const scene = byId("scene3d");
  let probing = null, probed = null, inSight = false;
  const probeTrace = data.scene.data.length - 1;
  function hasWebgl() {
    const canvas = document.createElement("canvas");
    return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
  }
  const drawn = hasWebgl(), axes = data.scene.layout.scene;
  const ranges = ["xaxis", "yaxis", "zaxis"].map((name) => axes[name].range);
  const middle = ranges.map(([low, high]) => (low + high) / 2);
  const unit = Math.cbrt(ranges.reduce((product, [low, high]) => product * (high - low), 1)); // plotly's, in mm
  const whole = axes.camera;
  const xyz = (a) => ({ x: a[0], y: a[1], z: a[2] });
  const VIEWS = { axial: [[0, 0, -1], [0, -1, 0]], coronal: [[0, -1, 0], [0, 0, 1]], sagittal: [[1, 0, 0], [0, 0, 1]] };
  const SEEN_MM = 420, PER_MM = 1 / 0.83; // plotly's lens shows 0.83 of its distance
  const firstOutward = map.picked >= 0 ? outwardOf(map.picked) : null;
  function cameraOf(view) {
    const outward = own ? own.outward : chosen >= 0 ? outwardOf(chosen) : firstOutward;
    if (view === "all" || (!outward && !VIEWS[view])) return whole;
    const top = normed([whole.up.x, whole.up.y, whole.up.z]);
    let toward, up = top, about = data.target;
    if (VIEWS[view]) [toward, up] = VIEWS[view];
    else {
      const tall = Math.abs(dot(top, outward)) < 0.95 ? top : [0, 0, 1];
      const rise = normed(plus(tall, outward, -dot(tall, outward)));
      up = rise;
      const side = [outward[1] * rise[2] - outward[2] * rise[1], outward[2] * rise[0] - outward[0] * rise[2], outward[0] * rise[1] - outward[1] * rise[0]];
      toward = view === "along" ? outward : normed(plus(plus(outward, side, 0.5), rise, 0.35));
      about = view === "along" ? about : plus(about, outward, 0.25 * data.probe_mm);
    }
    const centre = plus(plus([0, 0, 0], about, 1 / unit), middle, -1 / unit);
    const far = (view === "along" ? 0.8 : 1) * SEEN_MM * PER_MM / unit;
    return { up: xyz(up), center: xyz(centre), eye: xyz(plus(centre, toward, far)) };
  }
  if (drawn) {
    const layout = data.scene.layout;
    axes.camera = cameraOf("entry");
    if (innerWidth < 700) {
      layout.showlegend = false;
      axes.domain = { x: [0, 1] };
    }
    Plotly.newPlot(scene, data.scene.data, layout, config);
  } else {
    scene.hidden = true;
    byId("scene-failed").hidden = false;
  }
  for (const button of document.querySelectorAll("#views button"))
    button.addEventListener("click", () => {
      if (!drawn) return;
      if (button.dataset.view === "all" && byId("pose-none").getAttribute("aria-pressed") === "true") byId("pose-target").click();
      Plotly.relayout(scene, { "scene.camera": cameraOf(button.dataset.view) });
    });
  function probe(row) {
    if (row < 0) return;
    const [x, y] = place(row);
    marker.setAttribute("cx", x);
    marker.setAttribute("cy", y);
    if (!drawn) return;
    const { at, outward } = own ?? { at: ORIGIN, outward: outwardOf(row) }, tip = plus(data.target, at), hub = plus(tip, outward, data.probe_mm);
    probed = { x: [[tip[0], hub[0]]], y: [[tip[1], hub[1]]], z: [[tip[2], hub[2]]] };
    follow();
  }
  // ---- the arm of the chosen direction: its links are moved by the frames that ``link_poses`` gives in Python -----------
  const { arm } = data, moving = !arm ? [] : data.scene.data.flatMap((trace, index) => {
    if (trace.meta?.pose !== "target" || !trace.meta.frame) return [];
    const floats = ({ bdata }) => new Float32Array(Uint8Array.from(atob(bdata), (c) => c.charCodeAt(0)).buffer);
    return [{ index, frame: trace.meta.frame, at: ["x", "y", "z"].map((axis) => floats(trace[axis])) }];
  });
  const toCt = (vector, origin = 0) => [0, 1, 2].reduce((sum, k) => plus(sum, arm.base[k], vector[k]), scaled(arm.base[3], origin));
  function framesOf(q) { // axes and origin of base and links, CT frame: Rz(q) Tz(d) Tx(a) Rx(alpha) each
    const [d1, a2, a3, d4, d5, d6] = arm.lengths, found = [[[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]]];
    q.forEach((angle, joint) => {
      const [x, y, z, origin] = found[joint], c = Math.cos(angle), s = Math.sin(angle);
      const a = [0, a2, a3, 0, 0, 0][joint], d = [d1, 0, 0, d4, d5, d6][joint], turn = [1, 0, 0, 1, -1, 0][joint];
      const along = plus(scaled(x, c), y, s), across = plus(scaled(y, c), x, -s);
      const [up, out] = turn ? [scaled(z, turn), scaled(across, -turn)] : [across, z];
      found.push([along, up, out, plus(plus(origin, along, a), z, d)]);
    });
    return found.map((frame) => frame.map((vector, k) => toCt(vector, k === 3 ? 1 : 0)));
  }
  const jointsOf = () => own ? null : chosen === map.first ? arm?.first : arm?.q[chosen];
  let armOf = map.first; // the row whose arm the scene shows
  function moveArm() {
    const q = jointsOf(), row = q ? chosen : map.first; // what the arm does not reach has the first direction's
    if (!moving.length || !arm || armOf === row) return;
    const before = framesOf(arm.first), after = framesOf(q ?? arm.first);
    const moved = moving.map(({ frame, at }) => {
      const [from, to] = [before[frame], after[frame]], found = at.map((values) => new Float32Array(values.length));
      for (let v = 0; v < at[0].length; v++) {
        const away = plus([at[0][v], at[1][v], at[2][v]], from[3], -1);
        const [x, y, z] = [0, 1, 2].reduce((sum, k) => plus(sum, to[k], dot(away, from[k])), to[3]);
        found[0][v] = x, found[1][v] = y, found[2][v] = z;
      }
      return found;
    });
    const axis = (k) => moved.map((found) => found[k]);
    Plotly.restyle(scene, { x: axis(0), y: axis(1), z: axis(2) }, moving.map(({ index }) => index));
    armOf = row;
  }
  function noteArm() { // standoff is of the plan alone
    const follows = jointsOf() && byId("pose-standoff").getAttribute("aria-pressed") !== "true";
    document.querySelector(".of-scene").hidden = map.picked < 0 || follows || (!own && chosen === map.first);
  }
  function follow() { // the scene is drawn again when it is in sight and the pointer rests: the slices follow at once
    clearTimeout(probing);
    if (inSight && probed) probing = setTimeout(() => { Plotly.restyle(scene, probed, [probeTrace]); probed = null; moveArm(); }, 60);
  }
  new IntersectionObserver((entries) => { inSight = entries.at(-1).isIntersecting; follow(); }).observe(scene);
  const traces = (wanted) => data.scene.data.flatMap((trace, i) => trace.meta && wanted(trace.meta) ? [i] : []);
  const poses = { none: byId("pose-none"), target: byId("pose-target"), standoff: byId("pose-standoff") };
  byId("poses").hidden = traces((meta) => meta.arm).length === 0;
  if (!traces((meta) => meta.pose === "standoff").length) byId("pose-standoff").hidden = true; // after a search: no motion is planned
  for (const [pose, button] of Object.entries(poses))
    button.addEventListener("click", () => {
      for (const other of Object.values(poses)) other.setAttribute("aria-pressed", String(other === button));
      noteArm();
      if (!drawn) return;
      const show = (visible, wanted) => { const found = traces(wanted); if (found.length) Plotly.restyle(scene, { visible }, found); };
      show(pose === "standoff", (meta) => meta.pose === "standoff");
      show(pose !== "standoff", (meta) => meta.pose === "target" && !meta.arm);
      show(pose === "target", (meta) => meta.pose === "target" && meta.arm);
    });
  choose(map.first);

  document.body.dataset.ready = "true";
})();
