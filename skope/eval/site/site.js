// The page on which a camera is calibrated and a road drawn. What a file says gets into it as text or as numbers of a
// drawing; places, residuals and warnings come from the server.

import { keyList, legend, switches, toolbar } from "./controls.js";
import { redraw, handlesOf } from "./drawing.js";
import { History } from "./history.js";
import { DRAWN, KINDS, MARKED, made, metres, pixel, setPosition } from "./kinds.js";
import { figures, fill, known, text } from "./panel.js";
import { get, newest, post } from "./server.js";
import { Viewport } from "./viewport.js";

const byId = (id) => document.getElementById(id);
const stage = byId("stage");
const svg = byId("drawing");
const viewport = new Viewport(stage, byId("canvas"), svg, byId("loupe"));

const NEAR_PX = { mouse: 9, pen: 14, touch: 24 }; // so near to a handle it is meant
const DRAGGED_PX = 5; // so far a press has to go to be a drag
const WAIT_MS = 120; // before the server is asked for what changed
const CAMERA_NEEDED = "The camera is not calibrated yet: mark points with places, or a length and parallel lines, first.";

let history; // of the document
let begun; // what the server said at the start
let saved; // JSON of the document as it is in the file
let base; // the document that `revision` belongs to
let revision;
let look = null; // the server's answer to the document
let tool = "select";
let pending = []; // positions of what is being drawn, in the view
let group = null; // index of the parallel lines that the next line joins
let selected = null; // { kind, index, part }
let dragged = null; // { kind, index, part, position }
let hover = null;
let cursor = null; // of the keyboard, in the view
let byTouch = false; // whether a finger has touched the picture last
let picking = null; // index of the point whose place is clicked on the plan
let scaling = []; // the plan's two points
const layers = { errors: true, grid: true, posts: true, boxes: true, residuals: true, names: true };
const views = { image: { picture: null, size: [1, 1] }, above: null, plan: null };
let viewName = "image";
let frame = 0;

const view = () => views[viewName];
const document_ = () => history.document;

// ---------------------------------------------------------------------------------------------------------- showing

const page = () => ({
  document: document_(),
  look,
  view: view(),
  tool,
  pending,
  selected,
  dragged,
  hover,
  cursor,
  layers,
  unit: 1 / viewport.scale,
  planReady: Boolean(views.plan && views.plan.fromWorld),
  residualOf: (kind, index) => (look ? look.residuals.find((one) => one.kind === kind && one.index === index) : undefined),
  problemsOf: (kind, index) => (look ? look.problems.filter((one) => one.kind === kind && one.index === index) : []),
  warningsOf: (kind, index) => (look ? look.shapes.find((one) => one.kind === kind && one.index === index)?.warnings || [] : []),
});

const drawAll = () => redraw(svg, page());
viewport.shown = () => history && drawAll();

function refresh() {
  drawAll();
  fill(byId("marks"), byId("road"), page(), act);
  known(byId("known"), page(), act);
  byId("undo").disabled = !history.past.length;
  byId("redo").disabled = !history.future.length;
  const same = JSON.stringify(document_()) === saved;
  byId("save").disabled = same;
  byId("state").textContent = same ? (begun.exists ? "saved" : "") : "not saved yet";
  for (const button of byId("tools").querySelectorAll("[data-tool]")) button.setAttribute("aria-pressed", button.dataset.tool === tool);
  byId("finish").hidden = !(pending.length && KINDS[tool] && KINDS[tool].open);
  byId("cancel").hidden = !pending.length && picking === null;
  stage.classList.toggle("selecting", tool === "select" && picking === null);
  hint();
}

function hint() {
  byId("hint").textContent = hintWords();
}

