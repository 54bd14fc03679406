// Panels around the picture: tools, layers, lists of entries with fields, figures of the camera, advice.

import { byId, terms, text } from "./dom.js";
import { DRAWN, KINDS, LIMITS, MARKED, MovedDrawings, fieldsOf, inImage, setPosition, setValue, typed, valueAt } from "./marks.js";
import { post } from "./server.js";
import { CLASSES, COLORS } from "./picture.js";

// Refills the lists; the focused field and its input stay. On a narrow page,
// the fields of the selected entry are in a sheet below the picture, not in the list.
export function fill({ marks, road, sheet, narrow }, page, act) {
  const active = document.activeElement;
  const focused = active && active.dataset && active.dataset.focus;
  const typing = focused && active instanceof HTMLInputElement ? { value: active.value, from: active.selectionStart, to: active.selectionEnd, was: active.dataset.was } : null;
  const shown = { ...page, narrow };
  rows(marks, MARKED, "Nothing is marked yet.", shown, act);
  rows(road, DRAWN, page.look && page.look.camera ? "Nothing is drawn yet." : "Nothing is drawn yet. Gates need no calibration; zones and lanes do.", shown, act);
  fillSheet(sheet, narrow ? page.selected : null, page, act);
  if (!focused) return;
  const again = [marks, road, sheet].flatMap((list) => [...list.querySelectorAll("[data-focus]")]).find((one) => one.dataset.focus === focused);
  if (!again) return;
  again.focus({ preventScroll: true });
  if (typing && typing.value !== typing.was) again.value = typing.value;
  if (typing) again.setSelectionRange(typing.from, typing.to);
}

function fillSheet(sheet, chosen, page, act) {
  const entry = chosen && page.document[chosen.kind][chosen.index];
  sheet.hidden = !entry;
  if (!entry) return sheet.replaceChildren();
  const head = text("p", "", { class: "row" });
  head.append(text("strong", title(chosen.kind, chosen.index, entry)), button("Done", () => act.choose(null)));
  sheet.replaceChildren(head, form(chosen.kind, chosen.index, entry, page, act));
}

function rows(list, kinds, empty, page, act) {
  const out = [];
  for (const kind of kinds) page.document[kind].forEach((entry, index) => out.push(row(kind, index, entry, page, act)));
  list.replaceChildren(...(out.length ? out : [text("li", empty, { class: "empty" })]));
}

function row(kind, index, entry, page, act) {
  const chosen = Boolean(page.selected && page.selected.kind === kind && page.selected.index === index);
  const item = text("li", "", { class: kind });
  const button = text("button", "", { type: "button", class: "choose", "aria-expanded": chosen, "data-focus": `${kind}:${index}` });
  const value = valueOf(kind, index, page);
  button.append(
    text("span", "", { class: "mark", "aria-hidden": "true" }),
    text("span", title(kind, index, entry), { class: "name" }),
    text("span", value.words, { class: value.bad ? "value bad" : "value" }),
  );
  button.addEventListener("click", () => act.choose(chosen ? null : { kind, index, part: 0 }));
  item.append(button);
  const others = page.residualOf(kind, index)?.by_others;
  if (others) item.append(byOthers(others));
  const warnings = page.warningsOf(kind, index);
  if (warnings.length) {
    const made = text("ul", "", { class: "warnings" });
    made.append(...warnings.map((words) => text("li", words)));
    item.append(made);
  }
  if (chosen && !page.narrow) item.append(form(kind, index, entry, page, act));
  return item;
}

// Leave-one-out error of this point, next to its 90% bound: the test of a map.
function byOthers([error, stated]) {
  const words = `by the others ${short(error)} off (stated: ${short(stated)})`;
  return text("p", words, { class: error > stated ? "others bad" : "others" });
}

const short = (m) => `${m < 10 ? m.toFixed(2) : m.toFixed(0)} m`;

// The name, preceded by its kind unless it begins with it.
function title(kind, index, { name }) {
  const { word } = KINDS[kind];
  return name && name.toLowerCase().startsWith(word.toLowerCase()) ? name : `${word} ${name || index + 1}`;
}

