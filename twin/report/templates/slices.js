"use strict";
/* The slices: the page's block of the CT and the surfaces in it, cut in any plane as slices.png is.
   Points are LPS mm from the case's target. Pixels are those of slices.png; lines are drawn twice as fine. */
const byId = (id) => document.getElementById(id);
const words = (name) => data.slices.names[name] ?? name.replaceAll("_", " ");
const make = (tag, attributes = {}, ...children) => {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
};
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, times = 1) => [a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]];
const scaled = (a, times) => [a[0] * times, a[1] * times, a[2] * times];
const normed = (a) => scaled(a, 1 / Math.sqrt(dot(a, a)));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const ORIGIN = [0, 0, 0];

const slicing = (() => {
  const facts = data.slices;
  const PIXELS = 480, FINE = 2;
  const GROUND = 0xff362f2c, HATCH = 0xff7a716a, NEEDLE = "#00e5ff", REGION = "#ff4df0", BENT = "#b6ff00", TARGET = "#d6001e";
  const NEAR_MM = 30, LEAST_HALF_MM = 60, BESIDE_MM = 35, PROBE_HALF_MM = 40, ALONG_LEFT = 0.95, OBLIQUE = 0.38, IN_PLANE = 1e-3;
  const LEFT = [1, 0, 0], BACK = [0, 1, 0], HEAD = [0, 0, 1], FRONT = [0, -1, 0];

  // ---- what the page holds: beyond this box surfaces are coarse, not drawn, and nothing is read off them ------------
  const [LOW, HIGH] = facts.box;
  const holdsPoint = (point) => point.every((mm, axis) => mm >= LOW[axis] && mm <= HIGH[axis]);
  /* From where to where a line is in the box, in steps of its direction. */
  function within(start, along) {
    let from = -Infinity, to = Infinity;
    for (let axis = 0; axis < 3; axis++) {
      if (Math.abs(along[axis]) < 1e-12) {
        if (start[axis] < LOW[axis] || start[axis] > HIGH[axis]) return [0, -1];
        continue;
      }
      const ends = [LOW[axis], HIGH[axis]].map((mm) => (mm - start[axis]) / along[axis]);
      from = Math.max(from, Math.min(...ends));
      to = Math.min(to, Math.max(...ends));
    }
    return [from, to];
  }

  // ---- the block of the CT -----------------------------------------------------------------------------------
  const interpolated = (value, from, to) => {
    let k = 1;
    while (k < from.length - 1 && value > from[k]) k++;
    return to[k - 1] + (value - from[k - 1]) / (from[k] - from[k - 1]) * (to[k] - to[k - 1]);
  };
  const [knotsHu, knotsByte] = facts.knots;
  const huOf = Float64Array.from({ length: 256 }, (_, byte) => interpolated(byte, knotsByte, knotsHu));
  const lossy = facts.ct?.strips, off = lossy ? 2 * facts.ct.rms_bytes : 0.5; // of a byte: half a step, or two standard deviations
  const huAt = (byte) => interpolated(Math.min(255, Math.max(0, byte)), knotsByte, knotsHu);
  const doubtOf = (byte) => Math.max(huOf[byte] - huAt(byte - off), huAt(byte + off) - huOf[byte]);
  const ct = facts.ct && data.ct && (() => {
    const differences = new Uint8Array(data.ct), values = lossy ? differences : new Uint8Array(differences.length);
    const [nx, ny, nz] = facts.ct.shape, row = nx, slab = nx * ny;
    if (!lossy) for (let k = 0, at = 0; k < nz; k++)
      for (let j = 0; j < ny; j++)
        for (let i = 0; i < nx; i++, at++) {
          const before = (i ? values[at - 1] : 0) + (j ? values[at - row] : 0) + (k ? values[at - slab] : 0);
          values[at] = differences[at] + Math.floor(before / 3);
        }
    const T = facts.ct.T, columns = [0, 1, 2].map((c) => [T[c], T[4 + c], T[8 + c]]);
    const volume = dot(columns[0], cross(columns[1], columns[2]));
    const inverse = [[1, 2], [2, 0], [0, 1]].map(([a, b]) => scaled(cross(columns[a], columns[b]), 1 / volume));
    const start = inverse.map((one) => dot(one, plus(data.target, [T[3], T[7], T[11]], -1)));
    return { values, nx, ny, nz, inverse, start, image: facts.ct.image };
  })();
  /* The byte at an index; -1 where the image ends, -2 where only the page's block does. */
  function byteAt(x, y, z) {
    const i = Math.round(x), j = Math.round(y), k = Math.round(z);
    if (i >= 0 && j >= 0 && k >= 0 && i < ct.nx && j < ct.ny && k < ct.nz) return ct.values[i + ct.nx * (j + ct.ny * k)];
    const [low, high] = ct.image;
    return x >= low[0] && y >= low[1] && z >= low[2] && x <= high[0] && y <= high[1] && z <= high[2] ? -2 : -1;
  }
  const byteOf = (point) => byteAt(...ct.inverse.map((one, axis) => dot(one, point) + ct.start[axis]));

  // ---- the surfaces ------------------------------------------------------------------------------------------
  const parts = (() => {
    const unit = facts.surfaces.unit_mm, bytes = new Uint8Array(data.surfaces), found = [];
    let at = 0;
    const planes = (count, width) => { // the lowest byte of all, then the next of all
      const values = new Int32Array(count);
      for (let shift = 0; shift < 8 * width; shift += 8) for (let i = 0; i < count; i++) values[i] |= bytes[at++] << shift;
      return values;
    };
    for (const part of facts.surfaces.parts) {
      const n = part.corners, steps = planes(3 * n, 2);
      const corner = new Float32Array(3 * n), low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
      for (let axis = 0; axis < 3; axis++)
        for (let v = 0, whole = 0; v < n; v++) {
          whole = (whole + steps[axis * n + v]) << 16 >> 16; // differences wrap as 16 bits do
          const mm = corner[3 * v + axis] = whole * unit;
          low[axis] = Math.min(low[axis], mm);
          high[axis] = Math.max(high[axis], mm);
        }
      found.push({ ...part, corner, low, high, height: new Float32Array(n) });
    }
    for (const part of found) {
      let newest = 0;
      part.faces = planes(3 * part.triangles, 3).map((below) => below ? newest - below : newest++);
    }
    return found;
  })();
  const skin = parts.find((part) => part.role === "skin"), open = parts.some((part) => part.role !== "unknown" && !part.closed);
  /* Segments in which a plane cuts a surface: x1, y1, x2, y2 of each, mm in the plane; first those to be drawn. */
  function cut(part, plane) {
    const { normal, right, up } = plane, offset = dot(plane.at, normal) + plane.offset, { corner, faces, height } = part;
    const reach = [0, 1, 2].reduce((sum, k) => sum + Math.abs(normal[k]) * (part.high[k] - part.low[k]) / 2, 0);
    const middle = [0, 1, 2].map((k) => (part.low[k] + part.high[k]) / 2);
    if (Math.abs(dot(middle, normal) - offset) > reach + 1e-6) return Object.assign([], { drawn: 0 });
    for (let v = 0; v < height.length; v++)
      height[v] = corner[3 * v] * normal[0] + corner[3 * v + 1] * normal[1] + corner[3 * v + 2] * normal[2] - offset;
    const x0 = dot(plane.at, right), y0 = dot(plane.at, up), segments = [];
    segments.drawn = -1;
    for (let f = 0; f < faces.length; f += 3) {
      if (f === 3 * part.drawn) segments.drawn = segments.length;
      const a = height[faces[f]] > 0, b = height[faces[f + 1]] > 0, c = height[faces[f + 2]] > 0;
      if (a === b && b === c) continue;
      const alone = a === b ? 2 : a === c ? 1 : 0, tip = faces[f + alone];
      for (let k = 1; k < 3; k++) {
        const other = faces[f + (alone + k) % 3], along = height[tip] / (height[tip] - height[other]);
        let x = -x0, y = -y0;
        for (let axis = 0; axis < 3; axis++) {
          const mm = corner[3 * tip + axis] * (1 - along) + corner[3 * other + axis] * along;
          x += mm * right[axis];
          y += mm * up[axis];
        }
        segments.push(x, y);
      }
    }
    if (segments.drawn < 0) segments.drawn = segments.length;
    return segments;
  }
  function holds(segments, x, y) {
    let inside = false;
    for (let s = 0; s < segments.length; s += 4) {
      const y1 = segments[s + 1], y2 = segments[s + 3];
      if ((y1 > y) !== (y2 > y) && x < segments[s] + (y - y1) / (y2 - y1) * (segments[s + 2] - segments[s])) inside = !inside;
    }
    return inside;
  }
  /* Where a ray leaves or enters a surface, mm from its start, sorted. */
  function crossings(part, start, along) {
    const found = [], { corner, faces } = part;
    const side = normed(cross(along, Math.abs(along[0]) < 0.8 ? LEFT : BACK)), rise = cross(along, side);
    const flat = new Float64Array(3 * (corner.length / 3));
    for (let v = 0; v < corner.length; v += 3) {
      const from = [corner[v] - start[0], corner[v + 1] - start[1], corner[v + 2] - start[2]];
      flat[v] = dot(from, side);
      flat[v + 1] = dot(from, rise);
      flat[v + 2] = dot(from, along);
    }
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      let odd = false;
      for (const [p, q] of [[a, b], [b, c], [c, a]]) {
        const v1 = flat[p + 1], v2 = flat[q + 1];
        if ((v1 > 0) !== (v2 > 0) && 0 < flat[p] - v1 / (v2 - v1) * (flat[q] - flat[p])) odd = !odd;
      }
      if (!odd) continue;
      const [ux, uy] = [flat[b] - flat[a], flat[b + 1] - flat[a + 1]], [vx, vy] = [flat[c] - flat[a], flat[c + 1] - flat[a + 1]];
      const area = ux * vy - uy * vx, s = (-flat[a] * vy + flat[a + 1] * vx) / area, t = (-ux * flat[a + 1] + uy * flat[a]) / area;
      found.push(flat[a + 2] + s * (flat[b + 2] - flat[a + 2]) + t * (flat[c + 2] - flat[a + 2]));
    }
    return found.sort((one, other) => one - other);
  }
  /* Target to skin, mm; NaN where the page does not hold the entry. */
  function pathFrom(at, outward) {
    const path = crossings(skin, at, outward).find((mm) => mm > 0) ?? NaN;
    return holdsPoint(at) && holdsPoint(plus(at, outward, path)) ? path : NaN;
  }

  // ---- the planes --------------------------------------------------------------------------------------------
  const tiltOf = (right, up) => (Math.acos(Math.min(1, Math.abs(cross(right, up)[2]))) * 180 / Math.PI).toFixed(0);
  function planesOf({ at, outward, path }) {
    const far = Number.isFinite(path) ? path : 0, half = Math.max(LEAST_HALF_MM, far / 2 + BESIDE_MM);
    const toward = dot(outward, LEFT);
    let side = LEFT, up;
    if (Math.abs(toward) < ALONG_LEFT) {
      up = normed(plus(outward, LEFT, -toward));
      if (dot(up, HEAD) - 1.2 * dot(up, BACK) <= 0) up = scaled(up, -1);
    } else {
      side = toward > 0 ? outward : scaled(outward, -1);
      up = normed(plus(FRONT, side, -dot(FRONT, side)));
    }
    let across = cross(side, up);
    if (dot(across, HEAD) - 0.8 * dot(across, BACK) <= 0) across = scaled(across, -1);
    const along = dot(outward, BACK) > 0 ? outward : scaled(outward, -1);
    const into = scaled(outward, -1), top = Math.abs(dot(into, HEAD)) < ALONG_LEFT ? HEAD : FRONT;
    const rise = normed(plus(top, into, -dot(top, into)));
    const plane = (name, right, up, half) => ({
      name, at, right, up, half, offset: 0, normal: cross(right, up), centre: [dot(right, outward) * far / 2, dot(up, outward) * far / 2],
    });
    return [
      plane("axial, through the target", LEFT, FRONT, half),
      plane(`along the needle, ${tiltOf(side, up)}° from axial`, side, up, half),
      plane(`along the needle, ${tiltOf(along, across)}° from axial`, along, across, half),
      plane("across the needle at the target", cross(into, rise), rise, PROBE_HALF_MM),
    ];
  }
  function lettersOf(direction) {
    return namedAxes(direction).map(({ letter }) => letter).join(" ");
  }
  const towardText = (direction) => namedAxes(direction).map(({ toward }) => toward).join(" and ");
  function namedAxes(direction) {
    const seen = facts.letters.map(([letter, toward, axis]) => ({ letter, toward, part: dot(axis, direction) }));
    return seen.sort((a, b) => b.part - a.part).slice(0, 2).filter(({ part }) => part > OBLIQUE);
  }
  /* The cut of all within a radius of a piece of the needle's axis that begins at the target, at the plane's offset. */
  function capsule(outward, length, radius, plane) {
    const u = dot(outward, plane.right), v = dot(outward, plane.up), sine = Math.hypot(u, v), slope = dot(outward, plane.normal);
    const along = sine > 1e-9 ? [u / sine, v / sine] : [1, 0], o = plane.offset;
    const nearest = (a) => Math.min(length, Math.max(0, a * sine + o * slope));
    const left = (a) => { const s = nearest(a); return radius * radius - (a - s * sine) ** 2 - (o - s * slope) ** 2; };
    const s0 = Math.abs(slope) > 1e-12 ? Math.min(length, Math.max(0, o / slope)) : 0, a0 = s0 * sine;
    if (left(a0) <= 0) return [];
    const end = (sign) => {
      let inside = a0, outside = a0 + sign * (length + 2 * radius + Math.abs(o) + radius / Math.max(Math.abs(slope), 1e-6));
      for (let k = 0; k < 60; k++) {
        const middle = (inside + outside) / 2;
        if (left(middle) > 0) inside = middle; else outside = middle;
      }
      return inside;
    };
    const low = end(-1), high = end(1), STEPS = 90, upper = [], lower = [];
    for (let k = 0; k <= STEPS; k++) {
      const a = (low + high) / 2 - (high - low) / 2 * Math.cos(Math.PI * k / STEPS), b = Math.sqrt(Math.max(0, left(a)));
      upper.push([a * along[0] - b * along[1], a * along[1] + b * along[0]]);
      lower.push([a * along[0] + b * along[1], a * along[1] - b * along[0]]);
    }
    return [...upper, ...lower.reverse()];
  }
  /* The cut of the region x' inv(R) x = 1; R is its upper triangle. */
  function ellipse([xx, xy, xz, yy, yz, zz], plane) {
    const columns = [[xx + 1e-9, xy, xz], [xy, yy + 1e-9, yz], [xz, yz, zz + 1e-9]];
    const adjoint = [cross(columns[1], columns[2]), cross(columns[2], columns[0]), cross(columns[0], columns[1])];
    const volume = dot(columns[0], adjoint[0]), axes = [plane.right, plane.up, plane.normal];
    const M = axes.map((a) => axes.map((b) => adjoint.reduce((sum, one, k) => sum + b[k] * dot(one, a), 0) / volume));
    const o = plane.offset, area = M[0][0] * M[1][1] - M[0][1] ** 2;
    const middle = [-o * (M[1][1] * M[0][2] - M[0][1] * M[1][2]) / area, -o * (M[0][0] * M[1][2] - M[0][1] * M[0][2]) / area];
    const left = 1 - o * o * M[2][2] - o * (M[0][2] * middle[0] + M[1][2] * middle[1]);
    if (left <= 0) return [];
    const l11 = Math.sqrt(M[0][0]), l21 = M[0][1] / l11, l22 = Math.sqrt(Math.max(1e-12, M[1][1] - l21 * l21)), size = Math.sqrt(left);
    return Array.from({ length: 121 }, (_, k) => {
      const turn = 2 * Math.PI * k / 120, y = size * Math.sin(turn) / l22;
      return [middle[0] + (size * Math.cos(turn) - l21 * y) / l11, middle[1] + y];
    });
  }

  // ---- drawing -----------------------------------------------------------------------------------------------
  let tone = Object.keys(facts.tones)[0];
  function drawCt(canvas, plane) {
    const context = canvas.getContext("2d"), picture = context.createImageData(PIXELS, PIXELS);
    const shade = new Uint32Array(picture.data.buffer), [level, width] = facts.tones[tone];
    const grey = Uint32Array.from(huOf, (hu) => {
      const value = Math.round(255 * Math.min(1, Math.max(0, (hu - level) / width + 0.5)));
      return 0xff000000 | value << 16 | value << 8 | value;
    });
    const step = 2 * plane.half / PIXELS, first = 0.5 - PIXELS / 2, across = scaled(plane.right, step);
    const index = (point) => ct.inverse.map((one) => dot(one, point));
    const base = plus(plus(plane.at, plane.normal, plane.offset), plane.right, plane.centre[0] + first * step);
    const corner = plus(base, plane.up, plane.centre[1] - first * step), dx = ct && index(across);
    for (let row = 0, at = 0; row < PIXELS; row++) {
      const start = plus(corner, plane.up, -row * step), [from, to] = within(start, across), begin = ct && plus(index(start), ct.start);
      for (let column = 0; column < PIXELS; column++, at++) {
        const byte = column < from || column > to ? -2 : ct ? byteAt(begin[0] + column * dx[0], begin[1] + column * dx[1], begin[2] + column * dx[2]) : 0;
        shade[at] = byte === -1 ? 0xff000000 : byte === -2 ? ((row + column & 7) > 1 ? GROUND : HATCH) : ct ? grey[byte] : GROUND;
      }
    }
    context.putImageData(picture, 0, 0);
  }
  const SCALES_MM = [5, 10, 20, 50, 100, 200, 500];
  function drawOver(canvas, plane, needle, extra) {
    const context = canvas.getContext("2d"), per = PIXELS / (2 * plane.half);
    context.setTransform(FINE, 0, 0, FINE, 0, 0);
    context.clearRect(0, 0, PIXELS, PIXELS);
    context.lineCap = context.lineJoin = "round";
    const px = (x) => PIXELS / 2 + (x - plane.centre[0]) * per, py = (y) => PIXELS / 2 - (y - plane.centre[1]) * per;
    const stroke = (colour, width, dash = []) => {
      context.setLineDash(dash);
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.stroke();
    };
    const trace = (points) => {
      context.beginPath();
      points.forEach(([x, y], k) => (k ? context.lineTo(px(x), py(y)) : context.moveTo(px(x), py(y))));
    };
    const write = (text, x, y, size, align, base, weight = "") => {
      context.font = `${weight} ${size}px "DejaVu Sans", system-ui, sans-serif`;
      context.textAlign = align;
      context.textBaseline = base;
      context.setLineDash([]);
      context.lineWidth = 3.2;
      context.strokeStyle = "#000";
      context.strokeText(text, x, y);
      context.fillStyle = "#fff";
      context.fillText(text, x, y);
    };
    const cuts = parts.map((part) => cut(part, plane));
    parts.forEach((part, p) => {
      const segments = cuts[p];
      context.beginPath();
      if (part.role === "unknown") {
        const cell = 0.025 * plane.half, seen = new Set();
        for (let s = 0; s < segments.drawn; s += 4) {
          const [x1, y1, x2, y2] = segments.slice(s, s + 4), steps = 1 + Math.floor(Math.hypot(x2 - x1, y2 - y1) / cell);
          for (let k = 0; k <= steps; k++) {
            const x = x1 + (x2 - x1) * k / steps, y = y1 + (y2 - y1) * k / steps, key = `${Math.round(x / cell)} ${Math.round(y / cell)}`;
            if (seen.has(key)) continue;
            seen.add(key);
            context.moveTo(px(x) + 2, py(y));
            context.arc(px(x), py(y), 2, 0, 7);
          }
        }
        context.fillStyle = part.colour;
        context.fill();
        return;
      }
      for (let s = 0; s < segments.drawn; s += 4) {
        context.moveTo(px(segments[s]), py(segments[s + 1]));
        context.lineTo(px(segments[s + 2]), py(segments[s + 3]));
      }
      stroke(part.colour, part === skin ? 1.6 : part.target || needle.strong.has(part.name) ? 2.5 : 1.1);
    });
    const { outward } = needle, { shaft, radius } = facts.needle, path = Number.isFinite(needle.path) ? needle.path : shaft;
    if (needle.margin > 0) {
      trace(capsule(outward, path, radius + needle.margin, plane));
      stroke(NEEDLE, 1.3, [4.8, 2.1]);
    }
    if (needle.region) {
      trace(ellipse(needle.region, plane));
      stroke("#000", 3.5);
      stroke(REGION, 1.7);
    }
    trace(capsule(outward, shaft, radius, plane));
    context.fillStyle = NEEDLE;
    context.fill();
    if (needle.bent) {
      const off = Math.abs(needle.bent[needle.bent.length - 1][1]), u = [dot(outward, plane.right), dot(outward, plane.up)];
      if (Math.abs(dot(outward, plane.normal)) > IN_PLANE) { trace(capsule(outward, path, off, plane)); stroke(BENT, 1.3); }
      else if (Math.abs(plane.offset) < 0.5)
        for (const sign of [1, -1]) {
          trace(needle.bent.map(([s, a]) => [s * u[0] - sign * a * u[1], s * u[1] + sign * a * u[0]]));
          stroke("#000", 3.5);
          stroke(BENT, 1.7);
        }
    }
    const aside = dot(plus(plane.at, needle.at, -1), plane.normal) + plane.offset;
    if (Math.abs(aside) <= 0.5) {
      const [x, y] = [dot(plus(needle.at, plane.at, -1), plane.right), dot(plus(needle.at, plane.at, -1), plane.up)];
      for (const [a, b] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        trace([0.03, 0.09].map((far) => [x + far * plane.half * a, y + far * plane.half * b]));
        context.lineCap = "butt";
        stroke(TARGET, 2.4);
      }
    }
    if (extra.point) {
      const [x, y] = [dot(plus(extra.point, plane.at, -1), plane.right), dot(plus(extra.point, plane.at, -1), plane.up)];
      for (const [a, b] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        trace([0.05, 3].map((far) => [x + far * plane.half * a, y + far * plane.half * b]));
        stroke("#ffe14d", 1);
      }
    }
    if (extra.ruler) {
      const [[x1, y1], [x2, y2]] = extra.ruler;
      trace(extra.ruler);
      stroke("#000", 4);
      stroke("#fff", 1.8);
      write(lengthText(Math.hypot(x2 - x1, y2 - y1)), px((x1 + x2) / 2), py((y1 + y2) / 2) - 8, 14, "center", "bottom", "bold");
    }
    for (const handle of extra.handles ?? []) {
      context.beginPath();
      context.arc(px(handle[0]), py(handle[1]), 9, 0, 7);
      stroke("#000", 4);
      stroke("#fff", 2);
    }
    const [middle, far] = [PIXELS / 2, PIXELS - 7];
    const tip = plus(needle.at, plane.at, -1), hub = plus(tip, outward, shaft), shadow = [tip, hub].map((p) => [px(dot(p, plane.right)), py(dot(p, plane.up))]);
    for (const [x, y, direction, align, base] of [
      [far, middle, plane.right, "right", "middle"], [7, middle, scaled(plane.right, -1), "left", "middle"],
      [middle, 7, plane.up, "center", "top"], [middle, far, scaled(plane.up, -1), "center", "bottom"],
    ]) {
      const along = base === "middle" ? 1 : 0, across = 1 - along, from = [x, y][across];
      const part = (from - shadow[0][across]) / (shadow[1][across] - shadow[0][across]); // where the needle leaves the picture there
      const off = shadow[0][along] + part * (shadow[1][along] - shadow[0][along]) - middle, beside = part >= 0 && part <= 1 && Math.abs(off) < 24;
      const aside = beside ? off + (off > 0 ? -24 : 24) : 0;
      write(lettersOf(direction), along ? x : x + aside, along ? y + aside : y, 16, align, base, "bold");
    }
    const length = SCALES_MM.filter((mm) => mm <= 0.34 * 2 * plane.half).pop() ?? SCALES_MM[0];
    const [left, low] = [plane.centre[0] - 0.94 * plane.half, plane.centre[1] - 0.93 * plane.half];
    context.lineCap = "butt";
    trace([[left, low], [left + length, low]]);
    stroke("#000", 6);
    stroke("#fff", 4);
    write(`${length} mm`, 0.03 * PIXELS, PIXELS - 0.035 * PIXELS - 8, 12, "left", "bottom");
    return cuts;
  }
  const voxel = facts.ct ? Math.max(...facts.ct.shown_mm) : 0;
  const lengthText = (mm) => `${mm.toFixed(voxel >= 1 ? 0 : 1)} mm`;

  /* How the needle lies to a plane: of one that is not in it only the cut is drawn. */
  function leaning(plane, needle) {
    const lean = dot(needle.outward, plane.normal), tip = dot(plus(needle.at, plane.at, -1), plane.normal) - plane.offset;
    const far = tip + (Math.abs(lean) <= IN_PLANE ? 0 : lean * needle.path), side = towardText(scaled(plane.normal, Math.sign(far)));
    if (Math.abs(lean) <= IN_PLANE) return Math.abs(far) < 0.5 ? "The needle lies in this plane." : `The needle is ${lengthText(Math.abs(far))} from this plane, ${side}.`;
    return Number.isFinite(far) ? `The skin entry is ${lengthText(Math.abs(far))} from this plane, ${side}.` : "";
  }

  // ---- one path in four planes ---------------------------------------------------------------------------------
  const shared = { mode: "point" };
  class View {
    constructor(host, { moved, readout }) {
      Object.assign(this, { host, moved, readout, point: null, needle: null, ruler: null, under: null });
      this.panels = [0, 1, 2, 3].map((number) => {
        const base = make("canvas", { class: "ct", width: PIXELS, height: PIXELS });
        const over = make("canvas", { class: "over", width: FINE * PIXELS, height: FINE * PIXELS, role: "img" });
        const caption = make("span"), beside = make("span", { class: "faint" });
        const depth = make("input", { type: "range", min: -150, max: 150, step: 1, value: 0 }), shown = make("output");
        host.append(make("figure", {}, make("figcaption", {}, caption, make("br"), beside), make("div", { class: "slice" }, base, over),
          make("label", { class: "depth" }, depth, shown)));
        depth.addEventListener("input", () => this.scroll(number, +depth.value));
        over.addEventListener("wheel", (event) => {
          if (!this.needle) return;
          event.preventDefault();
          this.scroll(number, this.panels[number].plane.offset - Math.sign(event.deltaY) * Math.max(1, voxel));
        }, { passive: false });
        over.addEventListener("pointermove", (event) => this.pointed(number, event));
        over.addEventListener("pointerleave", () => { this.under = null; this.readout(""); });
        over.addEventListener("pointerdown", (event) => this.pressed(number, event));
        for (const end of ["pointerup", "pointercancel"])
          over.addEventListener(end, () => {
            if (this.held?.what) this.show({ ...this.needle, frame: undefined }); // planes of the new path
            this.held = null;
          });
        return { base, over, caption, beside, depth, shown };
      });
    }
    show(needle) {
      if (this.needle && this.needle.key !== needle.key) this.point = this.ruler = null;
      this.needle = needle;
      this.later();
    }
    later() {
      this.waiting ??= requestAnimationFrame(() => { this.waiting = null; this.draw(); });
    }
    draw() {
      const began = performance.now(), { needle } = this, planes = planesOf(needle.frame ?? needle);
      this.panels.forEach((panel, number) => {
        const plane = panel.plane = planes[number];
        plane.offset = this.point ? dot(plus(this.point, plane.at, -1), plane.normal) : 0;
        drawCt(panel.base, plane);
        const handles = shared.mode === "move" && this.moved ? [needle.at, plus(needle.at, needle.outward, needle.path || facts.needle.shaft)].map((p) => this.inPlane(plane, p)) : [];
        const ruler = this.ruler?.number === number ? this.ruler.ends : null;
        panel.cuts = drawOver(panel.over, plane, needle, { point: this.point, ruler, handles });
        const off = plane.offset, side = towardText(scaled(plane.normal, Math.sign(off) || 1));
        panel.caption.textContent = off ? `${plane.name.replace(/, through the target| at the target/, "")}, ${lengthText(Math.abs(off))} from the target, ${side}` : plane.name;
        panel.beside.textContent = leaning(plane, needle);
        panel.depth.value = off;
        panel.shown.textContent = `${off.toFixed(0)} mm`.replace("-", "−");
        panel.depth.setAttribute("aria-label", `${plane.name}: mm from the target`);
        panel.over.setAttribute("aria-label", `${panel.caption.textContent}: needle, outlines and target, ${needle.title}`);
      });
      if (this.under) this.read(); // the pointer rests: what is under it has changed
      this.host.dataset.drawn = needle.key;
      this.host.dataset.tone = tone;
      this.host.dataset.ms = (performance.now() - began).toFixed(0);
    }
    inPlane(plane, point) {
      const from = plus(point, plane.at, -1);
      return [dot(from, plane.right), dot(from, plane.up)];
    }
    scroll(number, mm) {
      const { plane } = this.panels[number];
      this.point = plus(this.point ?? plane.at, plane.normal, mm - plane.offset);
      if (dot(plus(this.point, plane.at, -1), plus(this.point, plane.at, -1)) < 1e-6) this.point = null;
      this.later();
    }
    at(number, event) {
      const { plane, over } = this.panels[number], box = over.getBoundingClientRect();
      const x = plane.centre[0] + ((event.clientX - box.left) / box.width * 2 - 1) * plane.half;
      const y = plane.centre[1] - ((event.clientY - box.top) / box.height * 2 - 1) * plane.half;
      return { plane, x, y, point: (offset) => plus(plus(plus(plane.at, plane.right, x), plane.up, y), plane.normal, offset) };
    }
    pressed(number, event) {
      const { plane, x, y } = this.at(number, event), { needle } = this;
      this.panels[number].over.setPointerCapture(event.pointerId);
      this.held = { number, start: [x, y] };
      if (shared.mode === "move" && this.moved) {
        const entry = plus(needle.at, needle.outward, needle.path || facts.needle.shaft);
        const far = [needle.at, entry].map((p) => { const [a, b] = this.inPlane(plane, p); return Math.hypot(a - x, b - y); });
        if (Math.min(...far) > 0.1 * plane.half) this.held = null;
        else Object.assign(this.held, { what: far[0] <= far[1] ? "target" : "entry", frame: needle.frame ?? { at: needle.at, outward: needle.outward, path: needle.path } });
      }
      this.pointed(number, event);
    }
    pointed(number, event) {
      if (!this.needle) return;
      const { plane, x, y, point } = this.at(number, event), { held, needle } = this;
      this.under = [number, { clientX: event.clientX, clientY: event.clientY }];
      if (held?.number === number) {
        if (shared.mode === "point") { this.point = point(plane.offset); this.later(); }
        if (shared.mode === "measure") { this.ruler = { number, ends: [held.start, [x, y]] }; this.later(); }
        if (held.what) {
          const entry = plus(needle.at, needle.outward, needle.path || facts.needle.shaft);
          const depth = (one) => dot(plus(one, plane.at, -1), plane.normal);
          const at = held.what === "target" ? point(depth(needle.at)) : needle.at, end = held.what === "entry" ? point(depth(entry)) : entry;
          this.moved({ at, outward: normed(plus(end, at, -1)), frame: held.frame });
        }
      }
      this.read();
    }
    read() {
      const [number, event] = this.under, { plane, x, y, point } = this.at(number, event);
      this.readout(textAt(this.panels[number], x, y, point(plane.offset), this.needle));
    }
  }
  function placeText(point) { // in the case's own space, from the image's origin
    const [x, y, z] = plus(point, data.target), flip = data.map.space === "RAS" ? -1 : 1;
    return `(${[flip * x, flip * y, z].map((mm) => (mm + 0).toFixed(voxel >= 1 ? 0 : 1)).join(", ")}) mm ${data.map.space}`.replaceAll("-", "−");
  }
  function huText(byte) {
    if (byte === -1) return "the image ends";
    if (byte === -2) return "not on this page";
    if (byte === 0) return `at most ${huOf[0]} HU, or not measured`.replace("-", "−");
    if (byte === 255) return `at least ${huOf[255]} HU`;
    return `${huOf[byte].toFixed(0)} ± ${Math.ceil(doubtOf(byte))} HU`.replace("-", "−");
  }
  function textAt(panel, x, y, point, needle) {
    const inside = parts.filter((part, p) => part !== skin && part.closed && holds(panel.cuts[p], x, y)).map((part) => words(part.name));
    const none = open ? "in no closed structure" : "in no structure"; // an open surface has no inside
    const where = inside.join(", ") || (!skin.closed || holds(panel.cuts[parts.indexOf(skin)], x, y) ? none : "outside of the skin");
    const from = plus(point, needle.at, -1);
    const read = holdsPoint(point) ? [...(ct ? [huText(byteOf(point))] : []), where] : [huText(-2)];
    return [...read, placeText(point), `${lengthText(Math.sqrt(dot(from, from)))} from the target`].join(" · ");
  }

  // ---- the units along the needle --------------------------------------------------------------------------------
  function drawUnits(canvas, needle) {
    const width = canvas.width = Math.max(320, Math.min(976, canvas.parentElement.clientWidth)), narrow = width < 600;
    const BEHIND = 15, BEYOND = 25, ROW = 20, TOP = 12, NAMES = 20, BELOW = 44; // pixels: of a bar, above all, of words in the plot, below it
    const path = Number.isFinite(needle.path) ? needle.path : facts.needle.shaft, end = path + BEYOND;
    const reach = within(needle.at, needle.outward), held = ([a, b]) => [Math.max(-BEHIND, reach[0], a), Math.min(end, reach[1], b)];
    const passed = parts.filter((part) => part !== skin && part.role !== "unknown").map((part) => {
      const at = crossings(part, needle.at, needle.outward).filter((mm) => mm > -400);
      const inside = [];
      if (!part.closed) for (const mm of at) inside.push(held([mm - 0.5, mm + 0.5])); // of a surface without an inside: where it is crossed
      else for (let k = at.length - 1; k >= 0; k -= 2) inside.push(held([at[k - 1] ?? -BEHIND, at[k]]));
      return { part, inside: inside.filter(([a, b]) => b > a) };
    }).filter(({ inside }) => inside.length).sort((one, other) => Math.max(...other.inside.map(([, b]) => b)) - Math.max(...one.inside.map(([, b]) => b)));
    const count = Math.max(1, passed.length), height = canvas.height = ct ? 330 : TOP + NAMES + count * ROW + BELOW, context = canvas.getContext("2d");
    const rowHeight = ct ? Math.min(ROW, 0.5 * height / count) : ROW, left = narrow ? 110 : 190, right = width - 14, bottom = height - BELOW;
    const split = bottom - rowHeight * count, top = TOP;
    const px = (mm) => left + (end - mm) / (end + BEHIND) * (right - left);
    context.fillStyle = "#fff";
    context.fillRect(0, 0, width, height);
    context.font = '12px "DejaVu Sans", system-ui, sans-serif';
    const write = (text, x, y, align) => { context.fillStyle = "#222"; context.textAlign = align; context.textBaseline = "middle"; context.fillText(text, x, y); };
    const line = (colour, width, dash, ...points) => {
      context.beginPath();
      points.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
      context.setLineDash(dash);
      Object.assign(context, { strokeStyle: colour, lineWidth: width });
      context.stroke();
    };
    for (const [a, b] of [[-BEHIND, Math.min(end, reach[0])], [Math.max(-BEHIND, reach[1]), end]]) {
      if (b <= a) continue;
      context.fillStyle = "#e3e3e3";
      context.fillRect(px(b), top, px(a) - px(b), bottom - top);
      if (px(a) - px(b) > 110) write("not on this page", (px(a) + px(b)) / 2, (split + bottom) / 2, "center");
    }
    if (ct) {
      const [low, high] = [-1050, 500], py = (hu) => split - 8 - (Math.min(high, Math.max(low, hu)) - low) / (high - low) * (split - 8 - top);
      for (const hu of [-1000, -500, 0, 500]) { line("#e5e5e5", 1, [], [left, py(hu)], [right, py(hu)]); write(`${hu} HU`.replace("-", "−"), left - 8, py(hu), "right"); }
      let run = [];
      for (let mm = -BEHIND; mm <= end; mm += 0.5) {
        const byte = mm < reach[0] || mm > reach[1] ? -2 : byteOf(plus(needle.at, needle.outward, mm));
        if (byte >= 0) run.push([px(mm + 0.25), py(huOf[byte])], [px(mm - 0.25), py(huOf[byte])]);
        else { if (run.length) line("#262626", 1.7, [], ...run); run = []; }
      }
      if (run.length) line("#262626", 1.7, [], ...run);
    }
    passed.forEach(({ part, inside }, number) => {
      const y = split + (number + 0.5) * rowHeight;
      context.fillStyle = part.colour;
      for (const [a, b] of inside) context.fillRect(px(b), y - 0.37 * rowHeight, px(a) - px(b), 0.74 * rowHeight);
      write(words(part.name), left - 8, y, "right");
    });
    line(TARGET, 1.9, [], [px(0), top], [px(0), bottom]);
    if (Number.isFinite(needle.path)) { line("#000", 1.3, [5, 3], [px(path), top], [px(path), bottom]); write("skin", px(path) + 6, top + 8, "left"); }
    write("target", px(0) + 6, top + 8, "left");
    for (let mm = 0; mm <= end; mm += narrow ? 50 : 25) write(String(mm), px(mm), bottom + 12, "center");
    write(narrow ? "mm from the target (right: deeper)" : "mm from the target along the needle (left: outside; right of the target: deeper)", (left + right) / 2, bottom + 32, "center");
  }

  const coarse = facts.surfaces.off_mm > 0.5;
  function voxelNote() {
    if (!facts.ct) return "The case has no CT: only the outlines of the structures.";
    if (!ct) return "This browser alters pictures that a page reads, so no CT is shown: only the outlines of the structures. Allow the page to read its canvas, or see slices.png.";
    const size = (mm) => `${mm.map((one) => +one.toFixed(2)).join(" × ")} mm`, { shown_mm, voxel_mm, rms_hu, worst_hu } = facts.ct;
    const means = shown_mm.some((mm, axis) => mm !== voxel_mm[axis]) ? `means over ${size(shown_mm)} (its voxels: ${size(voxel_mm)})` : `its own voxels, ${size(voxel_mm)}`;
    return lossy ? `CT: ${means}, packed with loss so that it fits this page: soft tissue is off by ${Math.ceil(rms_hu)} HU (rms), at edges by up to ${Math.ceil(worst_hu)} HU. The cursor's ± is two standard deviations.`
      : "The CT's nearest voxels, not smoothed; HU rounded as the cursor says.";
  }

  return {
    View, drawUnits, pathFrom, placeText, lengthText, shared, parts, NEAR_MM,
    voxelNote: voxelNote(),
    surfaceNote: `Outlines: the checked surfaces to ${facts.surfaces.off_mm.toFixed(2)} mm${coarse ? ", coarser than they were checked, so that they fit this page; slices.png has them as they are" : ""}. Hatched: not on this page.`,
    coarse,
    halfVoxel: facts.ct ? Math.max(...facts.ct.voxel_mm) / 2 : null,
    setTone(name) { tone = name; },
  };
})();