function hintWords() {
  if (viewName === "plan" && !views.plan) return "Load a map, a plan or an aerial picture first.";
  if (viewName === "plan" && !views.plan.fromWorld) return scaling.length ? "Click the second of two points whose distance you know." : "Click the first of two points of the plan whose distance you know.";
  if (picking !== null && document_().points[picking]) return `Click the place of point ${document_().points[picking].name || picking + 1} on the plan (Esc: type it instead).`;
  if (tool === "select") return "Drag marks to mend them; drag the picture to move it, zoom with the wheel or two fingers.";
  if (KINDS[tool].world && !(look && look.camera) && viewName === "image") return CAMERA_NEEDED;
  if (tool === "parallels" && group !== null && !pending.length) return "Click both ends of another line that is parallel to it on the road; Esc ends the group.";
  return KINDS[tool].hint;
}

function trouble(words) {
  byId("problem").textContent = words;
  byId("problem").hidden = !words;
}

// ----------------------------------------------------------------------------------------------------- the document

const askLook = newest("/look", (answer) => {
  look = answer;
  stage.setAttribute("aria-busy", "false");
  showCamera();
  refresh();
}, (error) => trouble(error.message));
let asking;

function changed() {
  trouble("");
  views.above = viewName === "above" ? views.above : null; // the camera may be another one
  stage.setAttribute("aria-busy", "true");
  clearTimeout(asking);
  asking = setTimeout(() => askLook(document_()), WAIT_MS);
  refresh();
}

function change(edit, of = null) {
  if (history.change(edit, of)) changed();
}

function showCamera() {
  byId("message").textContent = look.message;
  byId("message").hidden = !look.message;
  byId("warnings").replaceChildren(...look.warnings.map((words) => text("li", words)));
  byId("figures-details").hidden = !look.camera;
  if (look.camera) figures(byId("figures"), byId("figures-summary"), look.camera);
  setMap();
}

function setMap() {
  const errors = layers.errors && viewName === "image" && look ? look.errors : null;
  viewport.setMap(errors);
  byId("legend").hidden = !errors;
}

const act = {
  choose(what) {
    selected = what;
    if (what) {
      const place = handlesOf(what.kind, what.index, document_()[what.kind][what.index], page())[what.part || 0];
      if (place) viewport.reveal(place);
    }
    refresh();
  },
  edit(kind, index, edit) {
    change((all) => edit(all[kind][index]));
  },
  remove(kind, index) {
    selected = null;
    group = null;
    picking = null;
    change((all) => all[kind].splice(index, 1));
  },
  know(name, part, value) {
    change((all) => {
      const pair = all.known[name] || [null, null];
      pair[part] = value;
      if (part === 0 && value !== null && pair[1] === null && typeof value === "number") pair[1] = Number((0.02 * value).toPrecision(2));
      if (pair.every((one) => one === null)) delete all.known[name];
      else all.known[name] = pair;
    });
  },
  addLine(index) {
    setTool("parallels");
    group = index;
    show("image");
    hint();
  },
  placeOnPlan(index) {
    picking = index;
    show("plan");
  },
};

// Puts a handle of an entry at a position of the view.
async function put({ kind, index, part }, position, of) {
  const entry = document_()[kind][index];
  if (!entry) return;
  if (view().fromWorld) {
    const place = metres(view().toWorld(position));
    if (kind === "points") change((all) => all.points[index].place.splice(0, 2, ...place), of);
    else change((all) => setPosition(kind, all[kind][index], part, place), of);
  } else if (!KINDS[kind].world) change((all) => setPosition(kind, all[kind][index], part, pixel(position)), of);
  else {
    const [place] = await placesOf([position]);
    if (place) change((all) => setPosition(kind, all[kind][index], part, place), of);
    else refresh();
  }
}

// Where pixels lie on the road; an empty list, and words to the user, where one lies nowhere.
async function placesOf(pixels) {
  const busy = stage.getAttribute("aria-busy");
  stage.setAttribute("aria-busy", "true");
  try {
    const { places } = await post("/places", { document: document_(), pixels });
    if (places.every(Boolean)) return places;
    trouble("There is no road: that lies on or above the horizon.");
  } catch (error) {
    trouble(error.message);
  }
  stage.setAttribute("aria-busy", busy);
  return [];
}

