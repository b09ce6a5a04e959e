"use strict";
// Plays motions: one scene and two plots over time for each element of class "motion".

const SVG = "http://www.w3.org/2000/svg";

function add(parent, kind, attributes, text) {
  const element = document.createElementNS(SVG, kind);
  for (const [key, value] of Object.entries(attributes || {})) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  parent.append(element);
  return element;
}

function change(element, attributes) {
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
}

// The last sample at or before t; of two at one instant the later one.
function find(times, t) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t) low = middle; else high = middle - 1;
  }
  return low;
}

// Values at t, straight between samples; those of the earlier one where a later one has none.
function blend(times, rows, t) {
  const k = find(times, t);
  if (k + 1 >= times.length) return rows[k];
  const share = Math.min(1, (t - times[k]) / (times[k + 1] - times[k]));
  const mix = (a, b) => (a === null || b === null ? a : a + share * (b - a));
  const [a, b] = [rows[k], rows[k + 1]];
  return Array.isArray(a) ? a.map((value, i) => mix(value, b[i])) : mix(a, b);
}

// What a contact does at t: where it is, its normal, its forces; null where it does not press.
function during(motion, own, t) {
  const k = find(motion.t, t);
  const span = own.spans.find((one) => one.first <= k && k < one.first + one.c.length);
  if (!span) return null;
  const i = k - span.first, next = Math.min(i + 1, span.c.length - 1);
  const share = next > i ? Math.min(1, (t - motion.t[k]) / (motion.t[k + 1] - motion.t[k])) : 0;
  const mix = (rows) => rows[i].map((value, j) => value + share * (rows[next][j] - value));
  const [point, normal, [c_n, c_t]] = [mix(span.point), mix(span.normal), mix(span.c)];
  const force = [c_n * normal[0] + c_t * normal[1], c_n * normal[1] - c_t * normal[0]];
  return { point, normal, force, c_n };
}

function place(motion, z) {
  const [c, s] = [Math.cos(z[2]), Math.sin(z[2])];
  return motion.vertices.map(([u, v]) => [z[0] + c * u - s * v, z[1] + s * u + c * v]);
}

const join = (points) => points.map((p) => p.map((v) => v.toPrecision(6)).join(",")).join(" ");

function tip(finger, angle) {
  return [finger.base[0] + finger.length * Math.cos(angle),
          finger.base[1] + finger.length * Math.sin(angle)];
}

// Lower and upper corner of everything that a motion covers.
function measure(motion) {
  const low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  const cover = (point, pad) => point.forEach((value, i) => {
    low[i] = Math.min(low[i], value - pad);
    high[i] = Math.max(high[i], value + pad);
  });
  for (const rows of [motion.z, motion.ghost ? motion.ghost.z : []])
    for (const z of rows) {
      place(motion, z).forEach((point) => cover(point, 0));
      motion.fingers.forEach((finger, i) => {
        cover(finger.base, finger.radius);
        cover(tip(finger, z[3 + i]), finger.radius);
      });
    }
  return [low, high];
}

