// Viewer for the images of a collection, one at a time. Contents of files enter the page only as text or as numbers of a drawing.

import { byId, element, get, hideTip, keyOf, showTip, terms, text } from "./dom.js";
import { Gestures, Viewport } from "./viewport.js";

const STEPS = 1000; // steps of a score from 0 to 1, as on the server
const KEPT = 9; // number of cached images with their vehicles: the current one, its neighbours and the latest ones
const UNSURE = 0.5; // predicted keypoints below this probability are rings
const NEAR_PX = 8; // distance on the screen within which a keypoint is hit
const SWIPED_PX = 50; // sideways distance of a swipe to the next image
const REST_MS = 150; // time that a threshold or image must stay before slow work starts

const LAYERS = [
  { name: "box", key: "b", words: "boxes" },
  { name: "dots", key: "k", words: "keypoints" },
  { name: "edges", key: "s", words: "skeleton" },
  { name: "rings", key: "h", words: "hidden or unsure keypoints (rings)" },
  { name: "ignored", key: "i", words: "ignored vehicles (dotted)" },
  { name: "others", key: "o", words: "people and two-wheelers" },
  { name: "truth", key: "t", words: "ground truth (solid)" },
  { name: "found", key: "p", words: "predictions (dashed)" },
  { name: "wrong", key: "f", words: "failures" },
];
const KEYS = [
  ["→ ←  space", "next and previous image"],
  ["Page Down, Page Up", "ten images on and back"],
  ["Home, End", "first and last image"],
  ["+ −", "larger and smaller"],
  ["0", "the picture alone, and back"],
  ["?", "this list"],
];

const stage = byId("stage");
const canvas = byId("canvas");
const drawing = byId("drawing");
const viewport = Object.assign(new Viewport(stage, canvas, drawing), { squares: Infinity });
let index; // the server's index of all images
let scores = null; // score of the detections above the threshold, per image
let threshold = 0; // of scores, in steps
let order = []; // numbers of the images that pass the filters, in display order
let at = 0; // position in `order`
let shown = null; // { number, details, bitmap, problem } of the image in the stage
let direction = 1;
const filters = { show: "all", order: "file", facets: {}, qualities: {} };

// ------------------------------------------------------------------------------------------------- from the server

async function fetched(number) {
  const [picture, details] = await Promise.all([pictureOf(number), get(`/images/${number}.json`)]);
  return { number, ...picture, details: await details.json() };
}

// Pixels of an image as a bitmap, or the reason why it is missing. A bitmap is released when it is no
// longer needed, because browsers keep hundreds of <img> pictures.
async function pictureOf(number) {
  let blob;
  try {
    blob = await (await get("/images/" + number)).blob();
    return { bitmap: await createImageBitmap(blob), problem: "" };
  } catch (error) {
    return { bitmap: null, problem: blob ? `${index.names[number]}: not an image that a browser shows` : error.message };
  }
}

const kept = new Map(); // image number -> promise of the image; the most recently used ones are last

function load(number) {
  const loading = kept.get(number) || fetched(number);
  kept.delete(number);
  kept.set(number, loading);
  loading.catch(() => kept.delete(number));
  for (const [old, loaded] of kept) {
    if (kept.size <= KEPT) break;
    kept.delete(old);
    loaded.then(({ bitmap }) => bitmap && bitmap.close(), () => {});
  }
  return loading;
}

// --------------------------------------------------------------------------------------------------------- paging

let turning = false;
let resting; // timer for an image that stays

// Shows the image at `at`. Of further requests in the meantime, only the last one follows.
async function turn() {
  if (turning) return;
  turning = true;
  try {
    while (order.length && (!shown || shown.number !== order[at])) show(await load(order[at]));
    for (const step of [1, 2, -1]) {
      const next = order[at + step * direction];
      if (next !== undefined) load(next).catch(() => {});
    }
  } catch (error) {
    trouble(error.message);
  } finally {
    turning = false;
  }
}

function go(place) {
  const to = Math.min(Math.max(place, 0), order.length - 1);
  if (to !== at) direction = Math.sign(to - at);
  at = to;
  tell();
  turn();
}

