// SVG drawing over the picture: marks with handles, the camera's grid on the road, gates, zones and lanes.

import { element } from "./dom.js";
import { DRAWN, KINDS, MARKED, inImage, ofSize, positionsOf } from "./marks.js";

const line = (positions, closed) => positions.length > 1 ? "M" + positions.map((p) => p.join(" ")).join("L") + (closed ? "Z" : "") : "";
const lines = (polylines) => polylines.map((positions) => line(positions)).join("");
// A position; null if its input is not a number.
const numbers = (position) => (position && position.every((value) => Number.isFinite(value)) ? position : null);
const known = (positions) => positions.filter(Boolean);

// A line with a dark outline below it.
function rimmed(d, kind) {
  return d ? [element("path", { class: "rim", d }), element("path", { class: kind, d })] : [];
}

// Position of each handle of an entry in the current view; null if unknown or outside this view.
export function handlesOf(kind, index, entry, page) {
  const dragged = page.dragged;
  const own = dragged && dragged.kind === kind && dragged.index === index;
  const positions = placesOf(kind, index, entry, page).map(numbers);
  return own ? positions.map((position, part) => (part === dragged.part ? dragged.position : position)) : positions;
}

function placesOf(kind, index, entry, { view, look }) {
  if (view.fromWorld) {
    if (kind === "points") return [entry.place.slice(0, 2).every((v) => typeof v === "number") ? view.fromWorld(entry.place) : null];
    if (inImage(kind, entry)) return (shapeOf(look, kind, index)?.places || []).map(view.fromWorld);
    return KINDS[kind].world ? positionsOf(kind, entry).map((p) => p && numbers(p) && view.fromWorld(p)) : [];
  }
  if (inImage(kind, entry)) return ofSize(entry, view.size) ? entry.pixels : [];
  if (!KINDS[kind].world) return positionsOf(kind, entry);
  const shape = shapeOf(look, kind, index);
  const corners = shape ? shape.corners : [];
  return positionsOf(kind, entry).map((_, part) => corners[part] || null);
}

const shapeOf = (look, kind, index) => look && look.shapes.find((one) => one.kind === kind && one.index === index);

// Redraws everything; the focused handle keeps the focus.
export function redraw(svg, shown) {
  const { x, width } = svg.viewBox.baseVal;
  const page = { ...shown, right: x + width, taken: [], labels: [] };
  const active = document.activeElement;
  const focused = svg.contains(active) ? active.dataset.handle : null;
  const parts = [];
  if (!page.view.fromWorld && page.look) parts.push(...ofCamera(page));
  for (const kind of [...DRAWN, ...MARKED]) {
    page.document[kind].forEach((entry, index) => parts.push(ofEntry(kind, index, entry, page)));
  }
  parts.push(...page.labels, ...ofPending(page));
  svg.replaceChildren(...parts);
  if (focused) svg.querySelector(`[data-handle="${focused}"]`)?.focus({ preventScroll: true });
}

function ofCamera(page) {
  const { look, layers, unit, view } = page;
  const { drawn } = look;
  if (!drawn) return [];
  const out = [];
  if (layers.grid) {
    out.push(element("path", { class: "grid", d: lines(drawn.grid) }), ...rimmed(lines(drawn.horizon), "horizon"));
    const names = namesOf(page).map((name) => boxOf(name, unit));
    let above = Infinity; // far away, labels would overlap
    for (const { at, text } of drawn.labels) {
      const place = [at[0] + 4 * unit, at[1] - 3 * unit];
      // Together with a mark's name, "10 m" would be misread.
      if (above - at[1] < 17 * unit || names.some((name) => meet(name, boxOf({ at: place, text }, unit)))) continue;
      above = at[1];
      out.push(words({ at: place, text }, unit));
    }
  }
  if (layers.posts) out.push(...rimmed(lines(drawn.posts), "posts"));
  if (layers.boxes) out.push(...rimmed(lines(drawn.boxes), "boxes"));
  const [width, height] = view.size;
  const clip = element("clipPath", { id: "inside" }, element("rect", { width, height }));
  return [element("defs", {}, clip), element("g", { class: "camera", "aria-hidden": "true", "clip-path": "url(#inside)" }, ...out)];
}

function ofEntry(kind, index, entry, page) {
  const places = handlesOf(kind, index, entry, page);
  const group = element("g", { class: kind });
  const told = shapeOf(page.look, kind, index);
  const shape = page.view.fromWorld ? null : told;
  const moving = page.dragged && page.dragged.kind === kind && page.dragged.index === index;
  if (kind === "parallels") for (let i = 0; i + 1 < places.length; i += 2) group.append(...rimmed(line(places.slice(i, i + 2)), "shape"));
  else if (shape && shape.lines && !moving) {
    const open = kind !== "zones";
    group.append(...rimmed(lines(shape.lines), "shape"));
    if (!open) group.append(element("path", { class: "shape", d: line(known(shape.corners), true), "stroke-opacity": 0 }));
    if (shape.edges) group.append(element("path", { class: "edge", d: lines(shape.edges) }));
  } else if (kind === "occluders") group.append(...rimmed(line(known(places.slice(0, -1)), true), "shape"));
  else if (kind !== "points") group.append(...rimmed(line(known(places), kind === "zones"), "shape"));
  const name = nameOf(places, entry, page);
  const always = chosen(kind, index, page);
  if (name) addLabel(kind, name, page, always);
  if (told && told.arrows && !moving) {
    const { fromWorld } = page.view;
    arrows(group, kind, always, entry, fromWorld ? told.ways.map((way) => [way.map(fromWorld)]) : told.arrows, page);
  }
  if (kind === "points") residual(group, index, page);
  places.forEach((place, part) => place && group.append(...handle(kind, index, part, place, entry, page)));
  return group;
}

