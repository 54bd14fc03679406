// Input by mouse, pen, fingers and keys: marking, dragging handles, moving, zooming, and a cross-hair for the keyboard.

import { keyOf } from "./dom.js";
import { handlesOf } from "./draw.js";
import { DRAWN, KINDS, MARKED } from "./marks.js";
import { Gestures } from "./viewport.js";

const NEAR_PX = { mouse: 9, pen: 14, touch: 24 }; // distance within which a press takes a handle

// `now` is the page's state, `page` returns what is drawn; `does` has `mark`, `put`, `choose`, `ended` (second press of
// two), `tell`, `draw`, and `grabs` (whether handles can be dragged now).
export class Pointer extends Gestures {
  constructor(stage, viewport, now, page, does) {
    super(stage, viewport);
    Object.assign(this, { now, page, does });
    stage.addEventListener("dblclick", () => does.ended());
  }

  begin(event) {
    const touch = event.pointerType === "touch";
    this.now.cursor = null;
    this.now.byTouch = touch;
    const free = this.does.grabs();
    // On a phone, a finger is as wide as the distance between marks: marking does not drag handles.
    const marks = touch && this.now.tool !== "select";
    const grabbed = free && !marks ? this.nearest(event) : null;
    const does = grabbed ? "drag" : marks || (touch && !free) ? "aim" : "move";
    if (touch && does !== "move") this.viewport.magnify(event);
    if (grabbed) this.does.choose(grabbed);
    return { does, grabbed };
  }

  // Two fingers, or a pointer that the browser cancels.
  interrupted() {
    this.viewport.unmagnify();
    this.now.dragged = null;
    this.now.cursor = null;
    this.does.draw();
  }

  // The handle nearest to a press, with its distance.
  nearest(event) {
    const [x, y] = this.viewport.at(event);
    let best = (NEAR_PX[event.pointerType] || NEAR_PX.mouse) / this.viewport.scale;
    let found = null;
    const page = this.page();
    // During drawing, only handles of the same kind react: a lane may begin at a marked point.
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
    this.does.tell(this.viewport.at(event));
    super.move(event);
  }

  hover(event) {
    this.now.hover = this.now.pending.length && event.pointerType === "mouse" ? this.viewport.at(event) : null;
    if (this.now.pending.length) this.does.draw();
  }

  go(event, { does, grabbed, moved }) {
    const touch = event.pointerType === "touch";
    if (touch) this.viewport.magnify(event);
    if (!moved || does !== "drag") return;
    const at = this.viewport.at(event);
    const [dx, dy] = touch ? [0, 0] : grabbed.offset;
    this.now.dragged = { ...grabbed, position: [at[0] + dx, at[1] + dy] };
    this.does.draw();
  }

  left(event) {
    this.viewport.unmagnify();
    return super.left(event);
  }

  end(event, { does, grabbed, moved }) {
    const { dragged } = this.now;
    this.now.dragged = null;
    if (does === "drag") {
      if (dragged) this.does.put(dragged, dragged.position);
      else this.does.choose(grabbed);
    } else if (does === "aim" || !moved) this.does.mark(this.viewport.at(event));
  }
}

// ---------------------------------------------------------------------------------------------------------------- keys

// Input by keyboard: a cross-hair over the picture, arrow keys that move marks, a letter for each tool.

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const FIELDS = "input:not([type=range]):not([type=checkbox]):not([type=file]), select, textarea";
const CROSSHAIR_STEP = 2; // cells per press of an arrow key in the view from above

// The handle of an element as { kind, index, part }; null if it is none.
export function handleOf({ dataset }) {
  if (!dataset || !dataset.handle) return null;
  const [kind, index, part] = dataset.handle.split(":");
  return { kind, index: Number(index), part: Number(part) };
}

// `now`, `page` and `does` as in Pointer; `does` also has `save`, `step`, `cancel`, `remove`, `setTool`, `finish` and
// `help`.
export class Keys {
  constructor(stage, viewport, now, page, does) {
    Object.assign(this, { stage, viewport, now, page, does });
    document.addEventListener("keydown", (event) => this.down(event));
    stage.addEventListener("blur", () => {
      if (!now.cursor) return;
      now.cursor = null;
      does.draw();
    });
  }

  down(event) {
    if (document.querySelector("dialog[open]")) return;
    const key = keyOf(event);
    const typing = event.target.closest(FIELDS);
    if (event.ctrlKey || event.metaKey) return this.chord(event, key, typing);
    if (event.altKey) return;
    if (typing) {
      if (key === "Escape") this.stage.focus();
      return;
    }
    const handle = handleOf(event.target);
    const does = this.meaning(key, event, handle);
    if (!does) return;
    event.preventDefault();
    does();
  }

  chord(event, key, typing) {
    const { does } = this;
    if (key === "s") event.preventDefault(), event.target.blur?.(), setTimeout(does.save); // after the pending input
    else if (!typing && key === "z") event.preventDefault(), does.step(event.shiftKey ? "redo" : "undo");
    else if (!typing && key === "y") event.preventDefault(), does.step("redo");
  }

  meaning(key, event, handle) {
    const { does, now, viewport, stage } = this;
    const times = event.shiftKey ? 10 : 1;
    if (ARROWS[key] && handle) return () => this.moveMark(ARROWS[key], times, handle);
    if (ARROWS[key] && event.target === stage) return () => this.moveCursor(ARROWS[key], times);
    if (key === "Enter" && event.target === stage) return () => this.confirm();
    const remove = () => now.selected && does.remove(now.selected.kind, now.selected.index);
    const kind = Object.keys(KINDS).find((name) => KINDS[name].key === key);
    const choose = kind && (() => (does.setTool(kind), stage.focus()));
    return {
      Escape: does.cancel,
      Delete: remove,
      Backspace: remove,
      s: () => does.setTool("select"),
      "+": () => viewport.zoom(1.5),
      "=": () => viewport.zoom(1.5),
      "-": () => viewport.zoom(1 / 1.5),
      0: () => viewport.fit(),
      "?": does.help,
    }[key] || choose;
  }

  confirm() {
    const { cursor, pending, tool } = this.now;
    const last = pending[pending.length - 1];
    const open = KINDS[tool]?.open;
    if (last && open && cursor && last[0] === cursor[0] && last[1] === cursor[1]) return this.does.finish();
    if (cursor) return this.does.mark([...cursor]);
    if (last && open) return this.does.finish();
  }

  moveMark([right, down], times, { kind, index, part }) {
    const page = this.page();
    const at = handlesOf(kind, index, page.document[kind][index], page)[part];
    if (!at) return;
    const far = page.view.fromWorld ? times * CROSSHAIR_STEP : times;
    this.does.put({ kind, index, part }, [at[0] + right * far, at[1] + down * far], `move ${kind}:${index}:${part}`);
  }

  moveCursor([right, down], times) {
    const { now, viewport, stage } = this;
    const { view } = this.page();
    if (!view) return;
    const within = (position) => position.map((value, i) => Math.min(Math.max(value, 0), view.size[i]));
    const middle = [viewport.x + stage.clientWidth / 2 / viewport.scale, viewport.y + stage.clientHeight / 2 / viewport.scale];
    // The first press shows the cross-hair in the middle of the visible part.
    now.cursor = within(now.cursor ? [now.cursor[0] + right * times, now.cursor[1] + down * times] : middle.map(Math.round));
    now.hover = now.pending.length ? now.cursor : null;
    viewport.reveal(now.cursor);
    this.does.tell(now.cursor);
    this.does.draw();
  }
}
