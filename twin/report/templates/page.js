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
  const half = map.size / 2, cx = LEFT + half, cy = TOP + half;

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
    const angle = (beta + map.turn_deg) * RAD, radius = theta / map.theta_max_deg * half;
    return [cx + radius * Math.cos(angle), cy - radius * Math.sin(angle)];
  }
  const place = (row) => placeAt(map.theta[row], map.beta[row]);
  draw("circle", { cx, cy, r: half, fill: "none", stroke: "#000", "stroke-width": 1.2 });
  const spacing = map.theta_max_deg <= 100 ? 15 : 30;
  for (let beta = 0; beta < 360; beta += 30) {
    const angle = (beta + map.turn_deg) * RAD, c = Math.cos(angle), s = Math.sin(angle);
    draw("line", { x1: cx, y1: cy, x2: cx + half * c, y2: cy - half * s, stroke: "#000", "stroke-opacity": 0.25 });
    label(cx + (half + 22) * c, cy - (half + 14) * s, `β ${beta}°`, { fill: "#444" });
  }
  for (let theta = spacing; theta <= map.theta_max_deg; theta += spacing) {
    const r = theta / map.theta_max_deg * half, thick = theta === 90 && map.theta_max_deg > 92 ? 2 : 0.8;
    draw("circle", { cx, cy, r, fill: "none", stroke: "#000", "stroke-opacity": 0.4, "stroke-width": thick });
    const at = Math.min(r, RIM_LABEL * half); // a ring's angle at the rim stands within it
    label(cx + at * Math.cos(67.5 * RAD), cy - at * Math.sin(67.5 * RAD), `θ ${theta}°`, {});
  }
  for (const rim of map.rim) {
    const c = Math.cos(rim.angle_deg * RAD), s = Math.sin(rim.angle_deg * RAD);
    const x = cx + (half + 52) * c, y = cy - (half + 40) * s;
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
  if (map.chosen) {
    const [x, y] = placeAt(map.chosen.theta_deg, map.chosen.beta_deg);
    label(x, y, "★", { "font-size": 26, fill: "#fff", stroke: "#000", "stroke-width": 2.5 });
  }
  const marker = draw("circle", { cx: -9, cy: -9, r: 7, fill: "none", stroke: "#d6001e", "stroke-width": 2.5 });

  function rowAt(event) {
    const box = document.getElementById("map-image").getBoundingClientRect();
    const x = Math.floor((event.clientX - box.left) / box.width * map.size);
    const y = Math.floor((event.clientY - box.top) / box.height * map.size);
    return x < 0 || y < 0 || x >= map.size || y >= map.size ? -1 : rows[y * map.size + x];
  }
  const words = (name) => name.replaceAll("_", " ");
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
    const code = map.codes[map.reason[row]], safe = code === "safe";
    add("div", `θ ${+map.theta[row].toFixed(3)}°, β ${+map.beta[row].toFixed(3)}°`);
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
    if (map.nearest[row] >= 0) {
      const name = words(map.structures[map.nearest[row]]);
      add("div", map.clearance[row] < 0 ? `crosses ${name}` : `least clearance ${shown(map.clearance[row], 1, "mm")} (${name})`);
    }
    add("div", `path in the body ${shown(map.path[row], 1, "mm")}; skin angle ${shown(map.skin_angle[row], 0, "°")}`);
    if (map.p_hit && map.p_hit[row] !== null)
      add("div", `chance to hit ${chanceWords(map.p_hit[row])}, to touch anything forbidden ${chanceWords(map.p_touch_any[row])}${map.touch_refined[row] ? "" : ", to first order"}`);
    add("div", `arm: ${map.reachable[row] === 1 ? "can reach it" : map.reachable[row] === 0 ? "cannot reach it" : map.arm === "checked" ? "not computed, the organs reject it" : map.arm}`);
  }
  const surface = document.getElementById("map");
  surface.addEventListener("mousemove", (event) => { const row = rowAt(event); explain(row < 0 ? chosen : row); });
  surface.addEventListener("mouseleave", () => explain(chosen));
  surface.addEventListener("click", (event) => choose(rowAt(event)));

  // ---- choosing ------------------------------------------------------------------------------------------------
  let chosen = -1;
  const byId = (id) => document.getElementById(id);
  const sliders = { theta: byId("theta"), beta: byId("beta") };
  for (const [name, input] of Object.entries(sliders)) {
    const values = [...new Set(map[name])].sort((a, b) => a - b);
    const gaps = values.slice(1).map((value, i) => value - values[i]).filter((gap) => gap > 1e-3);
    input.min = values[0];
    input.max = values[values.length - 1];
    input.step = gaps.length ? Math.min(...gaps).toFixed(3) : 1;
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
  function choose(row) {
    if (row < 0) return;
    chosen = row;
    const [theta, beta] = [+map.theta[row].toFixed(3), +map.beta[row].toFixed(3)];
    sliders.theta.value = theta;
    sliders.beta.value = beta;
    byId("theta-out").value = `${theta}°`;
    byId("beta-out").value = `${beta}°`;
    const verb = map.codes[map.reason[row]] === "safe" ? map.outcome : "check";
    byId("command").textContent = `run-twin ${verb} ${map.file} --theta ${theta} --beta ${beta}`;
    for (const button of document.querySelectorAll("button.pick"))
      button.setAttribute("aria-pressed", String(+button.dataset.row === row));
    explain(row);
    probe(row);
    showSlices(theta, beta);
  }
  for (const button of document.querySelectorAll("button.pick"))
    button.addEventListener("click", () => choose(+button.dataset.row));
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
  const slices = data.slices.directions;
  const make = (tag, attributes = {}, ...children) => {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  };
  let shownSlices = -1;
  function showSlices(theta, beta) {
    if (!slices.length) return;
    const same = (one) => Math.abs(one.theta_deg - theta) < 2e-3 && Math.abs(one.beta_deg - beta) < 2e-3;
    const found = slices.findIndex(same), which = found < 0 ? Math.max(shownSlices, 0) : found;
    const one = slices[which], place = `θ ${+one.theta_deg.toFixed(3)}°, β ${+one.beta_deg.toFixed(3)}°`;
    const line = byId("slices-of");
    line.classList.toggle("bad", found < 0);
    line.replaceChildren(make("b", {}, place));
    if (found < 0) line.append(make("br"), `Not of the direction that you chose (θ ${theta}°, β ${beta}°): slices come with the page for the planned or best direction and the best of each window. For yours: `,
      make("code", {}, `run-twin check ${map.file} --theta ${theta} --beta ${beta} --picture slices.png`));
    if (which === shownSlices) return;
    shownSlices = which;
    byId("slices-panels").replaceChildren(...one.panels.map((panel) => make("figure", {},
      make("figcaption", {}, panel.name),
      make("div", { class: "slice" },
        ...(panel.ct ? [make("img", { class: "ct", src: panel.ct, alt: "" })] : []),
        make("img", { class: "over", src: panel.over, alt: `${panel.name}: needle, outlines and target, ${place}` })))));
    byId("slices-units").hidden = !one.units;
    if (one.units) byId("slices-units").src = one.units;
    byId("slices-legend").replaceChildren(...one.legend.map(([name, colour]) => {
      const patch = make("span", { class: "patch" });
      patch.style.backgroundColor = colour;
      return make("li", {}, patch, name);
    }));
    byId("slices-notes").replaceChildren(...one.notes.map((note) => make("div", {}, note)));
  }
  const filters = byId("tone-filters");
  for (const [name, values] of Object.entries(filters ? data.slices.tones : {})) {
    const svgNode = (tag, attributes) => {
      const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
      for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
      return element;
    };
    const filter = svgNode("filter", { id: `tone-${name}`, "color-interpolation-filters": "sRGB" });
    const transfer = svgNode("feComponentTransfer", {});
    for (const channel of "RGB") transfer.append(svgNode(`feFunc${channel}`, { type: "table", tableValues: values.join(" ") }));
    filter.append(transfer);
    filters.append(filter);
  }
  for (const button of document.querySelectorAll("#tones button"))
    button.addEventListener("click", () => {
      byId("slices-panels").dataset.tone = button.dataset.tone;
      for (const other of document.querySelectorAll("#tones button"))
        other.setAttribute("aria-pressed", String(other === button));
    });

  // ---- the scene -----------------------------------------------------------------------------------------------
  const scene = byId("scene");
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
  const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
  const plus = (a, b, times) => a.map((value, i) => value + times * b[i]);
  const normed = (a) => plus([0, 0, 0], a, 1 / Math.sqrt(dot(a, a)));
  const xyz = (a) => ({ x: a[0], y: a[1], z: a[2] });
  const VIEWS = { axial: [[0, 0, -1], [0, -1, 0]], coronal: [[0, -1, 0], [0, 0, 1]], sagittal: [[1, 0, 0], [0, 0, 1]] };
  const SEEN_MM = 420, PER_MM = 1 / 0.83; // plotly's lens shows 0.83 of its distance
  const outwardOf = (row) => [0, 1, 2].map((k) => map.outward[3 * row + k]);
  const firstOutward = chosenOutward();
  function chosenOutward() {
    const row = map.picked >= 0 ? map.picked : map.chosen ? nearest(map.chosen.theta_deg, map.chosen.beta_deg) : -1;
    return row < 0 ? null : outwardOf(row);
  }
  function cameraOf(view) {
    const outward = chosen >= 0 ? outwardOf(chosen) : firstOutward;
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
    const end = plus(data.target, outwardOf(row), data.probe_mm);
    Plotly.restyle(scene, {
      x: [[data.target[0], end[0]]], y: [[data.target[1], end[1]]], z: [[data.target[2], end[2]]],
    }, [probeTrace]);
  }
  const traces = (wanted) => data.scene.data.flatMap((trace, i) => trace.meta && wanted(trace.meta) ? [i] : []);
  const poses = { none: byId("pose-none"), target: byId("pose-target"), standoff: byId("pose-standoff") };
  byId("poses").hidden = traces((meta) => meta.arm).length === 0;
  for (const [pose, button] of Object.entries(poses))
    button.addEventListener("click", () => {
      for (const other of Object.values(poses)) other.setAttribute("aria-pressed", String(other === button));
      if (!drawn) return;
      const show = (visible, wanted) => { const found = traces(wanted); if (found.length) Plotly.restyle(scene, { visible }, found); };
      show(pose === "standoff", (meta) => meta.pose === "standoff");
      show(pose !== "standoff", (meta) => meta.pose === "target" && !meta.arm);
      show(pose === "target", (meta) => meta.pose === "target" && meta.arm);
    });
  if (slices.length) showSlices(slices[0].theta_deg, slices[0].beta_deg);
  if (map.picked >= 0) choose(map.picked);

  document.body.dataset.ready = "true";
})();