// ------------------------------------------------------------------------------------------------------------ tools

function setTool(name) {
  tool = name;
  pending = [];
  hover = null;
  group = null;
  picking = null;
  trouble("");
  refresh();
}

function chooseTool(name) {
  setTool(name);
  if (KINDS[name] && !KINDS[name].world && viewName !== "image") show("image");
}

// A position of the view was clicked, touched, or confirmed by Enter.
async function mark(position) {
  if (!within(position)) return;
  if (viewName === "plan" && !view().fromWorld) return scalePlan(position);
  if (picking !== null) return place(position);
  if (tool === "select") return act.choose(null);
  if (!KINDS[tool].world && viewName !== "image") return trouble("Mark that in the image.");
  pending = [...pending, position];
  const { count, open } = KINDS[tool];
  if (!open && pending.length === count) await finish();
  else refresh();
}

const within = ([x, y]) => x >= 0 && y >= 0 && x <= view().size[0] && y <= view().size[1];

async function finish() {
  const kind = tool;
  const { count, world } = KINDS[kind];
  if (pending.length < count) return trouble(`A ${KINDS[kind].word.toLowerCase()} needs ${count} positions or more.`);
  const drawn = pending;
  pending = [];
  hover = null;
  let positions = world ? [] : drawn.map(pixel);
  if (world) positions = view().fromWorld ? drawn.map((position) => metres(view().toWorld(position))) : await placesOf(drawn);
  if (!positions.length) return refresh();
  if (kind === "parallels" && group !== null && document_().parallels[group]) {
    selected = { kind, index: group, part: 0 };
    return change((all) => all.parallels[group].lines.push(positions));
  }
  selected = { kind, index: document_()[kind].length, part: 0 };
  if (kind === "parallels") group = selected.index;
  change((all) => all[kind].push(made(kind, positions, all[kind])));
  if (kind === "points" && views.plan && views.plan.fromWorld) act.placeOnPlan(selected.index);
  else if (!byTouch) typeNext(kind, selected.index);
}

// What is marked is told at once: the field of its place or its length has the focus. A finger would get a keyboard
// over the picture.
function typeNext(kind, index) {
  const way = { points: "place.0", lengths: "metres" }[kind];
  if (way) document.querySelector(`[data-focus="${kind}:${index}:${way}"]`)?.focus({ preventScroll: true });
}

function place(position) {
  const index = picking;
  picking = null;
  change((all) => {
    if (all.points[index]) all.points[index].place.splice(0, 2, ...metres(view().toWorld(position)));
  });
  show("image");
}

function cancel() {
  if (picking !== null) show("image");
  if (pending.length) pending = [];
  else if (group !== null) group = null;
  else if (picking === null && tool !== "select") return setTool("select");
  else if (picking === null) selected = null;
  picking = null;
  hover = null;
  refresh();
}

function step(does) {
  if (!history[does]()) return;
  pending = [];
  picking = null;
  group = null;
  if (selected && !document_()[selected.kind][selected.index]) selected = null;
  changed();
}

// ------------------------------------------------------------------------------------------------------------ views

async function show(name) {
  if (name === "above") {
    try {
      views.above = await fromAbove();
    } catch (error) {
      return trouble(error.message);
    }
  }
  const keep = name === viewName;
  if (!keep) pending = [];
  if (name !== "plan") scaling = [];
  viewName = name;
  cursor = null;
  byId("where").textContent = "";
  for (const button of byId("views").children) button.setAttribute("aria-pressed", button.dataset.view === name);
  byId("frames").hidden = name === "plan" || begun.frames < 2;
  const shown = view() || { picture: null, size: [800, 600] };
  viewport.show(shown.picture, shown.size, keep);
  setMap();
  refresh();
}