function valueOf(kind, index, page) {
  const problems = page.problemsOf(kind, index);
  if (problems.some(({ missing }) => !missing)) return { words: "to mend", bad: true };
  if (problems.length) return { words: problems[0].field.startsWith("place") ? "place missing" : "to fill in", bad: true };
  const result = page.residualOf(kind, index);
  if (!result || result.value === null) return { words: page.warningsOf(kind, index).length ? "warning" : "", bad: true };
  const number = `${result.value < 10 ? result.value.toFixed(result.unit === "m" ? 2 : 1) : Math.round(result.value)} ${result.unit === "deg" ? "°" : result.unit} off`;
  return { words: result.left_out ? `left out: ${number}` : number, bad: result.wrong };
}

function form(kind, index, entry, page, act) {
  const made = text("div", "", { class: "fields" });
  const problems = page.problemsOf(kind, index);
  const said = new Set(); // a problem of several fields is shown once
  const tell = (field) => problems.filter((one) => one.field === field.name && !said.has(one)).forEach((problem) => {
    said.add(problem);
    const id = `wrong-${kind}-${index}-${field.way.join("-")}`;
    field.input.setAttribute("aria-describedby", id);
    field.input.setAttribute("aria-invalid", "true");
    made.append(text("p", problem.text, { class: "wrong", id }));
  });
  for (const field of fieldsOf(kind, entry)) {
    const value = valueAt(entry, field.way);
    const edit = (input) => act.edit(kind, index, (one) => {
      setValue(one, field.way, field.text ? input.value : typed(input.value));
      if (inImage(kind, one) && field.way[0] === "pixels") delete one.line; // of the earlier position
    });
    field.input = labelled(made, `${kind}:${index}:${field.way.join(".")}`, field, value, edit);
    const empty = problems.find((one) => one.field === field.name && one.missing);
    if (empty && field.input.value === "") {
      said.add(empty);
      Object.assign(field.input, { placeholder: "?", title: empty.text });
      field.input.dataset.missing = "";
    }
    tell(field);
    if (kind === "points" && field.name === "place.z") {
      const map = { way: ["map"], name: "map", words: "or latitude, longitude, as maps give them", text: true, wide: true, usual: "49.00012, 8.40034" };
      const refused = problems.find((one) => one.field === "map");
      map.input = labelled(made, `${kind}:${index}:map`, map, refused ? refused.typed : "", (input) => act.fromMap(index, input.value));
      tell(map);
    }
  }
  for (const problem of problems.filter((one) => !said.has(one))) made.append(text("p", problem.text, { class: "wrong" }));
  const buttons = text("p", "", { class: "row wide" });
  if (kind === "points" && page.planReady) buttons.append(button("Click its place on the plan", () => act.placeOnPlan(index)));
  if (kind === "parallels") buttons.append(button("Add a line", () => act.addLine(index)));
  if (kind === "gates") buttons.append(button("Swap its sides", () => act.edit(kind, index, (one) => [one.line, one.pixels].forEach((ends) => ends?.reverse()))));
  if (kind === "lanes") buttons.append(button("Turn round", () => act.edit(kind, index, (one) => one.line.reverse())));
  buttons.append(button("Delete", () => act.remove(kind, index)));
  made.append(buttons);
  return made;
}

// A field with its label; `edit` receives it when its input changes.
function labelled(box, focus, { words, wide, two, half, text: plain, usual, name, list }, value, edit) {
  const label = text("label", words, { class: wide ? "wide" : two ? "two" : half ? "half" : "" });
  const input = text("input", "", { "data-focus": focus, "data-name": name, autocomplete: "off" });
  if (!plain) input.inputMode = "decimal";
  if (name === "name") input.maxLength = LIMITS.longest_name;
  if (usual) input.placeholder = usual;
  if (list) input.setAttribute("list", list);
  input.value = value === null || value === undefined ? "" : String(value);
  input.dataset.was = input.value;
  input.addEventListener("change", () => {
    input.dataset.was = input.value;
    // A change rebuilds the list: only after Tab has moved the focus.
    setTimeout(() => edit(input));
  });
  label.append(input);
  box.append(label);
  return input;
}

