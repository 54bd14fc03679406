// Elements, term lists and requests for the scripts of all pages.

const SVG = "http://www.w3.org/2000/svg";

export const byId = (id) => document.getElementById(id);

function filled(made, attributes) {
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

// An HTML element with a text that is never parsed as markup.
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

// Shows text in the page's tooltip, with its corner at a position of the window; moved to stay inside the window.
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

// The server's answer; an Error with its message if it rejects the request.
export async function get(path) {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

// The key of an event, as in key tables: letters are in lower case.
export const keyOf = ({ key }) => (key.length === 1 ? key.toLowerCase() : key);