async function fromAbove() {
  const { low, high, cell_m, size, image } = await post("/above", { document: document_(), frame });
  const picture = new Image();
  picture.src = image;
  await picture.decode();
  return {
    picture,
    size,
    toWorld: ([x, y]) => [low[0] + x * cell_m, high[1] - y * cell_m],
    fromWorld: ([x, y]) => [(x - low[0]) / cell_m, (high[1] - y) / cell_m],
  };
}

async function loadPlan(file) {
  try {
    const picture = await createImageBitmap(file);
    views.plan = { picture, size: [picture.width, picture.height] };
    scaling = [];
    picking = null;
    await show("plan");
  } catch {
    trouble(`${file.name}: not an image that a browser shows`);
  }
}

function scalePlan(position) {
  if (!views.plan) return;
  scaling = [...scaling, position];
  pending = scaling;
  if (scaling.length === 2) byId("scale").showModal();
  refresh();
}

async function useScale(event) {
  event.preventDefault();
  byId("scale-wrong").textContent = "";
  try {
    const number = (id) => byId(id).value.trim().replace(",", ".");
    const asked = { ends: scaling, metres: number("scale-metres"), at: [number("scale-x"), number("scale-y")] };
    const { metres_per_pixel: size, origin: [x0, y0] } = await post("/plan", asked);
    views.plan.toWorld = ([x, y]) => [x0 + x * size, y0 - y * size];
    views.plan.fromWorld = ([x, y]) => [(x - x0) / size, (y0 - y) / size];
    scaling = [];
    pending = [];
    byId("scale").close();
    const missing = document_().points.findIndex(({ place }) => place.slice(0, 2).includes(null));
    if (missing >= 0) act.placeOnPlan(missing);
    else if (document_().points.length) refresh();
    else await show("image");
    if (tool === "select" && missing < 0) setTool("points");
  } catch (error) {
    byId("scale-wrong").textContent = error.message;
  }
}

async function turnTo(number) {
  frame = number;
  byId("frame").value = number + 1;
  byId("frame-number").textContent = `${number + 1} of ${begun.frames}`;
  try {
    const bitmap = await createImageBitmap(await (await get("/frames/" + number)).blob());
    if (frame !== number) return;
    views.image.picture = bitmap;
    stage.dataset.frame = number;
    if (viewName === "image") viewport.show(bitmap, view().size, true);
    else if (viewName === "above") await show("above");
  } catch (error) {
    trouble(error.message);
  }
}

// ------------------------------------------------------------------------------------------------------ files, saving

async function loadFile(file) {
  try {
    const found = await post("/read", { name: file.name, text: await file.text() });
    const other = found.points && document_().points.length && JSON.stringify(found.world) !== JSON.stringify(document_().world);
    if (other) return trouble(`${file.name}: its places are counted from another origin than those that are marked: take these away first`);
    change((all) => {
      if (found.points) all.points.push(...found.points);
      if (found.world) all.world = found.world;
      if (found.camera) all.camera = found.camera;
    });
    trouble(found.said || "");
  } catch (error) {
    trouble(error.message);
  }
}

async function save() {
  const asked = document_();
  try {
    const answer = await post("/save", { document: asked, revision });
    revision = answer.revision;
    base = asked;
    saved = JSON.stringify(asked);
    begun.exists = true;
    trouble("");
    byId("conflict").hidden = true;
    refresh();
    if (answer.said) byId("state").textContent = answer.said;
  } catch (error) {
    if (error.status === 409) {
      byId("conflict-words").textContent = error.message;
      byId("conflict").hidden = false;
      byId("conflict").scrollIntoView({ block: "nearest" });
      byId("merge").focus();
      return;
    }
    const problem = error.said && error.said.problem;
    if (problem) selected = { kind: problem.kind, index: problem.index, part: 0 };
    refresh();
    trouble(error.message);
    document.querySelector(".fields [aria-describedby], .fields [data-missing]")?.focus();
  }
}