const KNOWN = [["fov_deg", "field of view, degrees"], ["height_m", "height over the road, m"]];
const FOOTAGE = [
  { name: "time_zone", words: "time zone", usual: "Europe/Berlin", list: "zones" },
  { name: "start", words: "begins at", usual: "2026-11-26 10:00:00" },
];

// Prior values of the camera: a value and its accuracy.
export function known(box, page, act) {
  plain(box, (made) => {
    for (const [name, words] of KNOWN) {
      const pair = page.document.known[name] || [null, null];
      labelled(made, `known:${name}:0`, { name, words, two: true }, pair[0], (input) => act.know(name, 0, typed(input.value)));
      labelled(made, `known:${name}:1`, { name, words: "± (standard deviation)" }, pair[1], (input) => act.know(name, 1, typed(input.value)));
      tellOf("known", name, made, page);
    }
    const { lens } = page.document.known;
    if (!lens) return;
    const [focal, k1] = [lens.focal_px, lens.k1];
    const distortion = k1 ? `, distortion k1 ${k1[0].toFixed(3)} ± ${k1[1]}` : "";
    made.append(text("p", `Lens of a camera file: focal length ${focal[0].toFixed(0)} ± ${focal[1].toFixed(0)} px${distortion}`, { class: "whole" }));
    made.append(button("Take the lens away", act.forgetLens));
  });
}

// Start time of the footage.
export function footage(box, page, act) {
  plain(box, (made) => {
    for (const field of FOOTAGE) {
      const edit = (input) => act.set(field.name, input.value.trim() || null);
      labelled(made, `footage:0:${field.name}`, { ...field, text: true, wide: true }, page.document[field.name], edit);
      tellOf("footage", field.name, made, page);
    }
  });
}

function tellOf(kind, name, box, page) {
  const problem = page.problemsOf(kind, 0).find(({ field }) => field === name);
  if (!problem) return;
  const input = box.querySelector(`[data-name="${name}"]`);
  const id = `wrong-${kind}-${name}`;
  input.setAttribute("aria-invalid", "true");
  input.setAttribute("aria-describedby", id);
  box.append(text("p", problem.text, { class: "wrong", id }));
}

// Refills a box; the focus and unfinished input stay.
function plain(box, fillIn) {
  const active = box.contains(document.activeElement) ? document.activeElement : null;
  if (active && active.dataset.was !== active.value && active.dataset.was !== undefined) return;
  const made = document.createElement("div");
  fillIn(made);
  box.replaceChildren(...made.childNodes);
  if (active) box.querySelector(`[data-focus="${active.dataset.focus}"]`)?.focus({ preventScroll: true });
}

function button(words, does) {
  const made = text("button", words, { type: "button", "data-focus": words });
  made.addEventListener("click", does);
  return made;
}

function figures(list, summary, camera) {
  terms(list, camera.figures.map(({ name, value, sigma, unit }) => {
    const digits = unit === "px" ? 0 : 2;
    return [name, `${value.toFixed(digits)}${sigma === null ? "" : " ± " + sigma.toFixed(digits)} ${unit}`];
  }));
  const [focal, height, tilt] = camera.figures;
  summary.textContent = `${height.value.toFixed(1)} m high, ${tilt.value.toFixed(1)}° down, focal length ${focal.value.toFixed(0)} px`;
}

// ------------------------------------------------------------------------------------------------------------ controls

// Fixed parts around the picture: tool buttons, layers, legend, list of keys.

const LAYERS = [
  ["errors", "how well places are known"],
  ["grid", "grid on the road, horizon"],
  ["posts", "posts, 3 m"],
  ["boxes", "boxes as large as cars"],
  ["residuals", "how far marks are off, ten times as long"],
  ["names", "names"],
];