function show(loaded) {
  shown = loaded;
  const [width, height] = loaded.details.size;
  const { bitmap, problem } = loaded;
  const other = bitmap && (bitmap.width !== width || bitmap.height !== height);
  trouble(other ? `the image is ${bitmap.width}x${bitmap.height}, its annotations say ${width}x${height}` : problem);
  stage.style.setProperty("--w", width);
  stage.style.setProperty("--h", height);
  canvas.setAttribute("aria-label", index.names[loaded.number]);
  viewport.show(bitmap, [width, height], true);
  draw();
  // Reloading leads to the same image. Browsers refuse addresses that change too often.
  clearTimeout(resting);
  resting = setTimeout(() => history.replaceState(null, "", "#" + (loaded.number + 1)), REST_MS);
  stage.dataset.number = loaded.number;
}

function trouble(words) {
  byId("problem").textContent = words;
  byId("problem").hidden = !words;
}

function tell() {
  const count = order.length;
  const name = count ? index.names[order[at]] : "";
  const of = count === index.names.length ? `${count}` : `${count} (${index.names.length} in all)`;
  byId("count").textContent = count ? `image ${at + 1} of ${of}: ${name}` : "no image is like that";
  byId("place").max = Math.max(count, 1);
  byId("place").value = at + 1;
  byId("before").disabled = at <= 0;
  byId("after").disabled = at >= count - 1;
  document.title = count ? `${at + 1} of ${of}, ${index.title}` : index.title;
}

// -------------------------------------------------------------------------------------------------------- drawing

const spot = (points, k) => `${points[3 * k]} ${points[3 * k + 1]}`;
const counts = (detection) => detection.step > threshold;
const missed = (vehicle) => index.truth && !vehicle.ignored && vehicle.found !== undefined && vehicle.found <= threshold;
const every = () => index.keypoints.map((_, k) => k);

function draw() {
  hideTip();
  drawnAt = viewport.scale;
  stage.hidden = !shown || !order.length;
  if (stage.hidden) return drawing.replaceChildren();
  const { vehicles, others, detections } = shown.details;
  const wanted = vehicles.filter((vehicle) => isWanted(vehicle.kind));
  const [ignored, truth] = [wanted.filter((v) => v.ignored), wanted.filter((v) => !v.ignored)];
  const found = detections.filter(counts);
  const predicted = index.score !== null;
  const layers = [
    element("g", { class: "ignored" }, ...[...ignored, ...others.filter((v) => v.ignored)].map((v) => box(v.box))),
    element("g", { class: "others own" }, ...others.filter((v) => !v.ignored).map(otherGroup)),
    element("g", { class: predicted ? "truth" : "truth own" }, ...truth.map((v) => vehicleGroup(v, missed(v)))),
    // The highest scores are on top.
    element("g", { class: "found" }, ...found.map((d) => detectionGroup(d)).reverse()),
    element("g", { class: "wrong" }, ...failures(truth, found, detections)),
  ];
  drawing.replaceChildren(...layers);
  facts(truth, ignored, found);
}

const box = ([x, y, width, height]) => element("rect", { class: "box", x, y, width, height });

function vehicleGroup(vehicle, failed) {
  const seen = (k) => vehicle.points[3 * k + 2];
  const group = pointsGroup(vehicle, every(), (k) => seen(k) > 0, (k) => seen(k) > 1, (k) => seen(k) > 0);
  group.style.setProperty("--c", vehicle.color);
  group.classList.toggle("failed", failed);
  return group;
}

function otherGroup(other) {
  const group = element("g", {}, box(other.box));
  group.style.setProperty("--c", other.color);
  return group;
}

function detectionGroup(detection) {
  const sure = (k) => detection.points[3 * k + 2] >= UNSURE;
  const group = pointsGroup(detection, index.predicted, () => true, sure, sure);
  group.classList.toggle("failed", detection.false);
  return group;
}