function makeScene(parent, motion) {
  const [low, high] = measure(motion);
  const size = Math.max(high[0] - low[0], high[1] - low[1]), pad = 0.06 * size;
  let strongest = 0;
  for (const own of motion.contacts)
    for (const span of own.spans) for (const c of span.c) strongest = Math.max(strongest, Math.hypot(...c));
  // Square roots: small forces are to be seen beside large ones.
  const extend = (force) => 0.3 * size * Math.sqrt(Math.hypot(...force) / (strongest || 1));
  // Arrows, with their cones, are in the picture too.
  for (const own of motion.contacts)
    for (const span of own.spans)
      span.c.forEach((c, k) => {
        const [nx, ny] = span.normal[k], reach = 1.15 * extend(c);
        for (const side of [own.friction, -own.friction])
          [nx + side * ny, ny - side * nx].forEach((way, i) => {
            const end = span.point[k][i] + reach * way;
            low[i] = Math.min(low[i], end);
            high[i] = Math.max(high[i], end);
          });
      });
  const svg = add(parent, "svg", {
    viewBox: [low[0] - pad, -high[1] - pad, high[0] - low[0] + 2 * pad, high[1] - low[1] + 2 * pad],
    style: "max-height: 46vh", role: "img", "aria-label": "hand and object" });
  const world = add(svg, "g", { transform: "scale(1,-1)" });
  const thin = 0.004 * size;
  add(world, "rect", { x: low[0] - pad, y: -thin, width: high[0] - low[0] + 2 * pad, height: thin,
                       fill: "#222" });
  const body = (fill, stroke, dash) => ({
    links: motion.fingers.map((finger) => [
      add(world, "line", { stroke, "stroke-width": 2 * finger.radius + thin, "stroke-linecap": "round" }),
      add(world, "line", { stroke: fill || finger.colours[1], "stroke-linecap": "round",
                           "stroke-width": Math.max(2 * finger.radius - 0.3 * thin, 0.6 * thin) })]),
    object: add(world, "polygon", { fill: fill || "#fbf3df", stroke, "stroke-width": 0.7 * thin,
                                    "stroke-dasharray": dash }),
  });
  const ghost = motion.ghost ? body("#ffffff", "#bbbbbb", `${2 * thin}`) : null;
  const main = body(null, "#222222", "none");
  const numbers = motion.vertices.map((_, i) => add(svg, "text", {
    style: `font-size: ${0.027 * size}px`, "text-anchor": "middle", "dominant-baseline": "central" },
    String(i)));
  // Every number, or every second, fifth, ... one: neighbours are to stand apart.
  const edges = motion.vertices.map((v, i) => Math.hypot(
    ...v.map((value, j) => value - motion.vertices[(i + 1) % motion.vertices.length][j])));
  const step = [1, 2, 5, 10, 20].find((k) => 0.84 * k * Math.min(...edges) > 0.03 * size) || 20;
  numbers.forEach((own, i) => change(own, { visibility: i % step ? "hidden" : "visible" }));
  const cones = motion.contacts.map((own) => add(world, "polygon", { fill: own.colour, opacity: 0.18 }));
  const arrows = motion.contacts.map((own) => add(world, "polyline", {
    fill: "none", stroke: own.colour, "stroke-width": 1.4 * thin, "stroke-linejoin": "round" }));
  const dots = motion.contacts.map((own) => add(world, "circle", {
    r: 2 * thin, fill: own.colour, stroke: "white", "stroke-width": 0.5 * thin }));
  const arcs = motion.fingers.map(() => add(world, "polyline", {
    fill: "none", stroke: "#d55e00", "stroke-width": thin }));
  for (const finger of motion.fingers)
    add(world, "circle", { cx: finger.base[0], cy: finger.base[1], r: 1.3 * thin, fill: "white",
                           stroke: "#444", "stroke-width": 0.6 * thin });
  const pose = (parts, z) => {
    change(parts.object, { points: join(place(motion, z)) });
    motion.fingers.forEach((finger, i) => {
      const end = tip(finger, z[3 + i]);
      for (const line of parts.links[i])
        change(line, { x1: finger.base[0], y1: finger.base[1], x2: end[0], y2: end[1] });
    });
  };
  const arrow = (point, force) => {
    const length = extend(force), strength = Math.hypot(...force);
    if (length < 1.5 * thin) return "";
    const [ux, uy] = force.map((f) => f / strength);
    const end = [point[0] + length * ux, point[1] + length * uy], head = Math.min(4 * thin, length);
    const barb = (side) => [end[0] - head * (ux + side * 0.5 * uy), end[1] - head * (uy - side * 0.5 * ux)];
    return join([point, end, barb(1), end, barb(-1)]);
  };
  const turn = (finger, tau) => {
    // Three quarters of a turn are the torque limit.
    const angle = 1.5 * Math.PI * tau / finger.limit, radius = 0.045 * size, points = [];
    if (Math.abs(angle) < 0.05) return "";
    const at = (a, r) => [finger.base[0] + r * Math.cos(a), finger.base[1] + r * Math.sin(a)];
    for (let k = 0; k <= 24; k++) points.push(at(-Math.PI / 2 + angle * k / 24, radius));
    const end = -Math.PI / 2 + angle, back = end - Math.sign(angle) * Math.min(0.5, Math.abs(angle));
    points.push(at(back, 1.2 * radius), at(end, radius), at(back, 0.8 * radius));
    return join(points);
  };
  return (t) => {
    const z = blend(motion.t, motion.z, t), tau = blend(motion.t, motion.tau, t);
    pose(main, z);
    if (ghost) pose(ghost, blend(motion.ghost.t, motion.ghost.z, t));
    place(motion, z).forEach((v, i) => change(numbers[i], {
      x: v[0] + 0.16 * (z[0] - v[0]), y: -(v[1] + 0.16 * (z[1] - v[1])) }));
    motion.contacts.forEach((own, i) => {
      const now = own.spot ? { point: own.spot } : during(motion, own, t);
      for (const part of [cones[i], arrows[i]])
        change(part, { visibility: now && now.force ? "visible" : "hidden" });
      change(dots[i], { visibility: now ? "visible" : "hidden" });
      if (now) change(dots[i], { cx: now.point[0], cy: now.point[1] });
      if (!now || !now.force) return;
      const { point, normal, force } = now;
      const reach = 1.15 * Math.max(extend(force), 6 * thin), mu = own.friction;
      const side = (k) => [point[0] + reach * (normal[0] + k * mu * normal[1]),
                           point[1] + reach * (normal[1] - k * mu * normal[0])];
      change(cones[i], { points: join([point, side(1), side(-1)]) });
      change(arrows[i], { points: arrow(point, force) });
    });
    motion.fingers.forEach((finger, i) => change(arcs[i], { points: turn(finger, tau[i]) }));
  };
}

