// What the page has around the picture and never changes: the tools' buttons, layers, the legend, the list of keys.

import { DRAWN, KINDS, MARKED } from "./kinds.js";
import { text } from "./panel.js";
import { CLASSES, COLORS } from "./viewport.js";

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
// What keys do, as a list of terms.
export function keyList(list) {
  list.replaceChildren(...KEYS.map(([key, words]) => {
    const pair = document.createElement("div");
    pair.append(text("dt", key), text("dd", words));
    return pair;
  }));
}

// The buttons of all tools; `choose` is told the name of one.
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

// A box to tick for each layer; `switched` is told its name.
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

// What the colours of the map of errors stand for.
export function legend(list) {
  const chips = COLORS.map((color, i) => {
    const words = i < CLASSES.length ? `to ${CLASSES[i]} m` : `over ${CLASSES[CLASSES.length - 1]} m`;
    const chip = text("span", "", { class: "chip" });
    chip.style.backgroundColor = color;
    const item = text("li", "");
    item.append(chip, words);
    return item;
  });
  list.replaceChildren(text("li", "How far off places may be (in 9 of 10 cases)"), ...chips);
}