// A box with its keypoints: dots if certain, rings if not; smaller in small boxes.
function pointsGroup(vehicle, keypoints, placed, sure, joined) {
  const size = Math.min(Math.max(Math.max(vehicle.box[2], vehicle.box[3]) / 100, 0.3), Math.max(1, shown.details.size[0] / 640));
  const r = 1.6 * size;
  const ring = `m${-r} 0a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`;
  const there = new Set(keypoints.filter(placed));
  const edges = index.skeleton.filter(([a, b]) => there.has(a) && there.has(b) && joined(a) && joined(b));
  const paths = {
    edges: edges.map(([a, b]) => `M${spot(vehicle.points, a)}L${spot(vehicle.points, b)}`),
    rings: [...there].filter((k) => !sure(k)).map((k) => `M${spot(vehicle.points, k)}${ring}`),
    dots: [...there].filter(sure).map((k) => `M${spot(vehicle.points, k)}h0`),
  };
  const group = element("g", {}, box(vehicle.box));
  for (const [name, parts] of Object.entries(paths)) if (parts.length) group.append(element("path", { class: name, d: parts.join("") }));
  group.style.setProperty("--s", size);
  return group;
}

// Labels of missed vehicles and false detections, and lines from wrong keypoints to their true positions.
function failures(truth, found, detections) {
  if (!index.truth) return [];
  const out = [];
  for (const vehicle of truth) {
    if (missed(vehicle)) out.push(label(vehicle.box, "missed"));
    else if (vehicle.found) {
      const theirs = detections[vehicle.by].points;
      const lines = vehicle.wrong.map((k) => `M${spot(theirs, k)}L${spot(vehicle.points, k)}`);
      if (lines.length) out.push(element("path", { class: "stray", d: lines.join("") }));
    }
  }
  for (const detection of found) if (detection.false) out.push(label(detection.box, "false"));
  return out;
}

function label([x, y, width], words) {
  const scale = 1 / viewport.scale;
  const late = x > 0.8 * shown.details.size[0];
  const made = element("text", { x: late ? x + width : Math.max(x, 0), y: Math.max(y - 3 * scale, 12 * scale) });
  if (late) made.setAttribute("text-anchor", "end");
  made.style.fontSize = 12 * scale + "px";
  made.style.strokeWidth = 3 * scale + "px";
  made.textContent = words;
  return made;
}

function facts(truth, ignored, found) {
  const rows = [...shown.details.facts];
  const number = shown.number;
  if (index.truth) rows.push(["vehicles", `${truth.length}` + (ignored.length ? `, and ${ignored.length} ignored` : "")]);
  const others = shown.details.others.filter((v) => !v.ignored).map(({ category }) => category);
  for (const name of new Set(others)) rows.push([name + "s", others.filter((one) => one === name).length]);
  if (index.score !== null) rows.push(["detections", `${found.length} above ${threshold / STEPS}`]);
  if (scores && index.truth) {
    const quality = scores.quality[number];
    rows.push(["missed", scores.missed[number].length], ["false", scores.false[number]]);
    rows.push(["quality", quality === null ? "nothing is labelled" : quality.toFixed(2)]);
  }
  terms(byId("facts"), rows);
}

// --------------------------------------------------------------------------------------------------------- layers

function switches() {
  const there = {
    ignored: index.truth,
    others: index.others,
    truth: index.truth && index.score !== null,
    found: index.score !== null,
    wrong: index.truth && index.score !== null,
  };
  for (const layer of LAYERS.filter(({ name }) => there[name] !== false)) {
    const input = text("input", "", { type: "checkbox", "data-layer": layer.name });
    input.checked = layer.name !== "ignored";
    const set = () => stage.classList.toggle("no-" + layer.name, !input.checked);
    input.addEventListener("change", set);
    set();
    const whole = text("label");
    whole.append(input, text("span", "", { class: "key " + layer.name }), layer.words, text("kbd", layer.key));
    byId("layers").append(whole);
    actions[layer.key] = () => input.click();
    KEYS.push([layer.key, layer.words]);
  }
}

// -------------------------------------------------------------------------------------------------------- filters

// Indices of a kind's number in the values of each quality.
function places(kind) {
  const out = [];
  for (const { values } of [...index.qualities].reverse()) {
    out.unshift(kind % values.length);
    kind = Math.floor(kind / values.length);
  }
  return out;
}

// Whether the vehicle filters accept this kind.
function isWanted(kind) {
  const found = places(kind);
  return index.qualities.every(({ name }, i) => filters.qualities[name] === undefined || filters.qualities[name] === found[i]);
}

