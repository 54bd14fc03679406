// The page on which a camera is calibrated and a road drawn. What a file says gets into it as text or as numbers of a
// drawing; places, residuals and warnings come from the server.

import { CameraPanel } from "./camera_panel.js";
import { keyList, legend, switches, toolbar } from "./controls.js";
import { redraw, handlesOf } from "./drawing.js";
import { edits, loadFile } from "./edits.js";
import { History } from "./history.js";
import { hintFor } from "./hints.js";
import { Keys, handleOf } from "./keys.js";
import { KINDS, made, metres, pixel, setPosition } from "./kinds.js";
import { fill, footage, known, text } from "./panel.js";
import { Pointer } from "./pointer.js";
import { Saving } from "./saving.js";
import { get, newest, post } from "./server.js";
import { Viewport } from "./viewport.js";
import { Views } from "./views.js";

const byId = (id) => document.getElementById(id);
const stage = byId("stage");
const svg = byId("drawing");
const viewport = new Viewport(stage, byId("canvas"), svg, byId("loupe"));

const WAIT_MS = 120; // before the server is asked for what changed

let history; // of the document
let begun; // what the server said at the start
let saving; // what of the document is in the file
let look = null; // the server's answer to the document
const now = {
  tool: "select",
  pending: [], // positions of what is being drawn, in the view
  group: null, // index of the parallel lines that the next line joins
  selected: null, // { kind, index, part }
  dragged: null, // { kind, index, part, position }
  hover: null,
  cursor: null, // of the keyboard, in the view
  byTouch: false, // whether a finger has touched the picture last
  picking: null, // index of the point whose place is clicked on the plan
  refused: null, // a problem of what was typed last, which is not in the document
};
const layers = { errors: true, grid: true, posts: true, boxes: true, residuals: true, names: true };
const narrow = matchMedia("(max-width: 56rem)"); // as in site.css: the list is far below the picture
let views;
let cameraPanel;
const view = () => views.current;
const document_ = () => history.document;

// ---------------------------------------------------------------------------------------------------------- showing

const page = () => ({
  ...now,
  document: document_(),
  look,
  view: view() || { size: [1, 1] },
  layers,
  unit: 1 / viewport.scale,
  planReady: Boolean(document_().plan && views.plan.view(document_().plan)),
  residualOf: (kind, index) => (look ? look.residuals.find((one) => one.kind === kind && one.index === index) : undefined),
  problemsOf: (kind, index) => problems().filter((one) => one.kind === kind && one.index === index),
  warningsOf: (kind, index) => (look ? look.shapes.find((one) => one.kind === kind && one.index === index)?.warnings || [] : []),
});

const problems = () => [...(look ? look.problems : []), ...(now.refused ? [now.refused] : [])];

const drawAll = () => redraw(svg, page());
viewport.shown = () => views && drawAll();

function refresh() {
  drawAll();
  fill({ marks: byId("marks"), road: byId("road"), sheet: byId("sheet"), narrow: narrow.matches }, page(), act);
  known(byId("known"), page(), act);
  footage(byId("footage"), page(), act);
  byId("undo").disabled = !history.past.length;
  byId("redo").disabled = !history.future.length;
  const same = saving.has(document_());
  byId("save").disabled = same;
  byId("state").textContent = same ? (saving.exists ? "saved" : "") : "not saved yet";
  const { tool, pending } = now;
  for (const button of byId("tools").querySelectorAll("[data-tool]")) button.setAttribute("aria-pressed", button.dataset.tool === tool);
  byId("finish").hidden = !(pending.length && KINDS[tool] && KINDS[tool].open);
  byId("cancel").hidden = !pending.length && now.picking === null;
  byId("plan-tools").hidden = views.name !== "plan" || !document_().plan;
  stage.classList.toggle("selecting", tool === "select" && now.picking === null);
  byId("hint").textContent = hintFor(document_(), now, views, look);
}

function trouble(words) {
  byId("problem").textContent = words;
  byId("problem").hidden = !words;
}

// ----------------------------------------------------------------------------------------------------- the document

const askLook = newest("/look", (answer) => {
  look = answer;
  stage.setAttribute("aria-busy", "false");
  cameraPanel.show(look);
  setMap();
  refresh();
}, (error) => trouble(error.message));
let asking;