// Position and text of an entry's label; null if it has none. At the right edge the label is on the left.
function nameOf(places, entry, { unit, layers, right }) {
  const first = known(places)[0];
  if (!first || !layers.names || !entry.name) return null;
  const label = (side, anchor) => ({ at: [first[0] + side * 9 * unit, first[1] - 7 * unit], text: entry.name, anchor });
  const usual = label(1, "start");
  return boxOf(usual, unit)[2] > right ? label(-1, "end") : usual;
}

const namesOf = (page) =>
  known([...DRAWN, ...MARKED].flatMap((kind) => page.document[kind].map((entry, index) => nameOf(handlesOf(kind, index, entry, page), entry, page))));

// Approximate left, top, right and bottom of a label.
function boxOf({ at: [x, y], text, anchor }, unit) {
  const width = 8 * unit * text.length;
  const left = x - width * ({ middle: 0.5, end: 1 }[anchor] || 0);
  return [left, y - 11 * unit, left + width, y + 2 * unit];
}

// Adds a label over all lines and handles. If it would overlap others, it moves a line down or up, or is left out. The label
// of the selected entry is always shown.
function addLabel(kind, label, page, always) {
  const [x, y] = label.at;
  const tried = [0, 15, -15].map((down) => ({ ...label, at: [x, y + down * page.unit] }));
  const free = tried.find((one) => !page.taken.some((other) => meet(boxOf(one, page.unit), other)));
  if (!free && !always) return;
  page.taken.push(boxOf(free || label, page.unit));
  page.labels.push(element("g", { class: kind }, words(free || label, page.unit)));
}

const chosen = (kind, index, { selected }) => Boolean(selected && selected.kind === kind && selected.index === index);
const meet = (one, other) => one[0] < other[2] && other[0] < one[2] && one[1] < other[3] && other[1] < one[3];

function handle(kind, index, part, [x, y], entry, page) {
  const own = chosen(kind, index, page);
  const result = page.residualOf(kind, index);
  const names = ["handle", own && (page.selected.part ?? 0) === part ? "chosen" : "", result && result.left_out ? "left-out" : ""];
  const label = `${KINDS[kind].word} ${entry.name || index + 1}, position ${part + 1}: ${x.toFixed(1)}, ${y.toFixed(1)}`;
  const r = (own ? 7 : 5.5) * page.unit;
  return [
    element("circle", { class: "rim", cx: x, cy: y, r }),
    element("circle", { class: names.join(" ").trim(), cx: x, cy: y, r, tabindex: 0, role: "button", "aria-label": label, "data-handle": `${kind}:${index}:${part}` }),
  ];
}

// Residual of a point, from the mark to its projection, enlarged ten times.
function residual(group, index, page) {
  const result = page.residualOf("points", index);
  const entry = page.document.points[index];
  if (!result || !result.at || page.view.fromWorld || !page.layers.residuals || page.dragged) return;
  const [x, y] = entry.pixel;
  if (typeof x !== "number" || typeof y !== "number") return;
  const factor = result.left_out ? 1 : 10;
  group.append(...rimmed(`M${x} ${y}L${x + factor * (result.at[0] - x)} ${y + factor * (result.at[1] - y)}`, "residual"));
}

function arrows(group, kind, always, entry, polylines, page) {
  const { unit } = page;
  polylines.forEach((polyline, i) => {
    const points = polyline[polyline.length - 1];
    if (!points || points.length < 2) return;
    const [end, before] = [points[points.length - 1], points[points.length - 2]];
    const angle = Math.atan2(end[1] - before[1], end[0] - before[0]);
    const wing = (turn) => [end[0] - 11 * unit * Math.cos(angle + turn), end[1] - 11 * unit * Math.sin(angle + turn)].join(" ");
    const shaft = kind === "gates" ? line(points) : "";
    group.append(...rimmed(`${shaft}M${wing(0.5)}L${end.join(" ")}L${wing(-0.5)}`, "arrow"));
    const name = kind === "gates" ? `${i + 1}${entry.directions[i] ? ": " + entry.directions[i] : ""}` : "";
    if (name) addLabel(kind, beyond(end, angle, name, unit), page, always);
  });
}

// Position of a label beyond the end of an arrow, off the arrow and its line.
function beyond([x, y], angle, text, unit) {
  const [across, down] = [Math.cos(angle), Math.sin(angle)];
  const anchor = across > 0.4 ? "start" : across < -0.4 ? "end" : "middle";
  return { at: [x + 6 * across * unit, y + (4 + 11 * down) * unit], text, anchor };
}

function ofPending({ pending, tool, unit, cursor, hover }) {
  const out = [];
  if (pending.length) {
    const next = hover ? [...pending, hover] : pending;
    out.push(element("g", { class: tool }, ...rimmed(line(next), "pending"), ...pending.map(([cx, cy]) => element("circle", { cx, cy, r: 4 * unit }))));
  }
  if (cursor) {
    const [x, y] = cursor;
    const [gap, arm] = [4 * unit, 16 * unit];
    const d = `M${x - arm} ${y}H${x - gap}M${x + gap} ${y}H${x + arm}M${x} ${y - arm}V${y - gap}M${x} ${y + gap}V${y + arm}`;
    out.push(element("path", { class: "crosshair-rim", d }), element("path", { class: "crosshair", d }));
  }
  return out;
}

function words({ at: [x, y], text, anchor }, unit) {
  const made = element("text", { x, y });
  made.style.textAnchor = anchor || "start";
  made.style.fontSize = 13 * unit + "px";
  made.style.strokeWidth = 3 * unit + "px";
  made.textContent = text;
  return made;
}