const SHOW = {
  all: { words: "all", passes: () => true },
  missed: { words: "with misses", truth: true, passes: (n) => scores.missed[n].some(isWanted) },
  false: { words: "with false alarms", truth: true, passes: (n) => scores.false[n] > 0 },
  failed: { words: "with either", truth: true, passes: (n) => SHOW.missed.passes(n) || SHOW.false.passes(n) },
  found: { words: "with detections", passes: (n) => scores.detections[n] > 0 },
  none: { words: "without detections", passes: (n) => scores.detections[n] === 0 },
};

function filter() {
  const before = order[at];
  const facets = index.facets.filter(({ name }) => filters.facets[name] !== undefined);
  const anyVehicle = Object.values(filters.qualities).every((value) => value === undefined);
  order = [...index.names.keys()].filter(
    (n) =>
      facets.every(({ name, of }) => of[n] === filters.facets[name]) &&
      (anyVehicle || index.kinds[n].some(isWanted)) &&
      SHOW[filters.show].passes(n),
  );
  // Images without a labelled keypoint have no quality, and come last.
  const quality = (n) => (scores.quality[n] === null ? 2 : scores.quality[n]);
  if (filters.order === "worst") order.sort((a, b) => quality(a) - quality(b) || a - b);
  const place = order.indexOf(before);
  at = Math.max(place, 0);
  tell();
  draw();
  turn();
}

function select(words, choices, chosen) {
  const made = text("select", "", { "data-filter": words });
  made.append(...choices.map(([value, name]) => text("option", name, { value })));
  made.addEventListener("change", () => {
    chosen(made.value);
    filter();
  });
  const label = text("label", words);
  label.append(made);
  byId("filters").append(label);
}

const valueOf = (typed) => (typed === "" ? undefined : Number(typed));

function controls() {
  if (index.score !== null) {
    const possible = Object.entries(SHOW).filter(([, { truth }]) => !truth || index.truth);
    select("show", possible.map(([name, { words }]) => [name, words]), (value) => (filters.show = value));
  }
  if (index.score !== null && index.truth) {
    select("order", [["file", "as in the file"], ["worst", "worst first"]], (value) => {
      filters.order = value;
      at = 0;
      order = []; // worst first
    });
  }
  if (index.score !== null) thresholds();
  for (const { name, values } of index.facets) {
    if (values.length > 1) select(name, [["", "all"], ...values.entries()], (value) => (filters.facets[name] = valueOf(value)));
  }
  const there = [...new Set(index.kinds.flat())].map(places);
  index.qualities.forEach(({ name, values }, i) => {
    const used = [...values.entries()].filter(([place]) => there.some((found) => found[i] === place));
    if (used.length > 1) select(name, [["", "all"], ...used], (value) => (filters.qualities[name] = valueOf(value)));
  });
  byId("filters").hidden = byId("filters").children.length < 2;
}

function thresholds() {
  const input = text("input", "", { type: "range", id: "threshold", max: STEPS, step: 5, value: index.score });
  const output = text("output", threshold / STEPS);
  let timer;
  input.addEventListener("input", () => {
    threshold = Number(input.value);
    output.textContent = threshold / STEPS;
    draw();
    clearTimeout(timer);
    timer = setTimeout(() => score().then(filter, (error) => trouble(error.message)), REST_MS);
  });
  const label = text("label", "score above");
  label.append(input, output);
  byId("filters").append(label);
}

async function score() {
  const asked = threshold;
  const answer = await (await get(`/scores/${asked}.json`)).json();
  if (asked === threshold) scores = answer;
}

// ------------------------------------------------------------------------------------------- keys, pointer, touch

const actions = {
  ArrowRight: () => go(at + 1),
  ArrowLeft: () => go(at - 1),
  " ": (event) => go(at + (event.shiftKey ? -1 : 1)),
  PageDown: () => go(at + 10),
  PageUp: () => go(at - 10),
  Home: () => go(0),
  End: () => go(order.length - 1),
  "+": () => viewport.zoom(2),
  "=": () => viewport.zoom(2),
  "-": () => viewport.zoom(0.5),
  0: () => stage.classList.toggle("bare"),
  "?": () => byId("help").showModal(),
};

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || byId("help").open) return;
  const own = event.target.closest("select, input[type=range]");
  const pressed = event.key === " " && event.target.closest("button, input");
  const action = actions[keyOf(event)];
  if (own || pressed || !action) return;
  event.preventDefault();
  action(event);
});

