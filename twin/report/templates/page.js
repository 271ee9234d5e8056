"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const map = data.map;
  const config = { displaylogo: false, responsive: true };
  const LEFT = 70, TOP = 60;
  const RAD = Math.PI / 180;

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
    label(cx + r * Math.cos(67.5 * RAD), cy - r * Math.sin(67.5 * RAD), `θ ${theta}°`, {});
  }
  for (const rim of map.rim) {
    const c = Math.cos(rim.angle_deg * RAD), s = Math.sin(rim.angle_deg * RAD);
    const x = cx + (half + 52) * c, y = cy - (half + 40) * s;
    const side = Math.abs(c) > 0.8 && rim.text.length > 3;
    const turn = side ? { transform: `rotate(${c < 0 ? -90 : 90} ${x} ${y})` } : {};
    label(x, y, rim.text, { "font-size": 16, "font-weight": 700, ...turn });
  }
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
      if (structure) parts.push(`structure: ${words(structure)}`);
      if (map.depth[row] !== null) parts.push(`${shown(map.depth[row], 1, "mm")} from the target`);
      if (map.amount[row] !== null) parts.push(`${what || "amount"} ${shown(map.amount[row], 1, unit || "mm")}`);
      add("div", parts.join("; "));
      const sentence = map.sentences[map.sentence[row]];
      if (sentence) add("div", sentence);
    }
    if (safe && map.window[row] > 0) {
      const cone = map.safe_cone[row] === null ? "" : `; safe cone ${shown(map.safe_cone[row], 1, "°")}`;
      add("div", `window ${map.window[row]}${cone}`);
    }
    if (map.nearest[row] >= 0)
      add("div", `least clearance ${shown(map.clearance[row], 1, "mm")} (${words(map.structures[map.nearest[row]])})`);
    add("div", `path in the body ${shown(map.path[row], 1, "mm")}; skin angle ${shown(map.skin_angle[row], 0, "°")}`);
    add("div", `arm: ${map.reachable[row] === 1 ? "can reach it" : map.reachable[row] === 0 ? "cannot reach it" : map.arm === "checked" ? "not computed, the organs reject it" : map.arm}`);
  }
  const surface = document.getElementById("map");
  surface.addEventListener("mousemove", (event) => explain(rowAt(event)));
  surface.addEventListener("click", (event) => probe(rowAt(event)));

  // ---- the scene -----------------------------------------------------------------------------------------------
  const scene = document.getElementById("scene");
  const probeTrace = data.scene.data.length - 1;
  function hasWebgl() {
    const canvas = document.createElement("canvas");
    return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
  }
  const drawn = hasWebgl();
  if (drawn) Plotly.newPlot(scene, data.scene.data, data.scene.layout, config);
  else {
    scene.hidden = true;
    document.getElementById("scene-failed").hidden = false;
  }
  function probe(row) {
    if (row < 0) return;
    const [x, y] = place(row);
    marker.setAttribute("cx", x);
    marker.setAttribute("cy", y);
    if (!drawn) return;
    const end = [0, 1, 2].map((k) => data.target[k] + data.probe_mm * map.outward[3 * row + k]);
    Plotly.restyle(scene, {
      x: [[data.target[0], end[0]]], y: [[data.target[1], end[1]]], z: [[data.target[2], end[2]]],
    }, [probeTrace]);
  }
  const poses = { target: document.getElementById("pose-target"), standoff: document.getElementById("pose-standoff") };
  const having = (pose) => data.scene.data.flatMap((t, i) => t.meta && t.meta.pose === pose ? [i] : []);
  for (const [pose, button] of Object.entries(poses)) {
    button.hidden = having("standoff").length === 0;
    button.addEventListener("click", () => {
      for (const other of Object.keys(poses)) {
        poses[other].classList.toggle("on", other === pose);
        if (drawn) Plotly.restyle(scene, { visible: other === pose }, having(other));
      }
    });
  }

  // ---- the charts ----------------------------------------------------------------------------------------------
  for (const name of ["distance", "clearance"]) {
    const place = document.getElementById(`chart-${name}`);
    if (data.charts) Plotly.newPlot(place, data.charts[name].data, data.charts[name].layout, { ...config, displayModeBar: false });
    else place.hidden = true;
  }
})();