// Narrow where the screen is, as a phone's, so that texts stay readable.
const WIDTH = innerWidth < 700 ? 520 : 1000, LEFT = 58, RIGHT = 10;

function ticks(low, high, most) {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= rough), list = [];
  for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step)
    list.push(Number(v.toPrecision(6)));
  return list;
}

// A plot over time of lines {values, colour, dashes}; `warp` maps values to what is even on paper.
function makePlot(parent, motion, height, title, lines, options) {
  const { warp = (v) => v, marks, low, high, level } = options;
  const svg = add(parent, "svg", { viewBox: [0, 0, WIDTH, height], class: "plot" });
  const top = 16, bottom = height - 22, end = motion.t[motion.t.length - 1] || 1;
  const x = (t) => LEFT + (WIDTH - LEFT - RIGHT) * t / end;
  const y = (v) => bottom - (bottom - top) * (warp(v) - warp(low)) / (warp(high) - warp(low));
  motion.starts.slice(0, -1).forEach((start, k) => {
    const width = x(motion.starts[k + 1]) - x(start);
    add(svg, "rect", { x: x(start), y: top, width, height: bottom - top,
                       fill: k % 2 ? "#ffffff" : "#eef1f5" });
    if (width > 14) add(svg, "text", { x: x(start) + width / 2, y: top - 4, "text-anchor": "middle" },
                        width > 60 ? `phase ${k + 1}` : String(k + 1));
  });
  if (level !== undefined && warp(level) > warp(low))
    add(svg, "rect", { x: LEFT, y: y(level), width: WIDTH - LEFT - RIGHT, height: bottom - y(level),
                       fill: "#f6d5cc" });
  for (const value of marks) {
    add(svg, "line", { x1: LEFT, x2: WIDTH - RIGHT, y1: y(value), y2: y(value),
                       stroke: value === 0 ? "#222" : "#c4c9d0", "stroke-width": value === 0 ? 1.2 : 0.5 });
    add(svg, "text", { x: LEFT - 5, y: y(value) + 4, "text-anchor": "end" }, String(value));
  }
  for (const t of ticks(0, end, WIDTH / 125))
    add(svg, "text", { x: x(t), y: bottom + 14, "text-anchor": "middle" }, `${t} s`);
  add(svg, "text", { x: 12, y: (top + bottom) / 2, "text-anchor": "middle",
                     transform: `rotate(-90 12 ${(top + bottom) / 2})` }, title);
  const steps = new Set(motion.steps);
  for (const line of lines) {
    let path = "", open = false;
    line.values.forEach((value, k) => {
      if (value === null) { open = false; return; }
      if (steps.has(k) && !line.upright) open = false;
      // A step is upright: the value before it lasts until then.
      if (steps.has(k) && open) path += `H${x(motion.t[k]).toFixed(1)}`;
      path += `${open ? "L" : "M"}${x(motion.t[k]).toFixed(1)} ${y(value).toFixed(1)}`;
      open = true;
    });
    add(svg, "path", { d: path, fill: "none", stroke: line.colour, "stroke-width": 1.8,
                       "stroke-dasharray": line.dashes.map((d) => 2 * d).join(" ") || "none" });
  }
  const cursor = add(svg, "line", { y1: top, y2: bottom, stroke: "#d55e00", "stroke-width": 1.5,
                                    class: "cursor" });
  const dots = lines.map((line) => add(svg, "circle", { r: 3.5, fill: line.colour }));
  const seek = (event) => {
    const box = svg.getBoundingClientRect();
    const share = ((event.clientX - box.left) / box.width * WIDTH - LEFT) / (WIDTH - LEFT - RIGHT);
    options.seek(Math.min(1, Math.max(0, share)) * end);
  };
  svg.addEventListener("pointerdown", (event) => { svg.setPointerCapture(event.pointerId); seek(event); });
  svg.addEventListener("pointermove", (event) => { if (event.buttons) seek(event); });
  return (t) => {
    change(cursor, { x1: x(t), x2: x(t) });
    lines.forEach((line, i) => {
      const value = blend(motion.t, line.values, t);
      change(dots[i], value === null ? { visibility: "hidden" } :
             { visibility: "visible", cx: x(t), cy: y(value) });
    });
  };
}