function changed() {
  trouble("");
  now.refused = null;
  stage.setAttribute("aria-busy", "true");
  clearTimeout(asking);
  asking = setTimeout(() => askLook(document_()), WAIT_MS);
  refresh();
}

function change(edit, of = null) {
  if (history.change(edit, of)) changed();
}

function setMap() {
  const errors = layers.errors && views.name === "image" && look ? look.errors : null;
  viewport.setMap(errors);
  byId("legend").hidden = !errors;
}

const act = {
  ...edits(now, { document: () => history.document, change, refresh }),
  choose(what) {
    now.selected = what;
    if (what) {
      const place = handlesOf(what.kind, what.index, document_()[what.kind][what.index], page())[what.part || 0];
      if (place) viewport.reveal(place);
    }
    refresh();
  },
  addLine(index) {
    setTool("parallels");
    now.group = index;
    views.show("image");
  },
  placeOnPlan(index) {
    now.picking = index;
    views.show("plan");
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

const NOTHING = { pending: [], hover: null, group: null, picking: null };

function setTool(name) {
  Object.assign(now, NOTHING, { tool: name });
  trouble("");
  refresh();
}

function chooseTool(name) {
  setTool(name);
  if (KINDS[name] && !KINDS[name].world && views.name !== "image") views.show("image");
}

// A position of the view was clicked, touched, or confirmed by Enter.
async function mark(position) {
  if (!within(position)) return;
  if (views.scaling) {
    if (view()) views.plan.click(position);
    now.pending = views.plan.ends;
    return refresh();
  }
  if (now.picking !== null) return place(position);
  if (now.tool === "select") return act.choose(null);
  const { count, open, world } = KINDS[now.tool];
  if (!world && views.name !== "image") return trouble("Mark that in the image.");
  now.pending = [...now.pending, position];
  if (!open && now.pending.length === count) await finish();
  else refresh();
}

const within = ([x, y]) => Boolean(view()) && x >= 0 && y >= 0 && x <= view().size[0] && y <= view().size[1];

async function finish() {
  const kind = now.tool;
  const { count, world } = KINDS[kind];
  const drawn = now.pending;
  if (drawn.length < count) return trouble(`A ${KINDS[kind].word.toLowerCase()} needs ${count} positions or more.`);
  Object.assign(now, { pending: [], hover: null });
  let positions = world ? [] : drawn.map(pixel);
  if (world) positions = view().fromWorld ? drawn.map((position) => metres(view().toWorld(position))) : await placesOf(drawn);
  if (!positions.length) return refresh();
  if (kind === "parallels" && now.group !== null && document_().parallels[now.group]) {
    now.selected = { kind, index: now.group, part: 0 };
    return change((all) => all.parallels[now.group].lines.push(positions));
  }
  now.selected = { kind, index: document_()[kind].length, part: 0 };
  if (kind === "parallels") now.group = now.selected.index;
  change((all) => all[kind].push(made(kind, positions, all[kind])));
  if (kind === "points" && page().planReady) act.placeOnPlan(now.selected.index);
  else if (!now.byTouch) typeNext(kind, now.selected.index);
}

// What is marked is told at once: the field of its place or its length has the focus. A finger would get a keyboard
// over the picture.
function typeNext(kind, index) {
  const way = { points: "place.0", lengths: "metres" }[kind];
  if (way) document.querySelector(`[data-focus="${kind}:${index}:${way}"]`)?.focus({ preventScroll: true });
}

function place(position) {
  const index = now.picking;
  now.picking = null;
  change((all) => {
    if (all.points[index]) all.points[index].place.splice(0, 2, ...metres(view().toWorld(position)));
  });
  views.show("image");
}

function cancel() {
  const { picking, pending, group, tool } = now;
  if (picking !== null) views.show("image");
  else if (!pending.length && group === null && tool !== "select") return setTool("select");
  else if (!pending.length && group === null) now.selected = null;
  if (!pending.length) now.group = null;
  Object.assign(now, { pending: [], picking: null, hover: null });
  views.plan.ends = [];
  refresh();
}

function step(does) {
  if (!history[does]()) return;
  Object.assign(now, NOTHING);
  const { selected } = now;
  if (selected && !document_()[selected.kind][selected.index]) now.selected = null;
  if (views.name === "plan") views.show("plan");
  changed();
}

// The plan has its scale: places that are missing are clicked there, others in the image.
async function placed() {
  const missing = document_().points.findIndex(({ place: [x, y] }) => x === null || y === null);
  if (missing >= 0) act.placeOnPlan(missing);
  else await views.show(document_().points.length ? "plan" : "image");
  if (now.tool === "select" && missing < 0) setTool("points");
}

// ------------------------------------------------------------------------------------------------------------- files

async function load(file) {
  try {
    trouble(await loadFile(file, { document: document_, change }));
  } catch (error) {
    trouble(error.message);
  }
}

const save = () => saving.save(document_());

// A problem keeps the document from being saved: its field is shown.
function wrong(problem) {
  if (problem && KINDS[problem.kind]) now.selected = { kind: problem.kind, index: problem.index, part: 0 };
  if (problem && !KINDS[problem.kind]) byId(`${problem.kind}-details`).open = true;
  refresh();
  document.querySelector(".fields [aria-describedby], .fields [data-missing]")?.focus();
}

function replace(other) {
  now.selected = null;
  history.change((all) => Object.assign(all, other));
  changed();
}

// ---------------------------------------------------------------------------------------------------- mouse and keys

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

const help = () => byId("help").showModal();
const grabs = () => !now.pending.length && now.picking === null && !views.scaling;

function choose({ kind, index, part }) {
  now.selected = { kind, index, part };
  refresh();
}

// The second press of two ends what is drawn; it is no further position.
function ended() {
  if (!now.pending.length || !KINDS[now.tool].open) return;
  now.pending = now.pending.slice(0, -1);
  finish();
}

svg.addEventListener("focusin", ({ target }) => {
  const handle = handleOf(target);
  const { selected } = now;
  if (!handle || (selected && selected.kind === handle.kind && selected.index === handle.index && selected.part === handle.part)) return;
  now.selected = handle;
  // The handles are made anew: only after the browser has done with the one that it has just given the focus.
  setTimeout(refresh);
});

// ------------------------------------------------------------------------------------------------------------- begin

function listen() {
  const on = (id, does, kind = "click") => byId(id).addEventListener(kind, does);
  on("undo", () => step("undo"));
  on("redo", () => step("redo"));
  on("save", save);
  on("merge", () => saving.join(document_()));
  on("theirs", () => saving.join(null));
  on("finish", finish);
  on("cancel", cancel);
  on("ask", help);
  on("larger", () => viewport.zoom(1.5));
  on("smaller", () => viewport.zoom(1 / 1.5));
  on("whole", () => viewport.fit());
  for (const [id, does] of [["file", load], ["plan", (picture) => views.loadPlan(picture)]]) {
    on(id, (event) => {
      if (event.target.files[0]) does(event.target.files[0]);
      event.target.value = "";
    }, "change");
  }
  narrow.addEventListener("change", refresh);
  const does = { mark, put, choose, ended, tell, draw: drawAll, grabs, save, step, cancel, remove: act.remove, setTool, finish, help };
  new Pointer(stage, viewport, now, page, does);
  new Keys(stage, viewport, now, page, does);
  new ResizeObserver(() => viewport.move(0, 0)).observe(stage);
  addEventListener("beforeunload", (event) => !saving.has(document_()) && event.preventDefault());
}

async function begin() {
  begun = await (await get("/begin.json")).json();
  history = new History(begun.document);
  saving = new Saving(begun, { refresh, trouble, wrong, replace });
  byId("title").textContent = `${begun.title} → ${begun.file}`;
  document.title = `${begun.title}: site`;
  cameraPanel = new CameraPanel({ document: document_, change, trouble, placesOf });
  views = new Views(begun, viewport, now, { document: document_, change, trouble, placed, shown: () => (setMap(), refresh()) });
  byId("zones").replaceChildren(...begun.zones.map((value) => text("option", "", { value })));
  toolbar(byId("tools"), chooseTool);
  switches(byId("layers"), layers, (name) => (name === "errors" ? setMap() : drawAll()));
  legend(byId("legend"));
  listen();
  keyList(byId("keys"));
  await views.show("image");
  setTool(begun.document.points.length ? "select" : "points");
  askLook(document_());
  if (begun.frames) await views.turnTo(begun.frame);
  views.plan.want(document_().plan).catch((error) => trouble(error.message));
  stage.dataset.ready = "true";
}

begin().catch((error) => trouble(error.message));
