// Kinds of marks and drawings, their fields, edits of the document by clicks and fields, and its history.

import { byId } from "./dom.js";
import { post } from "./server.js";

// Positions of an entry are pairs of numbers, in metres for kinds of the world, otherwise in pixels.
export const KINDS = {
  points: { word: "Point", key: "p", count: 1, hint: "Click a point with a known position: the corner of a marking, a kerb, a manhole." },
  lengths: { word: "Length", key: "l", count: 2, hint: "Click both ends of a known length on the road." },
  parallels: { word: "Parallel lines", key: "r", count: 2, hint: "Click both ends of a line on the road, then of a second line that is parallel to it." },
  verticals: { word: "Vertical", key: "v", count: 2, hint: "Click the foot, then the top of something upright: a post, the corner of a house." },
  gates: { word: "Gate", key: "g", world: true, hint: "Click both ends of a line across the road: vehicles that cross it are counted. No calibration is needed." },
  zones: { word: "Zone", key: "z", open: true, world: true, hint: "Click the corners of an area of the road; Enter or Finish closes it." },
  lanes: { word: "Lane", key: "n", open: true, world: true, hint: "Click along the middle of a lane in its driving direction; Enter or Finish ends it." },
  occluders: { word: "Occluder", key: "o", open: true, hint: "Click around what hides traffic: a tree, a sign; Enter or Finish closes it." },
};
// Limits of the server's parser: values of empty fields, length of a name.
export const LIMITS = {};

export function setLimits(limits) {
  Object.assign(LIMITS, limits);
  for (const [kind, count] of Object.entries(limits.fewest)) KINDS[kind].count = count;
}

export const MARKED = ["points", "lengths", "parallels", "verticals"];
export const DRAWN = ["gates", "zones", "lanes", "occluders"];

const round = (value, digits) => Number(value.toFixed(digits));
const pixel = ([x, y]) => [round(x, 1), round(y, 1)];
const metres = ([x, y]) => [round(x, 3), round(y, 3)];

// Positions of an entry in the order of its handles; null if unknown.
export function positionsOf(kind, entry) {
  if (kind === "points") return [entry.pixel];
  if (kind === "parallels") return entry.lines.flat();
  if (kind === "lengths" || kind === "verticals") return entry.pixels;
  if (kind === "occluders") return [...entry.polygon, entry.foot];
  return entry.pixels || entry.line || entry.polygon;
}

// Whether an entry is a gate with its ends in the image. The camera gives its line on the road.
export const inImage = (kind, entry) => kind === "gates" && Boolean(entry.pixels);

// Whether the pixels of a gate refer to an image of this size; the server scales them if possible.
export const ofSize = ({ size }, [width, height]) => Boolean(size) && size[0] === width && size[1] === height;

export function setPosition(kind, entry, part, position) {
  if (kind === "points") entry.pixel = position;
  else if (kind === "parallels") entry.lines[Math.floor(part / 2)][part % 2] = position;
  else if (kind === "lengths" || kind === "verticals") entry.pixels[part] = position;
  else if (kind === "occluders" && part === entry.polygon.length) entry.foot = position;
  else if (inImage(kind, entry)) {
    entry.pixels[part] = position;
    delete entry.line; // of the earlier position
  }
  else (entry.line || entry.polygon)[part] = position;
}

// Moves a gate on the road: from now on its ends are in metres. `places` are the present ends.
function setOnRoad(entry, places, part, position) {
  entry.line = structuredClone(places);
  entry.line[part] = position;
  delete entry.pixels;
  delete entry.size;
}