function makeMargins(parent, motion, seek) {
  const lines = motion.contacts.map((own) => {
    const values = motion.t.map(() => null);
    for (const span of own.spans) span.c.forEach((c, k) => { values[span.first + k] = c[0] - motion.epsilon; });
    return { colour: own.colour, dashes: own.dashes, values };
  });
  let low = -motion.epsilon, high = 2 * motion.epsilon;
  for (const line of lines)
    for (const v of line.values)
      if (v !== null) { low = Math.min(low, v); high = Math.max(high, v); }
  high = high > low ? high : 1;
  // Linear near zero, logarithmic above.
  const linear = 10 ** (Math.round(Math.log10(Math.max(high, -low))) - 2);
  const warp = (v) => Math.sign(v) * (Math.abs(v) <= linear ? Math.abs(v) / linear :
                                      1 + Math.log10(Math.abs(v) / linear));
  const marks = [0];
  for (let v = linear; v <= 1.0001 * high; v *= 10) marks.push(Number(v.toPrecision(3)));
  for (let v = linear; v <= -low; v *= 10) marks.push(-Number(v.toPrecision(3)));
  return makePlot(parent, motion, 250, "force margin c_n \u2212 \u03b5 [N]", lines,
                  { warp, marks, low: low - 0.5 * linear, high: 1.3 * high, level: -motion.epsilon, seek });
}

function makeTorques(parent, motion, seek) {
  const reach = 1.1 * Math.max(...motion.fingers.map((f) => f.limit), ...motion.tau.flat().map(Math.abs));
  const lines = motion.fingers.map((finger, i) => ({
    colour: finger.colours[0], dashes: i ? [4, 1.5] : [], upright: true,
    values: motion.tau.map((row) => row[i]) }));
  return makePlot(parent, motion, 170, "torque \u03c4 [N m]", lines,
                  { marks: ticks(-reach, reach, 5), low: -reach, high: reach, seek });
}