const KEYS = [
  ["Tab", "on to the next mark, button or field"],
  ["← ↑ → ↓", "in the picture: move the cross-hair, or the mark that has the focus; with Shift ten times as far"],
  ["Enter", "mark at the cross-hair; end a lane, a zone or an occluder on its last position"],
  ["Esc", "leave what is being drawn, the tool, the choice"],
  ["Delete", "take away what is chosen"],
  ["Ctrl Z, Ctrl Y", "undo, redo"],
  ["Ctrl S", "save"],
  ["+ − 0", "larger, smaller, whole picture"],
  ["S", "choose and move"],
  ...Object.values(KINDS).map(({ key, word }) => [key.toUpperCase(), word]),
];

// Actions of the keys, as a list of terms.
export const keyList = (list) => terms(list, KEYS);

// The buttons of all tools; `choose` receives the name of the tool.
export function toolbar(bar, choose) {
  const button = (name, words, key) => {
    const made = text("button", words, { type: "button", "data-tool": name, "aria-pressed": "false", title: `${words} (${key})` });
    made.addEventListener("click", () => choose(name));
    return made;
  };
  bar.append(
    button("select", "Choose", "S"),
    text("span", "Draw"),
    ...DRAWN.map((kind) => button(kind, KINDS[kind].word, KINDS[kind].key.toUpperCase())),
    text("span", "Calibrate"),
    ...MARKED.map((kind) => button(kind, KINDS[kind].word, KINDS[kind].key.toUpperCase())),
  );
}

// A checkbox for each layer; `switched` receives its name.
export function switches(box, layers, switched) {
  for (const [name, words] of LAYERS) {
    const input = text("input", "", { type: "checkbox", "data-layer": name });
    input.checked = layers[name];
    input.addEventListener("change", () => {
      layers[name] = input.checked;
      switched(name);
    });
    const whole = text("label", "");
    whole.append(input, words);
    box.append(whole);
  }
}

// Legend of the map of errors.
export function legend(list) {
  const chips = COLORS.map((color, i) => {
    const words = i < CLASSES.length ? `to ${CLASSES[i]} m` : `over ${CLASSES[CLASSES.length - 1]} m`;
    const chip = text("span", "", { class: "chip" });
    chip.style.backgroundColor = color;
    const item = text("li", "");
    item.append(chip, words);
    return item;
  });
  list.replaceChildren(text("li", "Position error on the road (90%)"), ...chips);
}

// --------------------------------------------------------------------------------------------------------------- hints

// The next step, as a sentence over the picture.

const CAMERA_NEEDED = "Zones and lanes are in metres: calibrate the camera first.";
const CALIBRATED = "Where grid and boxes lie on the road, continue with Gate, Zone and Lane; more points make positions more exact.";
const PLAN = {
  gone: "The plan's picture is not there any more: load it again.",
  none: "Load a map, a plan or an aerial picture first.",
  first: "Click the first of two points of the plan with a known distance.",
  second: "Click the second point.",
};
const CHOOSE = "Drag marks to correct them; drag the picture to move it, zoom with the wheel or two fingers.";
const GATE_DRAWN = "Name its directions if you like, draw further gates, or press Save. Arrows 1 and 2 are the two directions.";
const ANOTHER_LINE = "Click both ends of another line that is parallel to it on the road; Esc ends the group.";

// `now` is the page's state, `views` the shown views, `look` the server's answer to `document`.
export function hintFor(document, now, views, look) {
  const { tool, picking, group, pending } = now;
  if (views.scaling && !views.current) return document.plan ? PLAN.gone : PLAN.none;
  if (views.scaling) return views.plan.ends.length ? PLAN.second : PLAN.first;
  const point = picking === null ? undefined : document.points[picking];
  if (point) return `Click the place of point ${point.name || picking + 1} on the plan (Esc: type it instead).`;
  if (tool === "select") return CHOOSE;
  if (KINDS[tool].world && tool !== "gates" && !(look && look.camera) && views.name === "image") return CAMERA_NEEDED;
  if (tool === "parallels" && group !== null && !pending.length) return ANOTHER_LINE;
  if (tool === "gates" && document.gates.length && !pending.length) return GATE_DRAWN;
  if (tool !== "points" || !document.points.length || !look) return KINDS[tool].hint;
  // Missing data are shown at the picture, because on a phone the list is far below.
  if (look.message) return look.message;
  return look.camera && !DRAWN.some((kind) => document[kind].length) ? CALIBRATED : KINDS.points.hint;
}

