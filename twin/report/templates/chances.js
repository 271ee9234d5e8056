"use strict";
(() => {
  const map = JSON.parse(document.getElementById("data").textContent).map;
  const rows = new Int32Array(map.size * map.size);
  for (let run = 0, at = 0; run < map.runs.length; run += 2) {
    rows.fill(map.runs[run], at, at + map.runs[run + 1]);
    at += map.runs[run + 1];
  }
  const shown = (chance) => chance < 5e-5 && chance > 0 ? "<0.0001" : chance.toFixed(chance < 0.01 || chance > 0.99 ? 4 : 2);
  document.getElementById("map").addEventListener("mousemove", (event) => {
    const box = document.getElementById("map-image").getBoundingClientRect();
    const x = Math.floor((event.clientX - box.left) / box.width * map.size);
    const y = Math.floor((event.clientY - box.top) / box.height * map.size);
    const row = x < 0 || y < 0 || x >= map.size || y >= map.size ? -1 : rows[y * map.size + x];
    if (row < 0 || map.p_hit[row] === null) return;
    const line = document.createElement("div");
    line.textContent = `chance to hit ${shown(map.p_hit[row])}, to touch anything forbidden ${shown(map.p_touch_any[row])}`;
    document.getElementById("hover").appendChild(line);
  });
})();