async function join(both) {
  try {
    const theirs = both ? await post("/merge", { base, mine: document_() }) : await (await get("/begin.json")).json();
    revision = theirs.revision;
    base = theirs.saved;
    saved = JSON.stringify(base);
    selected = null;
    byId("conflict").hidden = true;
    history.change((all) => Object.assign(all, theirs.document));
    changed();
  } catch (error) {
    trouble(error.message);
  }
}

// -------------------------------------------------------------------------------------------------- pointer and touch

const pointers = new Map();
let action = null;

function nearest(event) {
  const [x, y] = viewport.at(event);
  let best = (NEAR_PX[event.pointerType] || NEAR_PX.mouse) / viewport.scale;
  let found = null;
  // While something is drawn, only handles of its kind are in the way: a lane may begin at a marked point.
  for (const kind of tool === "select" ? [...MARKED, ...DRAWN] : [tool]) {
    document_()[kind].forEach((entry, index) => {
      handlesOf(kind, index, entry, page()).forEach((place, part) => {
        const away = place ? Math.hypot(place[0] - x, place[1] - y) : Infinity;
        if (away < best) [best, found] = [away, { kind, index, part, offset: [place[0] - x, place[1] - y] }];
      });
    });
  }
  return found;
}

stage.addEventListener("pointerdown", (event) => {
  if (event.button > 0) return;
  event.preventDefault();
  stage.focus({ preventScroll: true });
  cursor = null;
  try { stage.setPointerCapture(event.pointerId); } catch { /* a pointer that has gone already */ }
  pointers.set(event.pointerId, event);
  if (pointers.size > 1) {
    viewport.unmagnify();
    dragged = null;
    action = { does: "pinch" };
    return drawAll();
  }
  const touch = event.pointerType === "touch";
  byTouch = touch;
  const free = pending.length === 0 && picking === null && !(viewName === "plan" && !view()?.fromWorld);
  const grabbed = free ? nearest(event) : null;
  if (grabbed) selected = { kind: grabbed.kind, index: grabbed.index, part: grabbed.part };
  const does = grabbed ? "drag" : touch && (tool !== "select" || picking !== null || !free) ? "aim" : "press";
  action = { does, grabbed, begin: event, moved: false };
  if (touch && does !== "press") viewport.magnify(event);
  if (grabbed) refresh();
});

stage.addEventListener("pointermove", (event) => {
  tell(viewport.at(event));
  const before = pointers.get(event.pointerId);
  if (!before) {
    hover = pending.length && event.pointerType === "mouse" ? viewport.at(event) : null;
    if (pending.length) drawAll();
    return;
  }
  pointers.set(event.pointerId, event);
  if (!action) return;
  if (action.does === "pinch") return pinch(event, before);
  if (Math.hypot(event.clientX - action.begin.clientX, event.clientY - action.begin.clientY) > DRAGGED_PX) action.moved = true;
  if (event.pointerType === "touch" && action.does !== "press") viewport.magnify(event);
  if (!action.moved) return;
  if (action.does === "drag") {
    const [x, y] = viewport.at(event);
    const [dx, dy] = event.pointerType === "touch" ? [0, 0] : action.grabbed.offset;
    dragged = { ...action.grabbed, position: [x + dx, y + dy] };
    drawAll();
  } else if (action.does === "press") {
    stage.classList.add("moving");
    viewport.move(event.clientX - before.clientX, event.clientY - before.clientY);
  }
});

function pinch(event, before) {
  const other = [...pointers.values()].find((one) => one.pointerId !== event.pointerId);
  if (!other) return;
  const box = stage.getBoundingClientRect();
  const apart = (one) => Math.max(Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY), 1);
  const middle = [(event.clientX + other.clientX) / 2 - box.left, (event.clientY + other.clientY) / 2 - box.top];
  viewport.zoom(apart(event) / apart(before), ...middle);
  viewport.move((event.clientX - before.clientX) / 2, (event.clientY - before.clientY) / 2);
}