// A new entry at the clicked positions, with a unique name. `size` is the size of the image if a gate
// was drawn in it.
function made(kind, positions, entries, size = null) {
  if (kind === "points") return { name: freeName("", entries), pixel: positions[0], place: [null, null, 0] };
  if (kind === "lengths") return { name: freeName("length ", entries), pixels: positions, metres: null };
  if (kind === "parallels") return { name: freeName("lines ", entries), lines: [positions] };
  if (kind === "verticals") return { name: freeName("vertical ", entries), pixels: positions, metres: null };
  if (kind === "gates") return { name: freeName("gate ", entries), ...(size ? { pixels: positions, size } : { line: positions }), directions: ["", ""] };
  if (kind === "zones") return { name: freeName("zone ", entries), polygon: positions };
  if (kind === "lanes") return { name: freeName("lane ", entries), line: positions, width: LIMITS.usual.lanes };
  const lowest = positions.reduce((a, b) => (b[1] > a[1] ? b : a));
  return { polygon: positions, foot: [...lowest] };
}

function freeName(begin, entries) {
  const taken = new Set(entries.map(({ name }) => name));
  let number = entries.length + 1;
  while (taken.has(begin + number)) number++;
  return begin + number;
}

// Fields of an entry: path of the value in the document, name in the server's messages, label.
export function fieldsOf(kind, entry) {
  const at = (way, name, words, unit = "") =>
    [0, 1].map((axis) => ({ way: [...way, axis], name, words: `${words} ${"xy"[axis]}${unit}`, half: Boolean(unit) }));
  const name = { way: ["name"], name: "name", words: "Name", text: true, wide: true };
  const corners = (list, words) => entry[list].flatMap((_, i) => at([list, i], list, `${words} ${i + 1},`, ", metres"));
  const corner = (list, words) => entry[list].flatMap((_, i) => at([list, i], list, `${words[i] || `corner ${i + 1}`},`, ", pixels"));
  if (kind === "points") {
    const place = ["x", "y", "z"].map((axis, i) => ({ way: ["place", i], name: "place." + axis, words: `${axis}, metres` }));
    return [...place, name, ...at(["pixel"], "pixel", "pixel"), { way: ["sigma_m"], name: "sigma_m", words: "exact to, m", usual: LIMITS.usual.points }];
  }
  if (kind === "lengths") return [name, { way: ["metres"], name: "metres", words: "length, metres", two: true }, { way: ["sigma_m"], name: "sigma_m", words: "exact to, m", usual: LIMITS.usual.lengths }, ...corner("pixels", ["one end", "other end"])];
  if (kind === "verticals") return [name, { way: ["metres"], name: "metres", words: "height, metres (if known)", wide: true }, ...corner("pixels", ["foot", "top"])];
  if (kind === "parallels") return [name, ...entry.lines.flatMap((line, i) => line.flatMap((_, j) => at(["lines", i, j], "lines", `line ${i + 1}, end ${j + 1},`, ", px")))];
  if (kind === "gates") {
    const ways = ["1, along arrow 1", "2, along arrow 2"];
    const directions = ways.map((words, i) => ({ way: ["directions", i], name: "directions." + i, words: "Direction " + words, text: true, wide: true }));
    return [name, ...directions, ...(inImage(kind, entry) ? corner("pixels", ["end 1", "end 2"]) : corners("line", "end"))];
  }
  if (kind === "zones") return [name, ...corners("polygon", "corner")];
  if (kind === "lanes") return [name, { way: ["width"], name: "width", words: "width, metres", usual: LIMITS.usual.lanes, wide: true }, ...corners("line", "point")];
  return [...corner("polygon", []), ...at(["foot"], "foot", "foot,", ", pixels")];
}

export function valueAt(entry, way) {
  return way.reduce((value, step) => (value === null || value === undefined ? value : value[step]), entry);
}

export function setValue(entry, way, value) {
  const last = way[way.length - 1];
  const holder = way.slice(0, -1).reduce((within, step) => (within[step] ??= []), entry);
  if (value === null && typeof last === "string") delete holder[last];
  else holder[last] = value;
}

// Input as a number, empty input as null, other input as text, which the server rejects with a message.
export function typed(text) {
  const plain = text.trim().replace(/^([-+]?[0-9]*),([0-9]+)$/, "$1.$2");
  if (plain === "") return null;
  const value = Number(plain);
  return Number.isFinite(value) ? value : text.slice(0, 100);
}

