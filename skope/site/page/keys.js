// What the keyboard does: a cross-hair over the picture, marks that arrow keys move, a letter for each tool.

import { handlesOf } from "./draw_marks.js";
import { KINDS } from "./kinds.js";

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const FIELDS = "input:not([type=range]):not([type=checkbox]):not([type=file]), select, textarea";
const CROSSHAIR_STEP = 2; // from above, an arrow key moves a mark by so many cells

// Which handle an element is, as { kind, index, part }; null where it is none.
export function handleOf({ dataset }) {
  if (!dataset || !dataset.handle) return null;
  const [kind, index, part] = dataset.handle.split(":");
  return { kind, index: Number(index), part: Number(part) };
}

// `now`, `page` and `does` are as Pointer has them; `does` has `save`, `step`, `cancel`, `remove`, `setTool`, `finish` and
// `help` besides.
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
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
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
    if (key === "s") event.preventDefault(), event.target.blur?.(), setTimeout(does.save); // after what is being typed
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
    // The first press shows the cross-hair, in the middle of what is seen.
    now.cursor = within(now.cursor ? [now.cursor[0] + right * times, now.cursor[1] + down * times] : middle.map(Math.round));
    now.hover = now.pending.length ? now.cursor : null;
    viewport.reveal(now.cursor);
    this.does.tell(now.cursor);
    this.does.draw();
  }
}
