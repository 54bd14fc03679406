// Elements, lists of terms and requests, as the scripts of all pages need them.

const SVG = "http://www.w3.org/2000/svg";

export const byId = (id) => document.getElementById(id);

function filled(made, attributes) {
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

// An HTML element with a text, which is never read as markup.
export const text = (name, words = "", attributes = {}) =>
  filled(Object.assign(document.createElement(name), { textContent: words }), attributes);

// An SVG element.
export function element(name, attributes, ...children) {
  const made = filled(document.createElementNS(SVG, name), attributes);
  made.append(...children);
  return made;
}

// Fills a <dl> with terms and their descriptions.
export function terms(list, rows) {
  list.replaceChildren(...rows.map(([term, words]) => {
    const pair = text("div");
    pair.append(text("dt", term), text("dd", words));
    return pair;
  }));
}

// Shows words in the tip of the page; its corner is at a place of the window, moved as far as it has to be to be inside.
export function showTip(words, left, top) {
  const tip = byId("tip");
  tip.textContent = words;
  tip.hidden = false;
  const inside = (value, most) => Math.max(4, Math.min(value, most - 4)) + "px";
  tip.style.left = inside(left, innerWidth - tip.offsetWidth);
  tip.style.top = inside(top, innerHeight - tip.offsetHeight);
  return tip;
}

export function hideTip() {
  byId("tip").hidden = true;
}

// The answer of the server that gave the page; an Error with its words where it refuses.
export async function get(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

// The key of an event as tables of keys name it: letters in lower case, however they were typed.
export const keyOf = ({ key }) => (key.length === 1 ? key.toLowerCase() : key);