// ------------------------------------------------------------------------------------------------------------- history

// The document with its undo and redo steps; every change makes a new document.

const KEPT = 200;
const SAME_MS = 800; // consecutive changes of the same value are one step

export class History {
  constructor(document) {
    this.document = document;
    this.past = [];
    this.future = [];
    this.last = { of: null, when: 0 };
  }

  // Changes a copy of the document; `of` names the changed value, so that dragging it is one step.
  change(edit, of = null) {
    const next = structuredClone(this.document);
    edit(next);
    if (JSON.stringify(next) === JSON.stringify(this.document)) return false;
    const now = Date.now();
    const goesOn = of !== null && of === this.last.of && now - this.last.when < SAME_MS;
    if (!goesOn) this.past.push(this.document);
    if (this.past.length > KEPT) this.past.shift();
    this.last = { of, when: now };
    this.future = [];
    this.document = next;
    return true;
  }

  undo() {
    return this.step(this.past, this.future);
  }

  redo() {
    return this.step(this.future, this.past);
  }

  step(from, to) {
    if (!from.length) return false;
    to.push(this.document);
    this.document = from.pop();
    this.last = { of: null, when: 0 };
    return true;
  }
}

// ------------------------------------------------------------------------------------------------------------- marking

// Clicks on the picture: begin, continue and end a mark or drawing of the selected tool.

export class Marking {
  // `now` is the page's state, `views` the contents of the stage; `does` has `document`, `change`, `refresh`, `trouble`,
  // `placesOf`, `onRoad` (the ends of a gate in metres), `choose` and `placeOnPlan`.
  constructor(now, views, does) {
    Object.assign(this, { now, views, does });
  }

  // Discards the unfinished drawing.
  drop() {
    Object.assign(this.now, { pending: [], hover: null, group: null, picking: null });
  }

  setTool(name) {
    this.drop();
    this.now.tool = name;
    this.does.trouble("");
    this.does.refresh();
  }

  // Selects a tool; shows the image if the tool works only there.
  chooseTool(name) {
    this.setTool(name);
    if (KINDS[name] && !KINDS[name].world && this.views.name !== "image") this.views.show("image");
  }

  within([x, y]) {
    const view = this.views.current;
    return Boolean(view) && x >= 0 && y >= 0 && x <= view.size[0] && y <= view.size[1];
  }

  // A position of the view was clicked, touched, or confirmed by Enter.
  async mark(position) {
    const { now, views, does } = this;
    if (!this.within(position)) return;
    if (views.scaling) {
      if (views.current) views.plan.click(position);
      now.pending = views.plan.ends;
      return does.refresh();
    }
    if (now.picking !== null) return this.place(position);
    if (now.tool === "select") return does.choose(null);
    const { count, open, world } = KINDS[now.tool];
    if (!world && views.name !== "image") return does.trouble("Mark that in the image.");
    now.pending = [...now.pending, position];
    if (!open && now.pending.length === count) await this.finish();
    else does.refresh();
  }

  async finish() {
    const { now, views, does } = this;
    const kind = now.tool;
    const { count, world } = KINDS[kind];
    const drawn = now.pending;
    if (drawn.length < count) return does.trouble(`A ${KINDS[kind].word.toLowerCase()} needs ${count} positions or more.`);
    Object.assign(now, { pending: [], hover: null });
    const { fromWorld, toWorld } = views.current;
    const image = !fromWorld && (!world || kind === "gates");
    let positions = image ? drawn.map(pixel) : [];
    if (!image) positions = fromWorld ? drawn.map((position) => metres(toWorld(position))) : await does.placesOf(drawn);
    if (!positions.length) return does.refresh();
    if (kind === "parallels" && now.group !== null && does.document().parallels[now.group]) {
      now.selected = { kind, index: now.group, part: 0 };
      return does.change((all) => all.parallels[now.group].lines.push(positions));
    }
    now.selected = { kind, index: does.document()[kind].length, part: 0 };
    if (kind === "parallels") now.group = now.selected.index;
    does.change((all) => all[kind].push(made(kind, positions, all[kind], image ? [...views.image.size] : null)));
    if (kind === "points" && views.planReady) does.placeOnPlan(now.selected.index);
    else if (!now.byTouch) typeNext(kind, now.selected.index);
  }