// -------------------------------------------------------------------------------------------------------- camera panel

// The camera panel: figures, warnings, missing data, corrections by button, and drawings that moved with the camera.

export class CameraPanel {
  // `does` has `document`, `change`, `trouble`, and `placesOf` (pixels on the road).
  constructor(does) {
    Object.assign(this, { does, drawings: new MovedDrawings(), moved: [] });
    byId("keep-image").addEventListener("click", () => this.keepInImage());
    byId("keep-metres").addEventListener("click", () => this.keepMetres());
    for (const button of byId("mend").children) button.addEventListener("click", () => this.mend(button.dataset.way));
  }

  // Shows whether the camera of the newest marks is still being solved; until then the previous one is shown.
  busy(solving) {
    document.querySelector("main").classList.toggle("solving", solving);
    const words = solving ? "Solving the camera…" : "";
    if (byId("solving").textContent !== words) byId("solving").textContent = words;
  }

  show(look) {
    const { message, camera, warnings } = look;
    this.look = look;
    byId("steps").hidden = Boolean(camera) || MARKED.some((kind) => this.does.document()[kind].length);
    byId("message").textContent = message;
    byId("message").hidden = !message || !byId("steps").hidden; // the steps show it too
    for (const button of byId("mend").children) button.hidden = button.dataset.mend !== look.mend;
    byId("warnings").replaceChildren(...warnings.map((words) => text("li", words)));
    byId("figures-details").hidden = !camera;
    if (camera) figures(byId("figures"), byId("figures-summary"), camera);
    this.showMoved();
  }

  // Reports that the camera was calibrated again after gates, zones and lanes were drawn.
  showMoved() {
    const { entries, most } = this.drawings.compare(this.does.document(), this.look);
    this.moved = entries;
    byId("moved").hidden = !entries.length;
    const names = entries.map(({ kind, index }) => this.does.document()[kind][index].name);
    const which = names.length > 3 ? `${names.slice(0, 2).join(", ")} and ${names.length - 2} more` : names.join(", ");
    byId("moved-words").textContent = `The camera was calibrated again: ${which} moved by up to ${Math.round(most)} px in the image.`;
  }

  // Moves shifted drawings back to their pixels, with the present camera.
  async keepInImage() {
    const entries = this.moved;
    const places = await this.does.placesOf(entries.flatMap(({ corners }) => corners.filter(Boolean)));
    if (!places.length) return;
    this.does.change((all) => {
      for (const { kind, index, corners } of entries) {
        corners.forEach((corner, part) => corner && setPosition(kind, all[kind][index], part, places.shift()));
      }
    });
  }

  keepMetres() {
    this.drawings.agree();
    this.showMoved();
  }

  // Corrects positions that share one error: swapped or rotated axes, degrees instead of metres.
  async mend(way) {
    const { points } = this.does.document();
    const whole = points.flatMap(({ place }, i) => (place.slice(0, 2).every((one) => typeof one === "number") ? [i] : []));
    const pairs = whole.map((i) => points[i].place.slice(0, 2));
    let found = { places: pairs.map(([x, y]) => (way === "swap" ? [y, x] : [x, -y])) };
    if (way === "latitude" || way === "longitude") {
      try {
        found = await post("/map-places", { pairs, order: way, world: null });
      } catch (error) {
        return this.does.trouble(error.message);
      }
    }
    this.does.change((all) => {
      whole.forEach((index, i) => all.points[index].place.splice(0, 2, ...found.places[i]));
      if (found.world) all.world = found.world;
    });
  }
}