function released(event, cancelled) {
  pointers.delete(event.pointerId);
  viewport.unmagnify();
  stage.classList.remove("moving");
  const done = action;
  if (!pointers.size) action = null;
  if (!done || done.does === "pinch") return;
  const moved = dragged;
  dragged = null;
  if (cancelled) return drawAll();
  if (done.does === "drag") {
    if (moved) put(moved, moved.position);
    else refresh();
  } else if (done.does === "aim" || !done.moved) mark(viewport.at(event));
}

stage.addEventListener("pointerup", (event) => released(event, false));
stage.addEventListener("pointercancel", (event) => released(event, true));
stage.addEventListener("dblclick", () => {
  if (pending.length && KINDS[tool].open) {
    pending = pending.slice(0, -1); // the second press of the double one
    finish();
  }
});
stage.addEventListener("wheel", (event) => {
  event.preventDefault();
  const box = stage.getBoundingClientRect();
  viewport.zoom(Math.exp(-Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 100) * 0.002), event.clientX - box.left, event.clientY - box.top);
}, { passive: false });

// Says what lies at a position of the view.
function tell(position) {
  const [x, y] = position;
  let words = "";
  if (within(position) && view()) {
    words = `column ${x.toFixed(1)}, row ${y.toFixed(1)}`;
    if (view().toWorld) words = "x " + view().toWorld(position)[0].toFixed(2) + " m, y " + view().toWorld(position)[1].toFixed(2) + " m";
    else if (look && look.errors) {
      const { cell, columns, values } = look.errors;
      const error = values[Math.floor(y / cell) * columns + Math.floor(x / cell)];
      words += error === null || error === undefined ? ": no road, or too far away" : `: a place there is known to ${error} m (90%)`;
    }
  }
  byId("where").textContent = words;
}

// -------------------------------------------------------------------------------------------------------------- keys

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

document.addEventListener("keydown", (event) => {
  if (document.querySelector("dialog[open]")) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const typing = event.target.closest("input:not([type=range]):not([type=checkbox]):not([type=file]), select, textarea");
  if (event.ctrlKey || event.metaKey) {
    if (key === "s") event.preventDefault(), event.target.blur?.(), setTimeout(save); // after what is being typed
    else if (!typing && key === "z") event.preventDefault(), step(event.shiftKey ? "redo" : "undo");
    else if (!typing && key === "y") event.preventDefault(), step("redo");
    return;
  }
  if (event.altKey) return;
  if (typing) {
    if (key === "Escape") stage.focus();
    return;
  }
  const handle = event.target.dataset && event.target.dataset.handle;
  if (ARROWS[key] && (handle || event.target === stage)) {
    event.preventDefault();
    return arrow(ARROWS[key], event.shiftKey ? 10 : 1, handle);
  }
  if (key === "Enter" && event.target === stage && view()) {
    event.preventDefault();
    return confirm();
  }
  const tools = Object.keys(KINDS).find((kind) => KINDS[kind].key === key);
  const does = {
    Escape: cancel,
    Delete: () => selected && act.remove(selected.kind, selected.index),
    Backspace: () => selected && act.remove(selected.kind, selected.index),
    s: () => setTool("select"),
    "+": () => viewport.zoom(1.5),
    "=": () => viewport.zoom(1.5),
    "-": () => viewport.zoom(1 / 1.5),
    0: () => viewport.fit(),
    "?": () => byId("help").showModal(),
  }[key] || (tools && (() => (setTool(tools), stage.focus())));
  if (!does) return;
  event.preventDefault();
  does();
});

function confirm() {
  const last = pending[pending.length - 1];
  if (last && KINDS[tool]?.open && cursor && last[0] === cursor[0] && last[1] === cursor[1]) return finish();
  if (cursor) return mark([...cursor]);
  if (pending.length && KINDS[tool]?.open) return finish();
}