function makeLegend(parent, motion) {
  const legend = document.createElement("div");
  legend.className = "legend";
  const entry = (name, colour, dashes) => {
    const item = document.createElement("span");
    const svg = add(item, "svg", { viewBox: "0 0 26 10" });
    add(svg, "line", { x1: 0, x2: 26, y1: 5, y2: 5, stroke: colour, "stroke-width": 2.5,
                       "stroke-dasharray": dashes.join(" ") || "none" });
    item.append(` ${name}`);
    legend.append(item);
  };
  motion.contacts.forEach((own) => entry(own.name, own.colour, own.dashes.map((d) => 1.5 * d)));
  motion.fingers.forEach((finger, i) => entry(`torque of finger ${i + 1}`, finger.colours[0], i ? [6, 3] : []));
  if (motion.ghost) entry("simulated (behind)", "#bbbbbb", [3, 3]);
  const note = document.createElement("span");
  note.textContent = "arrows: contact forces (length: square root) in their friction cones; arcs: torques";
  legend.append(note);
  parent.append(legend);
}

function makePlayer(parent, motion) {
  const end = motion.t[motion.t.length - 1];
  const bar = document.createElement("div");
  bar.className = "player";
  bar.innerHTML = '<button type="button">Play</button>' +
    '<input type="range" min="0" max="1000" value="0" step="1" aria-label="time">' +
    '<select aria-label="speed"><option value="1">real speed</option>' +
    '<option value="0.2">5 times slower</option><option value="0.1" selected>10 times slower</option>' +
    '<option value="0.02">50 times slower</option></select><output></output>';
  const [button, slider, speed, output] = bar.children;
  if (motion.speed && ![...speed.options].some((own) => Number(own.value) === motion.speed))
    speed.add(new Option(`${motion.speed} of real speed`, motion.speed));
  if (motion.speed) speed.value = motion.speed;
  const updates = [];
  let now = 0, last = null;
  const show = (t) => {
    now = t;
    slider.value = Math.round(1000 * t / end);
    output.textContent = `${t.toFixed(4)} s, phase ${motion.phase[find(motion.t, t)] + 1}`;
    updates.forEach((update) => update(t));
  };
  const stop = () => { last = null; button.textContent = "Play"; };
  const seek = (t) => { stop(); show(t); };
  const tick = (stamp) => {
    if (last === null) return;
    const next = now + (stamp - last) / 1000 * Number(speed.value);
    last = stamp;
    show(Math.min(next, end));
    if (next >= end) stop(); else requestAnimationFrame(tick);
  };
  button.addEventListener("click", () => {
    if (last !== null) { stop(); return; }
    if (now >= end) now = 0;
    button.textContent = "Pause";
    last = performance.now();
    requestAnimationFrame(tick);
  });
  slider.addEventListener("input", () => seek(slider.value / 1000 * end));
  updates.push(makeScene(parent, motion));
  parent.append(bar);
  makeLegend(parent, motion);
  updates.push(makeMargins(parent, motion, seek), makeTorques(parent, motion, seek));
  const asked = /^#t=([\d.]+)$/.exec(location.hash);
  show(asked ? Math.min(Number(asked[1]), end) : 0);
}

// Where a contact is, by its name: a vertex, or the foot of a fingertip's centre on an edge.
function touch(hand, z, name) {
  const [, kind, number, other] = /^([ve])(\d+)-(.*)$/.exec(name), corners = place(hand, z);
  const a = corners[number];
  if (kind === "v") return a;
  const i = Number(other.slice(-1)) - 1, b = corners[(Number(number) + 1) % corners.length];
  const centre = tip(hand.fingers[i], z[3 + i]), way = [b[0] - a[0], b[1] - a[1]];
  const share = ((centre[0] - a[0]) * way[0] + (centre[1] - a[1]) * way[1]) / (way[0] ** 2 + way[1] ** 2);
  return [a[0] + share * way[0], a[1] + share * way[1]];
}

