// The lists beside the picture: every entry with its residual or warning, and the fields of the one that is chosen.

import { DRAWN, KINDS, MARKED, fieldsOf, setValue, typed, valueAt } from "./kinds.js";

export function text(name, words, attributes = {}) {
  const made = document.createElement(name);
  made.textContent = words;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

// Fills both lists anew; the field that had the focus, and what is being typed into it, stay.
export function fill(marks, road, page, act) {
  const active = document.activeElement;
  const focused = active && active.dataset && active.dataset.focus;
  const typing = focused && active instanceof HTMLInputElement ? { value: active.value, from: active.selectionStart, to: active.selectionEnd, was: active.dataset.was } : null;
  rows(marks, MARKED, "Nothing is marked yet.", page, act);
  rows(road, DRAWN, page.look && page.look.camera ? "Nothing is drawn yet." : "Gates, zones and lanes can be drawn once the camera is calibrated.", page, act);
  if (!focused) return;
  const again = [...marks.querySelectorAll("[data-focus]"), ...road.querySelectorAll("[data-focus]")].find((one) => one.dataset.focus === focused);
  if (!again) return;
  again.focus({ preventScroll: true });
  if (typing && typing.value !== typing.was) again.value = typing.value;
  if (typing) again.setSelectionRange(typing.from, typing.to);
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
  if (chosen) item.append(form(kind, index, entry, page, act));
  return item;
}

// Where the other points alone would put this one, beside what they were said to be good for: the honest test of a map.
function byOthers([error, stated]) {
  const words = `the other points put it ${short(error)} off; stated: within ${short(stated)} (90%)`;
  return text("p", words, { class: error > stated ? "others bad" : "others" });
}

const short = (m) => `${m < 10 ? m.toFixed(2) : m.toFixed(0)} m`;

// The name, with the word for what it is unless that begins it already.
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
  const problems = [...page.problemsOf(kind, index)];
  for (const field of fieldsOf(kind, entry)) {
    const label = text("label", field.words, { class: field.wide ? "wide" : field.two ? "two" : "" });
    const value = valueAt(entry, field.way);
    const input = text("input", "", { "data-focus": `${kind}:${index}:${field.way.join(".")}`, "data-name": field.name });
    if (!field.text) input.inputMode = "decimal";
    if (field.usual) input.placeholder = field.usual;
    input.autocomplete = "off";
    input.value = value === null || value === undefined ? "" : String(value);
    input.dataset.was = input.value;
    input.addEventListener("change", () => {
      input.dataset.was = input.value;
      // The list is made anew by a change: only after Tab has led on, so that it finds where to.
      setTimeout(() => act.edit(kind, index, (one) => setValue(one, field.way, field.text ? input.value : typed(input.value))));
    });
    label.append(input);
    made.append(label);
    for (const problem of problems.filter((one) => one.field === field.name && !one.said)) {
      problem.said = true;
      if (problem.missing && input.value === "") {
        input.placeholder = "?";
        input.dataset.missing = "";
        input.title = problem.text;
        continue;
      }
      if (!problem.missing) input.setAttribute("aria-invalid", "true");
      const id = `wrong-${kind}-${index}-${field.way.join("-")}`;
      input.setAttribute("aria-describedby", id);
      made.append(text("p", problem.text, { class: "wrong", id }));
    }
  }
  for (const problem of problems.filter((one) => !one.said)) made.append(text("p", problem.text, { class: "wrong" }));
  for (const problem of problems) delete problem.said;
  const buttons = text("p", "", { class: "row wide" });
  if (kind === "points" && page.planReady) buttons.append(button("Click its place on the plan", () => act.placeOnPlan(index)));
  if (kind === "parallels") buttons.append(button("Add a line", () => act.addLine(index)));
  if (kind === "gates") buttons.append(button("Swap its sides", () => act.edit(kind, index, (one) => one.line.reverse())));
  if (kind === "lanes") buttons.append(button("Turn round", () => act.edit(kind, index, (one) => one.line.reverse())));
  buttons.append(button("Delete", () => act.remove(kind, index)));
  made.append(buttons);
  return made;
}

// What is known of the camera before anything is marked: a value, and how exactly it is known.
export function known(box, page, act) {
  const active = document.activeElement;
  if (box.contains(active)) return; // somebody is typing there
  const out = [];
  for (const [name, words] of [["fov_deg", "field of view, degrees"], ["height_m", "height over the road, m"]]) {
    const pair = page.document.known[name] || [null, null];
    pair.forEach((value, i) => {
      const label = text("label", i ? "± (standard deviation)" : words, { class: i ? "" : "two" });
      const input = text("input", "", { inputmode: "decimal", autocomplete: "off", "data-known": name });
      input.value = value === null ? "" : String(value);
      input.addEventListener("change", () => act.know(name, i, typed(input.value)));
      label.append(input);
      out.push(label);
    });
    const problem = page.problemsOf("known", 0).find(({ field }) => field === name);
    if (problem) out.push(text("p", problem.text, { class: "wrong" }));
  }
  box.replaceChildren(...out);
}

function button(words, does) {
  const made = text("button", words, { type: "button", "data-focus": words });
  made.addEventListener("click", does);
  return made;
}

export function figures(list, summary, camera) {
  const rows = camera.figures.map(({ name, value, sigma, unit }) => {
    const pair = document.createElement("div");
    const digits = unit === "px" ? 0 : 2;
    pair.append(text("dt", name), text("dd", `${value.toFixed(digits)}${sigma === null ? "" : " ± " + sigma.toFixed(digits)} ${unit}`));
    return pair;
  });
  list.replaceChildren(...rows);
  const [focal, height, tilt] = camera.figures;
  summary.textContent = `${height.value.toFixed(1)} m high, ${tilt.value.toFixed(1)}° down, focal length ${focal.value.toFixed(0)} px`;
}