// Nearest keypoint and smallest box at a position of the image.
function under(x, y, near) {
  const { vehicles, others, detections } = shown.details;
  const on = (layer) => !stage.classList.contains("no-" + layer);
  const truth = vehicles.filter((v) => isWanted(v.kind) && (v.ignored ? on("ignored") : on("truth")));
  const found = on("found") ? detections.filter(counts) : [];
  const inside = ({ box: [left, top, width, height] }) => x >= left && x <= left + width && y >= top && y <= top + height;
  const area = ({ box }) => box[2] * box[3];
  const beside = others.filter((v) => on(v.ignored ? "ignored" : "others"));
  const lines = [...truth, ...beside, ...found].filter(inside).sort((a, b) => area(a) - area(b)).slice(0, 2).map(wordsOf);
  let best = near;
  let nearest = null;
  const consider = (points, k, words) => {
    const away = Math.hypot(points[3 * k] - x, points[3 * k + 1] - y);
    if (away < best) [best, nearest] = [away, words];
  };
  for (const { points, ignored } of truth) {
    for (const k of ignored ? [] : every()) {
      const seen = points[3 * k + 2];
      if (on(seen > 1 ? "dots" : "rings") && seen) consider(points, k, index.keypoints[k] + (seen > 1 ? "" : ", hidden"));
    }
  }
  for (const { points } of found) {
    for (const k of index.predicted) {
      const sure = points[3 * k + 2];
      if (on(sure >= UNSURE ? "dots" : "rings")) consider(points, k, `${index.keypoints[k]}, predicted: ${sure.toFixed(2)}`);
    }
  }
  return nearest ? [nearest, ...lines] : lines;
}

function wordsOf(one) {
  if (one.score === undefined) return one.words + (missed(one) ? ", missed" : "");
  return [`detection, score ${one.score.toFixed(2)}`, one.false ? "false" : "", one.words].filter(Boolean).join(", ");
}

// Pointing at a position shows its details. A swipe over the whole image turns the page.
class Looking extends Gestures {
  begin(event) {
    this.hover(event);
    return { does: event.pointerType === "touch" && viewport.whole ? "swipe" : "move" };
  }

  hover(event) {
    hideTip();
    if (!shown || stage.classList.contains("bare")) return;
    const lines = under(...viewport.at(event), NEAR_PX / viewport.scale);
    if (lines.length) showTip(lines.join("\n"), event.clientX + 12, event.clientY + 12);
  }

  move(event) {
    super.move(event);
    if (this.action?.moved) hideTip();
  }

  end(event, { does, first }) {
    const [x, y] = [event.clientX - first.clientX, event.clientY - first.clientY];
    if (does === "swipe" && Math.abs(x) > SWIPED_PX && Math.abs(x) > 2 * Math.abs(y)) go(at - Math.sign(x));
  }
}

new Looking(stage, viewport);
stage.addEventListener("pointerleave", hideTip);
addEventListener("scroll", hideTip, { passive: true });
new ResizeObserver(() => viewport.resized()).observe(stage);

// Texts and their outlines keep their size on the screen.
let drawnAt = 1;
viewport.shown = () => {
  stage.classList.toggle("enlarged", !viewport.whole);
  if (shown && drawnAt !== viewport.scale) draw();
};

// ---------------------------------------------------------------------------------------------------------- begin

async function begin() {
  index = await (await get("/index.json")).json();
  threshold = index.score || 0;
  byId("title").textContent = index.title;
  const first = Number(location.hash.slice(1)) - 1;
  order = [...index.names.keys()];
  at = first in index.names ? first : 0;
  switches();
  terms(byId("keys"), KEYS);
  tell();
  const turned = turn();
  if (index.score !== null) await score();
  controls();
  await turned;
  filter();
}

byId("before").addEventListener("click", () => go(at - 1));
byId("after").addEventListener("click", () => go(at + 1));
byId("place").addEventListener("input", (event) => go(Number(event.target.value) - 1));
byId("larger").addEventListener("click", () => viewport.zoom(2));
byId("smaller").addEventListener("click", () => viewport.zoom(0.5));
byId("ask").addEventListener("click", () => byId("help").showModal());
begin().catch((error) => trouble(error.message));
