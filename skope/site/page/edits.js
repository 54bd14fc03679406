// What fields and buttons of the lists do to the document.

import { post } from "./server.js";

const USUAL_SHARE = 0.02; // what is known beforehand is known to so much, where nothing else is typed

// `now` is what the page is at; `does` has `document`, `change` and `refresh`.
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
    // A place as maps on the web give it, in degrees; it is kept in metres.
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

// Puts what a file holds into the document; returns words to the user.
export async function loadFile(file, does) {
  const found = await post("/read", { name: file.name, text: await file.text() });
  const { points, world } = does.document();
  const other = found.points && points.length && JSON.stringify(found.world ?? null) !== JSON.stringify(world);
  if (other) return `${file.name}: its places are counted from another origin than those that are marked: take these away first`;
  does.change((all) => {
    if (found.points) all.points.push(...found.points);
    if (found.world) all.world = found.world;
    if (found.camera) all.camera = found.camera;
    if (found.lens) all.known.lens = found.lens;
  });
  return found.said || "";
}