function arrow([right, down], times, handle) {
  if (handle) {
    const [kind, index, part] = handle.split(":").map((word, i) => (i ? Number(word) : word));
    const at = handlesOf(kind, index, document_()[kind][index], page())[part];
    if (!at) return;
    const far = view().fromWorld ? times * 2 : times;
    put({ kind, index, part }, [at[0] + right * far, at[1] + down * far], `move ${handle}`);
    return;
  }
  if (!view()) return;
  const middle = [viewport.x + stage.clientWidth / 2 / viewport.scale, viewport.y + stage.clientHeight / 2 / viewport.scale];
  const from = cursor || middle.map((value, i) => Math.round(Math.min(Math.max(value, 0), view().size[i])));
  cursor = cursor ? [from[0] + right * times, from[1] + down * times] : from;
  cursor = cursor.map((value, i) => Math.min(Math.max(value, 0), view().size[i]));
  hover = pending.length ? cursor : null;
  viewport.reveal(cursor);
  tell(cursor);
  drawAll();
}

svg.addEventListener("focusin", ({ target }) => {
  if (!target.dataset.handle) return;
  const [kind, index, part] = target.dataset.handle.split(":").map((word, i) => (i ? Number(word) : word));
  if (selected && selected.kind === kind && selected.index === index && selected.part === part) return;
  selected = { kind, index, part };
  // The handles are made anew: only after the browser has done with the one that it has just given the focus.
  setTimeout(refresh);
});

// ------------------------------------------------------------------------------------------------------------- begin

function listen() {
  const on = (id, does, kind = "click") => byId(id).addEventListener(kind, does);
  on("undo", () => step("undo"));
  on("redo", () => step("redo"));
  on("save", save);
  on("merge", () => join(true));
  on("theirs", () => join(false));
  on("ask", () => byId("help").showModal());
  on("larger", () => viewport.zoom(1.5));
  on("smaller", () => viewport.zoom(1 / 1.5));
  on("whole", () => viewport.fit());
  on("frame", () => turnTo(Number(byId("frame").value) - 1), "change");
  on("scale-form", useScale, "submit");
  on("scale-again", () => byId("scale").close());
  byId("scale").addEventListener("close", () => {
    if (!scaling.length) return;
    [scaling, pending] = [[], []];
    refresh();
  });
  for (const [id, does] of [["file", loadFile], ["plan", loadPlan]]) {
    on(id, (event) => {
      if (event.target.files[0]) does(event.target.files[0]);
      event.target.value = "";
    }, "change");
  }
  for (const button of byId("views").children) button.addEventListener("click", () => show(button.dataset.view));
  stage.addEventListener("blur", () => {
    if (!cursor) return;
    cursor = null;
    drawAll();
  });
  new ResizeObserver(() => viewport.move(0, 0)).observe(stage);
  addEventListener("beforeunload", (event) => JSON.stringify(document_()) !== saved && event.preventDefault());
}

async function begin() {
  begun = await (await get("/begin.json")).json();
  history = new History(begun.document);
  [revision, base, saved] = [begun.revision, begun.saved, JSON.stringify(begun.saved)];
  byId("title").textContent = `${begun.title} → ${begun.file}`;
  document.title = `${begun.title}: site`;
  views.image.size = begun.size;
  byId("frame").max = Math.max(begun.frames, 1);
  toolbar(byId("tools"), { choose: chooseTool, finish, cancel });
  switches(byId("layers"), layers, (name) => (name === "errors" ? setMap() : drawAll()));
  legend(byId("legend"));
  listen();
  keyList(byId("keys"));
  await show("image");
  setTool(begun.document.points.length ? "select" : "points");
  askLook(document_());
  if (begun.frames) await turnTo(begun.frame);
  stage.dataset.ready = "true";
}

begin().catch((error) => trouble(error.message));