  // The second press of a double press ends the drawing; it adds no position.
  ended() {
    if (!this.now.pending.length || !KINDS[this.now.tool].open) return;
    this.now.pending = this.now.pending.slice(0, -1);
    this.finish();
  }

  // Handles a click on the plan for the position of a point.
  place(position) {
    const index = this.now.picking;
    this.now.picking = null;
    this.does.change((all) => {
      if (all.points[index]) all.points[index].place.splice(0, 2, ...metres(this.views.current.toWorld(position)));
    });
    this.views.show("image");
  }

  // Puts a handle of an entry at a position of the view.
  async put({ kind, index, part }, position, of) {
    const { views, does } = this;
    const entry = does.document()[kind][index];
    if (!entry) return;
    if (views.current.fromWorld) {
      const place = metres(views.current.toWorld(position));
      if (kind === "points") does.change((all) => all.points[index].place.splice(0, 2, ...place), of);
      else if (inImage(kind, entry)) {
        const places = does.onRoad(index);
        if (places) does.change((all) => setOnRoad(all[kind][index], places, part, place), of);
      }
      else does.change((all) => setPosition(kind, all[kind][index], part, place), of);
    } else if (!KINDS[kind].world || inImage(kind, entry)) does.change((all) => setPosition(kind, all[kind][index], part, pixel(position)), of);
    else {
      const [place] = await does.placesOf([position]);
      if (place) does.change((all) => setPosition(kind, all[kind][index], part, place), of);
      else does.refresh();
    }
  }

  cancel() {
    const { now, views } = this;
    const { picking, pending, group, tool } = now;
    if (picking !== null) views.show("image");
    else if (!pending.length && group === null && tool !== "select") return this.setTool("select");
    else if (!pending.length && group === null) now.selected = null;
    if (!pending.length) now.group = null;
    Object.assign(now, { pending: [], picking: null, hover: null });
    views.plan.ends = [];
    this.does.refresh();
  }

  // Once the plan has a scale, missing positions are clicked there, others in the image.
  async placed() {
    const { points } = this.does.document();
    const missing = points.findIndex(({ place: [x, y] }) => x === null || y === null);
    if (missing >= 0) this.does.placeOnPlan(missing);
    else await this.views.show(points.length ? "plan" : "image");
    if ((this.now.tool === "select" || !points.length) && missing < 0) this.setTool("points");
  }

  // Reports what is at a position of the view.
  tell(position, errors) {
    const [x, y] = position;
    const view = this.views.current;
    let words = "";
    if (this.within(position)) {
      words = `column ${x.toFixed(1)}, row ${y.toFixed(1)}`;
      if (view.toWorld) words = "x " + view.toWorld(position)[0].toFixed(2) + " m, y " + view.toWorld(position)[1].toFixed(2) + " m";
      else if (errors) {
        const { cell, columns, values } = errors;
        const error = values[Math.floor(y / cell) * columns + Math.floor(x / cell)];
        words += error === null || error === undefined ? ": no road, or too far away" : `: position error there: ${error} m (90%)`;
      }
    }
    byId("where").textContent = words;
  }
}

// Scrolls to the fields of a new mark and focuses its position or length. Not after touch,
// because a keyboard would cover the picture.
function typeNext(kind, index) {
  const way = { points: "place.0", lengths: "metres" }[kind];
  if (way) document.querySelector(`[data-focus="${kind}:${index}:${way}"]`)?.focus({ preventScroll: true });
  const [row, list] = [document.querySelector(`[data-focus="${kind}:${index}"]`)?.closest("li"), document.querySelector("aside")];
  // If the list is beside the picture, only the list scrolls.
  if (row) list.scrollTop += Math.max(0, row.getBoundingClientRect().bottom - list.getBoundingClientRect().bottom);
}

