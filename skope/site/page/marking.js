// What clicks on the picture do: begin, go on with and end what the chosen tool marks or draws.

import { KINDS, inImage, made, metres, pixel, setOnRoad, setPosition } from "./kinds.js";

const byId = (id) => document.getElementById(id);

export class Marking {
  // `now` is what the page is at; `views` what the stage shows; `does` has `document`, `change`, `refresh`, `trouble`,
  // `placesOf`, `onRoad` (the ends of a gate in metres), `choose` and `placeOnPlan`.
  constructor(now, views, does) {
    Object.assign(this, { now, views, does });
  }

  // Drops what is half drawn.
  drop() {
    Object.assign(this.now, { pending: [], hover: null, group: null, picking: null });
  }

  setTool(name) {
    this.drop();
    this.now.tool = name;
    this.does.trouble("");
    this.does.refresh();
  }

  // Takes a tool, and shows the image where it can be used there alone.
  chooseTool(name) {
    this.setTool(name);
    if (KINDS[name] && !KINDS[name].world && this.views.name !== "image") this.views.show("image");
  }

  within([x, y]) {
    const view = this.views.current;
    return Boolean(view) && x >= 0 && y >= 0 && x <= view.size[0] && y <= view.size[1];
  }

  // A position of the view was clicked, touched, or confirmed by Enter.
  async mark(position) {
    const { now, views, does } = this;
    if (!this.within(position)) return;
    if (views.scaling) {
      if (views.current) views.plan.click(position);
      now.pending = views.plan.ends;
      return does.refresh();
    }
    if (now.picking !== null) return this.place(position);
    if (now.tool === "select") return does.choose(null);
    const { count, open, world } = KINDS[now.tool];
    if (!world && views.name !== "image") return does.trouble("Mark that in the image.");
    now.pending = [...now.pending, position];
    if (!open && now.pending.length === count) await this.finish();
    else does.refresh();
  }

  async finish() {
    const { now, views, does } = this;
    const kind = now.tool;
    const { count, world } = KINDS[kind];
    const drawn = now.pending;
    if (drawn.length < count) return does.trouble(`A ${KINDS[kind].word.toLowerCase()} needs ${count} positions or more.`);
    Object.assign(now, { pending: [], hover: null });
    const { fromWorld, toWorld } = views.current;
    const image = !fromWorld && (!world || kind === "gates");
    let positions = image ? drawn.map(pixel) : [];
    if (!image) positions = fromWorld ? drawn.map((position) => metres(toWorld(position))) : await does.placesOf(drawn);
    if (!positions.length) return does.refresh();
    if (kind === "parallels" && now.group !== null && does.document().parallels[now.group]) {
      now.selected = { kind, index: now.group, part: 0 };
      return does.change((all) => all.parallels[now.group].lines.push(positions));
    }
    now.selected = { kind, index: does.document()[kind].length, part: 0 };
    if (kind === "parallels") now.group = now.selected.index;
    does.change((all) => all[kind].push(made(kind, positions, all[kind], image ? [...views.image.size] : null)));
    if (kind === "points" && views.planReady) does.placeOnPlan(now.selected.index);
    else if (!now.byTouch) typeNext(kind, now.selected.index);
  }

  // The second press of two ends what is drawn; it is no further position.
  ended() {
    if (!this.now.pending.length || !KINDS[this.now.tool].open) return;
    this.now.pending = this.now.pending.slice(0, -1);
    this.finish();
  }

  // The place of a point was clicked on the plan.
  place(position) {
    const index = this.now.picking;
    this.now.picking = null;
    this.does.change((all) => {
      if (all.points[index]) all.points[index].place.splice(0, 2, ...metres(this.views.current.toWorld(position)));
    });
    this.views.show("image");
  }

  // Puts a handle of an entry at a position of the view.
  async put({ kind, index, part }, position, of) {
    const { views, does } = this;
    const entry = does.document()[kind][index];
    if (!entry) return;
    if (views.current.fromWorld) {
      const place = metres(views.current.toWorld(position));
      if (kind === "points") does.change((all) => all.points[index].place.splice(0, 2, ...place), of);
      else if (inImage(kind, entry)) {
        const places = does.onRoad(index);
        if (places) does.change((all) => setOnRoad(all[kind][index], places, part, place), of);
      }
      else does.change((all) => setPosition(kind, all[kind][index], part, place), of);
    } else if (!KINDS[kind].world || inImage(kind, entry)) does.change((all) => setPosition(kind, all[kind][index], part, pixel(position)), of);
    else {
      const [place] = await does.placesOf([position]);
      if (place) does.change((all) => setPosition(kind, all[kind][index], part, place), of);
      else does.refresh();
    }
  }

  cancel() {
    const { now, views } = this;
    const { picking, pending, group, tool } = now;
    if (picking !== null) views.show("image");
    else if (!pending.length && group === null && tool !== "select") return this.setTool("select");
    else if (!pending.length && group === null) now.selected = null;
    if (!pending.length) now.group = null;
    Object.assign(now, { pending: [], picking: null, hover: null });
    views.plan.ends = [];
    this.does.refresh();
  }

  // The plan has its scale: places that are missing are clicked there, others in the image.
  async placed() {
    const { points } = this.does.document();
    const missing = points.findIndex(({ place: [x, y] }) => x === null || y === null);
    if (missing >= 0) this.does.placeOnPlan(missing);
    else await this.views.show(points.length ? "plan" : "image");
    if ((this.now.tool === "select" || !points.length) && missing < 0) this.setTool("points");
  }

  // Says what lies at a position of the view.
  tell(position, errors) {
    const [x, y] = position;
    const view = this.views.current;
    let words = "";
    if (this.within(position)) {
      words = `column ${x.toFixed(1)}, row ${y.toFixed(1)}`;
      if (view.toWorld) words = "x " + view.toWorld(position)[0].toFixed(2) + " m, y " + view.toWorld(position)[1].toFixed(2) + " m";
      else if (errors) {
        const { cell, columns, values } = errors;
        const error = values[Math.floor(y / cell) * columns + Math.floor(x / cell)];
        words += error === null || error === undefined ? ": no road, or too far away" : `: a place there is known to ${error} m (90%)`;
      }
    }
    byId("where").textContent = words;
  }
}

// What is marked is told at once: its fields are in sight, and that of its place or its length has the focus. A finger
// would get a keyboard over the picture.
function typeNext(kind, index) {
  const way = { points: "place.0", lengths: "metres" }[kind];
  if (way) document.querySelector(`[data-focus="${kind}:${index}:${way}"]`)?.focus({ preventScroll: true });
  const [row, list] = [document.querySelector(`[data-focus="${kind}:${index}"]`)?.closest("li"), document.querySelector("aside")];
  // The list alone is moved, where it is beside the picture: the picture stays where it is.
  if (row) list.scrollTop += Math.max(0, row.getBoundingClientRect().bottom - list.getBoundingClientRect().bottom);
}
