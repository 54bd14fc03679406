// What can be marked and drawn: words, keys, positions, and the fields in which everything can be typed.

// Which positions an entry has are pairs of numbers; kinds of the world have them in metres, the others in pixels.
export const KINDS = {
  points: { word: "Point", key: "p", count: 1, hint: "Click a point whose place you know: the corner of a marking, a kerb, a manhole." },
  lengths: { word: "Length", key: "l", count: 2, hint: "Click both ends of something on the road whose length you know." },
  parallels: { word: "Parallel lines", key: "r", count: 2, hint: "Click both ends of a line on the road, then of another one that is parallel to it." },
  verticals: { word: "Vertical", key: "v", count: 2, hint: "Click the foot, then the top of something upright: a post, the corner of a house." },
  gates: { word: "Gate", key: "g", count: 2, world: true, hint: "Click both ends of a line across the road: vehicles that cross it are counted. No calibration is needed." },
  zones: { word: "Zone", key: "z", count: 3, open: true, world: true, hint: "Click the corners of an area of the road; Enter or Finish closes it." },
  lanes: { word: "Lane", key: "n", count: 2, open: true, world: true, hint: "Click along the middle of a lane in its driving direction; Enter or Finish ends it." },
  occluders: { word: "Occluder", key: "o", count: 3, open: true, hint: "Click around what hides traffic: a tree, a sign; Enter or Finish closes it." },
};
export const MARKED = ["points", "lengths", "parallels", "verticals"];
export const DRAWN = ["gates", "zones", "lanes", "occluders"];

const round = (value, digits) => Number(value.toFixed(digits));
export const pixel = ([x, y]) => [round(x, 1), round(y, 1)];
export const metres = ([x, y]) => [round(x, 3), round(y, 3)];

// The positions of an entry, in the order of its handles; null where one is not known.
export function positionsOf(kind, entry) {
  if (kind === "points") return [entry.pixel];
  if (kind === "parallels") return entry.lines.flat();
  if (kind === "lengths" || kind === "verticals") return entry.pixels;
  if (kind === "occluders") return [...entry.polygon, entry.foot];
  return entry.pixels || entry.line || entry.polygon;
}

// Whether an entry is a gate that has its ends in the image. Its line on the road follows from the camera.
export const inImage = (kind, entry) => kind === "gates" && Boolean(entry.pixels);

// Whether the pixels of a gate are those of an image of this size; the server has scaled them where it can.
export const ofSize = ({ size }, [width, height]) => Boolean(size) && size[0] === width && size[1] === height;

export function setPosition(kind, entry, part, position) {
  if (kind === "points") entry.pixel = position;
  else if (kind === "parallels") entry.lines[Math.floor(part / 2)][part % 2] = position;
  else if (kind === "lengths" || kind === "verticals") entry.pixels[part] = position;
  else if (kind === "occluders" && part === entry.polygon.length) entry.foot = position;
  else if (inImage(kind, entry)) {
    entry.pixels[part] = position;
    delete entry.line; // of where it was before
  }
  else (entry.line || entry.polygon)[part] = position;
}

// Moves a gate on the road: its ends are metres from now on. `places` are where its ends are now.
export function setOnRoad(entry, places, part, position) {
  entry.line = structuredClone(places);
  entry.line[part] = position;
  delete entry.pixels;
  delete entry.size;
}

// A new entry of positions that were clicked, with a name that no other one has. `size` is that of the image, where a gate
// was drawn in it.
export function made(kind, positions, entries, size = null) {
  if (kind === "points") return { name: freeName("", entries), pixel: positions[0], place: [null, null, 0] };
  if (kind === "lengths") return { name: freeName("length ", entries), pixels: positions, metres: null };
  if (kind === "parallels") return { name: freeName("lines ", entries), lines: [positions] };
  if (kind === "verticals") return { name: freeName("vertical ", entries), pixels: positions, metres: null };
  if (kind === "gates") return { name: freeName("gate ", entries), ...(size ? { pixels: positions, size } : { line: positions }), directions: ["", ""] };
  if (kind === "zones") return { name: freeName("zone ", entries), polygon: positions };
  if (kind === "lanes") return { name: freeName("lane ", entries), line: positions, width: 3.5 };
  const lowest = positions.reduce((a, b) => (b[1] > a[1] ? b : a));
  return { polygon: positions, foot: [...lowest] };
}

function freeName(begin, entries) {
  const taken = new Set(entries.map(({ name }) => name));
  let number = entries.length + 1;
  while (taken.has(begin + number)) number++;
  return begin + number;
}

// The fields of an entry: the way to the value in the document, the name under which the server finds fault with it, words.
export function fieldsOf(kind, entry) {
  const at = (way, name, words, unit = "") =>
    [0, 1].map((axis) => ({ way: [...way, axis], name, words: `${words} ${"xy"[axis]}${unit}`, half: Boolean(unit) }));
  const name = { way: ["name"], name: "name", words: "Name", text: true, wide: true };
  const corners = (list, words) => entry[list].flatMap((_, i) => at([list, i], list, `${words} ${i + 1},`, ", metres"));
  const corner = (list, words) => entry[list].flatMap((_, i) => at([list, i], list, `${words[i] || `corner ${i + 1}`},`, ", pixels"));
  if (kind === "points") {
    const place = ["x", "y", "z"].map((axis, i) => ({ way: ["place", i], name: "place." + axis, words: `${axis}, metres` }));
    return [...place, name, ...at(["pixel"], "pixel", "pixel"), { way: ["sigma_m"], name: "sigma_m", words: "exact to, m", usual: "0.1" }];
  }
  if (kind === "lengths") return [name, { way: ["metres"], name: "metres", words: "length, metres", two: true }, { way: ["sigma_m"], name: "sigma_m", words: "exact to, m", usual: "0.05" }, ...corner("pixels", ["one end", "other end"])];
  if (kind === "verticals") return [name, { way: ["metres"], name: "metres", words: "height, metres (if known)", wide: true }, ...corner("pixels", ["foot", "top"])];
  if (kind === "parallels") return [name, ...entry.lines.flatMap((line, i) => line.flatMap((_, j) => at(["lines", i, j], "lines", `line ${i + 1}, end ${j + 1},`, ", px")))];
  if (kind === "gates") {
    const ways = ["1, along arrow 1", "2, along arrow 2"];
    const directions = ways.map((words, i) => ({ way: ["directions", i], name: "directions." + i, words: "Direction " + words, text: true, wide: true }));
    return [name, ...directions, ...(inImage(kind, entry) ? corner("pixels", ["end 1", "end 2"]) : corners("line", "end"))];
  }
  if (kind === "zones") return [name, ...corners("polygon", "corner")];
  if (kind === "lanes") return [name, { way: ["width"], name: "width", words: "width, metres", usual: "3.5", wide: true }, ...corners("line", "point")];
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

// What was typed as a number, nothing as null, and anything else as the text that it is: the server says what is wrong.
export function typed(text) {
  const plain = text.trim().replace(/^([-+]?[0-9]*),([0-9]+)$/, "$1.$2");
  if (plain === "") return null;
  const value = Number(plain);
  return Number.isFinite(value) ? value : text.slice(0, 100);
}