// --------------------------------------------------------------------------------------------------------------- edits

// Edits of the document by fields and buttons of the lists.

const USUAL_SHARE = 0.02; // default relative standard deviation of prior values

// `now` is the page's state; `does` has `document`, `change` and `refresh`.
export function edits(now, does) {
  const { change } = does;
  return {
    edit(kind, index, edit) {
      change((all) => edit(all[kind][index]));
    },
    remove(kind, index) {
      Object.assign(now, { selected: null, group: null, picking: null });
      change((all) => all[kind].splice(index, 1));
    },
    // A position in degrees, as web maps give it; stored in metres.
    async fromMap(index, typed) {
      if (!typed.trim()) return;
      const { points, world } = does.document();
      const others = points.some(({ place }, i) => i !== index && typeof place[0] === "number");
      try {
        const found = await post("/map-places", { text: typed, world, others });
        change((all) => {
          all.points[index].place.splice(0, 2, ...found.places[0]);
          all.world = found.world;
        });
      } catch (error) {
        now.refused = { kind: "points", index, field: "map", text: error.message, missing: false, typed };
        does.refresh();
      }
    },
    set(key, value) {
      change((all) => { all[key] = value; });
    },
    forgetLens() {
      change((all) => { delete all.known.lens; });
    },
    know(name, part, value) {
      change((all) => {
        const pair = all.known[name] || [null, null];
        pair[part] = value;
        if (part === 0 && typeof value === "number" && pair[1] === null) pair[1] = Number((USUAL_SHARE * value).toPrecision(2));
        if (pair.every((one) => one === null)) delete all.known[name];
        else all.known[name] = pair;
      });
    },
  };
}

// Puts the contents of a file into the document; returns a message.
export async function loadFile(file, does) {
  const found = await post("/read", { name: file.name, text: await file.text() });
  const { points, world } = does.document();
  const other = found.points && points.length && JSON.stringify(found.world ?? null) !== JSON.stringify(world);
  if (other) return `${file.name}: its positions have another origin than the marked ones: remove those first`;
  does.change((all) => {
    if (found.points) all.points.push(...found.points);
    if (found.world) all.world = found.world;
    if (found.camera) all.camera = found.camera;
    if (found.lens) all.known.lens = found.lens;
  });
  return found.said || "";
}

// ------------------------------------------------------------------------------------------------------ moved drawings

// Whether gates, zones and lanes have moved in the image because the camera was calibrated again. Gates that have their ends in the image stay there.

const MOVED_PX = 3; // smaller moves are not visible

const ROAD = DRAWN.filter((kind) => KINDS[kind].world);

export class MovedDrawings {
  constructor() {
    this.before = new Map(); // by kind and name: corners in metres and their pixels
  }

  // Compares drawings with their pixels when they were drawn or last accepted; stores new ones.
  // Returns { entries, most }: the moved drawings, and the largest shift in pixels.
  compare(document, look) {
    const entries = [];
    let most = 0;
    const seen = new Map();
    for (const { kind, index, corners } of look.shapes.filter((one) => ROAD.includes(one.kind))) {
      const entry = document[kind][index];
      if (!entry || inImage(kind, entry)) continue;
      const places = entry.line || entry.polygon;
      const key = kind + " " + entry.name;
      const then = this.before.get(key);
      const same = then && JSON.stringify(then.places) === JSON.stringify(places);
      seen.set(key, same ? then : { places, corners });
      const away = same ? farthest(then.corners, corners) : 0;
      if (away <= MOVED_PX) continue;
      entries.push({ kind, index, corners: then.corners });
      most = Math.max(most, away);
    }
    if (look.camera) this.before = seen; // without a camera no drawing has pixels
    return { entries, most };
  }

  // Accepts the present positions.
  agree() {
    this.before = new Map();
  }
}

function farthest(before, after) {
  return Math.max(0, ...before.map((one, i) => (one && after[i] ? Math.hypot(one[0] - after[i][0], one[1] - after[i][1]) : 0)));
}