// The angle of a finger that touches as `name` says, the one nearest to `near`; NaN if none does.
function closeFinger(hand, i, corners, name, near) {
  const [, kind, number, surface] = /^([ve])(\d+)-([a-z]+)/.exec(name);
  const { base, length, radius } = hand.fingers[i], p = corners[number];
  const way = [p[0] - base[0], p[1] - base[1]], far = Math.hypot(...way);
  let middle = Math.atan2(way[1], way[0]), half;
  if (kind === "v" && surface === "finger") {
    middle += (i ? 1 : -1) * Math.asin(radius / far);
    half = 0;
  } else if (kind === "v") {
    half = Math.acos((length ** 2 + far ** 2 - radius ** 2) / (2 * length * far));
  } else {
    const next = corners[(Number(number) + 1) % corners.length];
    const along = [next[0] - p[0], next[1] - p[1]], size = Math.hypot(...along);
    const out = [along[1] / size, -along[0] / size];
    middle = Math.atan2(out[1], out[0]);
    half = Math.acos((radius + out[0] * way[0] + out[1] * way[1]) / length);
  }
  const turn = 2 * Math.PI, found = [middle - half, middle + half].map(
    (angle) => angle + turn * Math.round((near - angle) / turn));
  return Math.abs(found[0] - near) < Math.abs(found[1] - near) ? found[0] : found[1];
}

// The configuration of a cell with the object at x [m] and phi [rad]; null if no finger reaches it.
function closeHand(hand, own, x, phi) {
  const [palm, ...names] = own.contacts, level = place(hand, [x, 0, phi]);
  const y = -level[Number(/\d+/.exec(palm)[0])][1], corners = place(hand, [x, y, phi]);
  const angles = names.map((name, i) => closeFinger(hand, i, corners, name, own.z[0][3 + i]));
  return angles.every(Number.isFinite) ? [x, y, phi, ...angles] : null;
}

// x [m] and phi [rad] at which a map is clicked.
function read(axes, element, event) {
  const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(element.getScreenCTM().inverse());
  const [left, bottom, width, height] = axes.box;
  const share = [(at.x - left) / width, (axes.tall - at.y - bottom) / height];
  const [x, phi] = share.map((s, i) => axes.low[i] + s * (axes.high[i] - axes.low[i]));
  return [x / 1e3, phi * Math.PI / 180];
}

// The hand and the object at rest, with what touches.
function showPose(parent, hand, own, z) {
  const contacts = own.contacts.map((name) => ({
    colour: "#d55e00", spans: [], spot: touch(hand, z, name) }));
  const still = { ...hand, t: [0], z: [z], tau: [[0, 0]], ghost: null, contacts };
  parent.replaceChildren();
  makeScene(parent, still)(0);
}

function makeMap(parent, chart) {
  const [text, pose] = parent.querySelector(".choice").children;
  chart.places.forEach((own, k) => {
    const element = parent.querySelector(`#${chart.id}${k}`);
    element.classList.add("hit");
    element.addEventListener("click", (event) => {
      parent.querySelectorAll(".chosen").forEach((old) => old.classList.remove("chosen"));
      element.classList.add("chosen");
      const [x, phi] = read(chart.axes, element, event), { low, high } = chart.axes;
      const far = own.z.map((z) => Math.hypot(1e3 * (z[0] - x) / (high[0] - low[0]),
                                              (z[2] - phi) * 180 / Math.PI / (high[1] - low[1])));
      const clicked = own.wide && closeHand(chart.hand, own, x, phi);
      const z = clicked || own.z[far.indexOf(Math.min(...far))];
      const at = `x = ${(1e3 * z[0]).toPrecision(4)} mm, phi = ${(z[2] * 180 / Math.PI).toPrecision(4)} deg`;
      const shown = clicked || own.z.length > 1 ? `; drawn at ${at}` : "";
      text.textContent = `${own.contacts.join(" ")}: ${own.text}${shown}`;
      showPose(pose, chart.hand, own, z);
    });
  });
}

for (const element of document.querySelectorAll(".motion"))
  makePlayer(element, JSON.parse(element.querySelector("script").textContent));
for (const element of document.querySelectorAll(".chart"))
  makeMap(element, JSON.parse(element.querySelector("script").textContent));
