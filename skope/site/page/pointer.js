// What mouse, pen and fingers do on the picture: mark, drag handles, move and zoom.

import { handlesOf } from "./draw_marks.js";
import { DRAWN, MARKED } from "./kinds.js";

const NEAR_PX = { mouse: 9, pen: 14, touch: 24 }; // so near to a handle it is meant
const DRAGGED_PX = 5; // so far a press has to go to be a drag

// `now` is what the page is at, `page` gives what is drawn; `does` has `mark`, `put`, `choose`, `ended` (a second press of
// two), `tell` and `draw`, and `grabs`, whether handles can be taken at this moment.
export class Pointer {
  constructor(stage, viewport, now, page, does) {
    Object.assign(this, { stage, viewport, now, page, does, pressed: new Map(), action: null });
    const on = (kind, method, options) => stage.addEventListener(kind, (event) => this[method](event), options);
    on("pointerdown", "press");
    on("pointermove", "move");
    on("pointerup", "release");
    on("pointercancel", "drop");
    on("wheel", "turn", { passive: false });
    stage.addEventListener("dblclick", () => does.ended());
  }

  press(event) {
    if (event.button > 0) return;
    event.preventDefault();
    this.stage.focus({ preventScroll: true });
    this.now.cursor = null;
    try { this.stage.setPointerCapture(event.pointerId); } catch { /* a pointer that has gone already */ }
    this.pressed.set(event.pointerId, event);
    if (this.pressed.size > 1) {
      this.viewport.unmagnify();
      this.now.dragged = null;
      this.action = { does: "pinch" };
      return this.does.draw();
    }
    const touch = event.pointerType === "touch";
    this.now.byTouch = touch;
    const free = this.does.grabs();
    // A finger is as wide as marks are apart on a phone: while it marks, it takes no handle along.
    const marks = touch && this.now.tool !== "select";
    const grabbed = free && !marks ? this.nearest(event) : null;
    const does = grabbed ? "drag" : marks || (touch && !free) ? "aim" : "press";
    this.action = { does, grabbed, begin: event, moved: false };
    if (touch && does !== "press") this.viewport.magnify(event);
    if (grabbed) this.does.choose(grabbed);
  }

  // The handle that is meant by a press, with how far beside it that was.
  nearest(event) {
    const [x, y] = this.viewport.at(event);
    let best = (NEAR_PX[event.pointerType] || NEAR_PX.mouse) / this.viewport.scale;
    let found = null;
    const page = this.page();
    // While something is drawn, only handles of its kind are in the way: a lane may begin at a marked point.
    for (const kind of page.tool === "select" ? [...MARKED, ...DRAWN] : [page.tool]) {
      page.document[kind].forEach((entry, index) => {
        handlesOf(kind, index, entry, page).forEach((place, part) => {
          const away = place ? Math.hypot(place[0] - x, place[1] - y) : Infinity;
          if (away < best) [best, found] = [away, { kind, index, part, offset: [place[0] - x, place[1] - y] }];
        });
      });
    }
    return found;
  }

  move(event) {
    const at = this.viewport.at(event);
    this.does.tell(at);
    const before = this.pressed.get(event.pointerId);
    if (!before) {
      this.now.hover = this.now.pending.length && event.pointerType === "mouse" ? at : null;
      if (this.now.pending.length) this.does.draw();
      return;
    }
    this.pressed.set(event.pointerId, event);
    const { action } = this;
    if (!action) return;
    if (action.does === "pinch") return this.pinch(event, before);
    if (Math.hypot(event.clientX - action.begin.clientX, event.clientY - action.begin.clientY) > DRAGGED_PX) action.moved = true;
    const touch = event.pointerType === "touch";
    if (touch && action.does !== "press") this.viewport.magnify(event);
    if (!action.moved) return;
    if (action.does === "drag") {
      const [dx, dy] = touch ? [0, 0] : action.grabbed.offset;
      this.now.dragged = { ...action.grabbed, position: [at[0] + dx, at[1] + dy] };
      this.does.draw();
    } else if (action.does === "press") {
      this.stage.classList.add("moving");
      this.viewport.move(event.clientX - before.clientX, event.clientY - before.clientY);
    }
  }

  pinch(event, before) {
    const other = [...this.pressed.values()].find((one) => one.pointerId !== event.pointerId);
    if (!other) return;
    const box = this.stage.getBoundingClientRect();
    const apart = (one) => Math.max(Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY), 1);
    const middle = [(event.clientX + other.clientX) / 2 - box.left, (event.clientY + other.clientY) / 2 - box.top];
    this.viewport.zoom(apart(event) / apart(before), ...middle);
    this.viewport.move((event.clientX - before.clientX) / 2, (event.clientY - before.clientY) / 2);
  }

  // A pointer has left; returns what it did, unless that is over or was a pinch.
  left(event) {
    this.pressed.delete(event.pointerId);
    this.viewport.unmagnify();
    this.stage.classList.remove("moving");
    const done = this.action;
    if (!this.pressed.size) this.action = null;
    return done && done.does !== "pinch" ? done : null;
  }

  release(event) {
    const done = this.left(event);
    if (!done) return;
    const moved = this.now.dragged;
    this.now.dragged = null;
    if (done.does === "drag") {
      if (moved) this.does.put(moved, moved.position);
      else this.does.choose(done.grabbed);
    } else if (done.does === "aim" || !done.moved) this.does.mark(this.viewport.at(event));
  }

  drop(event) {
    if (!this.left(event)) return;
    this.now.dragged = null;
    this.does.draw();
  }

  turn(event) {
    event.preventDefault();
    const box = this.stage.getBoundingClientRect();
    const factor = Math.exp(-Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 100) * 0.002);
    this.viewport.zoom(factor, event.clientX - box.left, event.clientY - box.top);
  }
}
