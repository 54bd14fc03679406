// Page for calibrating a camera and drawing a road. Contents of files enter it only as text or as numbers of a
// drawing; positions, residuals and warnings come from the server.

import { byId, get, text } from "./dom.js";
import { handlesOf, redraw } from "./draw.js";
import { Keys, Pointer, handleOf } from "./input.js";
import { History, KINDS, MARKED, Marking, edits, inImage, loadFile, setLimits } from "./marks.js";
import { CameraPanel, fill, footage, hintFor, keyList, known, legend, switches, toolbar } from "./panel.js";
import { SitePicture } from "./picture.js";
import { Saving, newest, post } from "./server.js";
import { Views } from "./views.js";

const stage = byId("stage");
const svg = byId("drawing");
const viewport = new SitePicture(stage, byId("canvas"), svg, byId("loupe"));

const WAIT_MS = 120; // before a change is sent to the server

let history; // of the document
let begun; // the server's first answer
let saving; // state of the saved file
let look = null; // the server's answer to the document
const now = {
  tool: "select",
  pending: [], // positions of the unfinished drawing, in the view
  group: null, // index of the parallel lines that the next line joins
  selected: null, // { kind, index, part }
  dragged: null, // { kind, index, part, position }
  hover: null,
  cursor: null, // position of the cross-hair in the view
  byTouch: false, // whether a finger has touched the picture last
  picking: null, // index of the point to be clicked on the plan
  refused: null, // problem of the last input, which was rejected
};
const layers = { errors: true, grid: true, posts: true, boxes: true, residuals: true, names: true };
const narrow = matchMedia("(max-width: 56rem)"); // as in site.css: the list is far below the picture
let views;
let marking; // handler of clicks on the picture
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
  planReady: views.planReady,
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
  byId("then").hidden = !(same && saving.exists && begun.measure && look && !problems().length && document_().gates.some((gate) => look.camera || inImage("gates", gate)));
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

// Input of the server's calibration.
const evidenceOf = (document) => JSON.stringify([...MARKED, "camera", "known"].map((key) => document[key]));
let solvedFrom = evidenceOf({ points: [], lengths: [], parallels: [], verticals: [], camera: null, known: {} }); // input of the shown camera

const askLook = newest("/look", (answer, asked) => {
  look = answer;
  solvedFrom = evidenceOf(asked);
  if (asked === document_()) stage.setAttribute("aria-busy", "false"); // otherwise the newest document is still to be sent
  showBusy();
  cameraPanel.show(look);
  setMap();
  refresh();
}, (error) => {
  trouble(error.message);
  stage.setAttribute("aria-busy", "false");
  cameraPanel.busy(false);
});
let asking;

// Until the answer to the newest input arrives, an earlier camera is shown.
const showBusy = () => cameraPanel.busy(evidenceOf(document_()) !== solvedFrom);

function changed() {
  trouble("");
  now.refused = null;
  stage.setAttribute("aria-busy", "true");
  clearTimeout(asking);
  asking = setTimeout(() => askLook(document_()), WAIT_MS);
  showBusy();
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
    marking.setTool("parallels");
    now.group = index;
    views.show("image");
  },
  placeOnPlan(index) {
    now.picking = index;
    views.show("plan");
  },
};

// Road positions of pixels; an empty list and a message if a pixel has none.
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

// Road positions of the ends of a gate in the image; undefined if the camera gives none.
const onRoad = (index) => look?.shapes.find((one) => one.kind === "gates" && one.index === index)?.places;

function step(does) {
  if (!history[does]()) return;
  marking.drop();
  const { selected } = now;
  if (selected && !document_()[selected.kind][selected.index]) now.selected = null;
  if (views.name === "plan") views.show("plan");
  changed();
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

// A problem that prevents saving: shows its field.
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

const help = () => byId("help").showModal();
const grabs = () => !now.pending.length && now.picking === null && !views.scaling;

function choose({ kind, index, part }) {
  now.selected = { kind, index, part };
  refresh();
}

svg.addEventListener("focusin", ({ target }) => {
  const handle = handleOf(target);
  const { selected } = now;
  if (!handle || (selected && selected.kind === handle.kind && selected.index === handle.index && selected.part === handle.part)) return;
  now.selected = handle;
  // Rebuilds the handles after the browser has finished with the newly focused one.
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
  on("finish", () => marking.finish());
  on("cancel", () => marking.cancel());
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
  const does = { choose, draw: drawAll, grabs, save, step, remove: act.remove, help };
  does.tell = (position) => marking.tell(position, look?.errors);
  for (const name of ["mark", "put", "ended", "cancel", "setTool", "finish"]) does[name] = (...told) => marking[name](...told);
  new Pointer(stage, viewport, now, page, does);
  new Keys(stage, viewport, now, page, does);
  new ResizeObserver(() => viewport.resized()).observe(stage);
  addEventListener("beforeunload", (event) => !saving.has(document_()) && event.preventDefault());
}

// The user's next step: gates need footage alone, points without footage calibrate a camera.
function firstTool({ document, frames }) {
  if (MARKED.some((kind) => document[kind].length) || document.gates.length) return "select";
  return frames ? "gates" : "points";
}

async function begin() {
  begun = await (await get("/begin.json")).json();
  setLimits(begun.limits);
  history = new History(begun.document);
  saving = new Saving(begun, { refresh, trouble, wrong, replace });
  byId("title").textContent = `${begun.title} → ${begun.file}`;
  document.title = `${begun.title}: site`;
  byId("measure").textContent = begun.measure;
  cameraPanel = new CameraPanel({ document: document_, change, trouble, placesOf });
  const placed = () => marking.placed();
  views = new Views(begun, viewport, now, { document: document_, change, trouble, placed, shown: () => (setMap(), refresh()) });
  marking = new Marking(now, views, { document: document_, change, refresh, trouble, placesOf, onRoad, ...act });
  byId("zones").replaceChildren(...begun.zones.map((value) => text("option", "", { value })));
  toolbar(byId("tools"), (name) => marking.chooseTool(name));
  switches(byId("layers"), layers, (name) => (name === "errors" ? setMap() : drawAll()));
  legend(byId("legend"));
  listen();
  keyList(byId("keys"));
  await views.show("image");
  marking.setTool(firstTool(begun));
  showBusy();
  askLook(document_());
  if (begun.frames) await views.turnTo(begun.frame);
  views.plan.want(document_().plan).catch((error) => trouble(error.message));
  stage.dataset.ready = "true";
}

begin().catch((error) => trouble(error.message));
