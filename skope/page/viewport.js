// A picture on a canvas with a drawing over it: zoom and position, changed by fingers, mouse and wheel.

const LARGEST = 40; // maximum number of screen pixels per pixel of the picture
const DRAGGED_PX = 5; // a longer movement is a drag

export class Viewport {
  constructor(stage, canvas, svg) {
    Object.assign(this, { stage, canvas, svg, size: [1, 1], scale: 1, x: 0, y: 0, picture: null, whole: true, squares: 3 });
    this.shown = () => {};
  }

  // Shows another picture, or an empty canvas of a size; `keep` keeps zoom and position.
  show(picture, size, keep) {
    const other = size[0] !== this.size[0] || size[1] !== this.size[1];
    this.picture = picture;
    this.size = size;
    this.stage.style.setProperty("--aspect", size[1] / size[0]);
    if (!keep || other) this.fit();
    else this.paint();
  }

  get least() {
    return Math.min(this.stage.clientWidth / this.size[0], this.stage.clientHeight / this.size[1]);
  }

  fit() {
    this.whole = true;
    this.scale = this.least || 1;
    this.x = (this.size[0] - this.stage.clientWidth / this.scale) / 2;
    this.y = (this.size[1] - this.stage.clientHeight / this.scale) / 2;
    this.paint();
  }

  // Zooms by a factor around a position of the stage, by default its centre.
  zoom(factor, left = this.stage.clientWidth / 2, top = this.stage.clientHeight / 2) {
    const scale = Math.min(Math.max(this.scale * factor, this.least), LARGEST);
    this.x += left / this.scale - left / scale;
    this.y += top / this.scale - top / scale;
    this.scale = scale;
    this.whole = scale <= this.least;
    this.move(0, 0);
  }

  // Adapts to a new size of the stage; a fully visible picture stays fully visible.
  resized() {
    if (this.whole) this.fit();
    else this.move(0, 0);
  }

  // Moves the picture by screen pixels; part of it stays in the stage.
  move(right, down) {
    const [wide, high] = [this.stage.clientWidth / this.scale, this.stage.clientHeight / this.scale];
    const within = (value, shown, whole) => (shown >= whole ? (whole - shown) / 2 : Math.min(Math.max(value, -0.1 * shown), whole - 0.9 * shown));
    this.x = within(this.x - right / this.scale, wide, this.size[0]);
    this.y = within(this.y - down / this.scale, high, this.size[1]);
    this.paint();
  }

  // Position in the picture of a position on the screen.
  at({ clientX, clientY }) {
    const box = this.stage.getBoundingClientRect();
    return [(clientX - box.left) / this.scale + this.x, (clientY - box.top) / this.scale + this.y];
  }

  // Moves a position into the stage if it is outside.
  reveal([x, y]) {
    const [wide, high] = [this.stage.clientWidth / this.scale, this.stage.clientHeight / this.scale];
    if (x >= this.x && x <= this.x + wide && y >= this.y && y <= this.y + high) return;
    this.x = x - wide / 2;
    this.y = y - high / 2;
    this.move(0, 0);
  }

  paint() {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const [wide, high] = [this.stage.clientWidth, this.stage.clientHeight];
    const [w, h] = [Math.round(wide * ratio), Math.round(high * ratio)];
    if (this.canvas.width !== w || this.canvas.height !== h) [this.canvas.width, this.canvas.height] = [w, h];
    const context = this.canvas.getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, w, h);
    this.paintInto(context, ratio * this.scale, this.x, this.y);
    this.svg.setAttribute("viewBox", `${this.x} ${this.y} ${wide / this.scale || 1} ${high / this.scale || 1}`);
    this.shown();
  }

  paintInto(context, scale, x, y) {
    context.setTransform(scale, 0, 0, scale, -x * scale, -y * scale);
    context.imageSmoothingEnabled = scale < this.squares; // from this scale on, pixels are drawn as squares
    if (this.picture) context.drawImage(this.picture, 0, 0, ...this.size);
    else {
      context.fillStyle = "#d8d8d8";
      context.fillRect(0, 0, ...this.size);
    }
  }
}

// Moves and zooms a viewport by dragging, two fingers or the wheel. Pages with further gestures extend it:
// `begin` returns the action of a press; `go` and `end` receive all actions except moving the picture.
export class Gestures {
  constructor(stage, viewport) {
    Object.assign(this, { stage, viewport, pressed: new Map(), action: null });
    const on = (kind, method, options) => stage.addEventListener(kind, (event) => this[method](event), options);
    on("pointerdown", "press");
    on("pointermove", "move");
    on("pointerup", "release");
    on("pointercancel", "drop");
    on("wheel", "turn", { passive: false });
  }

  // Action of a press; all except "move" go to `go`.
  begin() {
    return { does: "move" };
  }

  hover() {}
  go() {}
  end() {}
  interrupted() {}

  press(event) {
    if (event.button > 0) return;
    event.preventDefault();
    this.stage.focus({ preventScroll: true });
    try { this.stage.setPointerCapture(event.pointerId); } catch { /* a pointer that has gone already */ }
    this.pressed.set(event.pointerId, event);
    if (this.pressed.size > 1) {
      this.action = { does: "pinch" };
      this.interrupted();
    } else this.action = { first: event, moved: false, ...this.begin(event) };
  }

  move(event) {
    const before = this.pressed.get(event.pointerId);
    if (!before) return this.hover(event);
    this.pressed.set(event.pointerId, event);
    const { action } = this;
    if (!action) return;
    if (action.does === "pinch") return this.pinch(event, before);
    if (Math.hypot(event.clientX - action.first.clientX, event.clientY - action.first.clientY) > DRAGGED_PX) action.moved = true;
    if (action.does !== "move") return this.go(event, action);
    if (!action.moved) return;
    this.stage.classList.add("moving");
    this.viewport.move(event.clientX - before.clientX, event.clientY - before.clientY);
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

  // Ends a pointer; returns its action, unless it has ended or was a pinch.
  left(event) {
    this.pressed.delete(event.pointerId);
    this.stage.classList.remove("moving");
    const done = this.action;
    if (!this.pressed.size) this.action = null;
    return done && done.does !== "pinch" ? done : null;
  }

  release(event) {
    const done = this.left(event);
    if (done) this.end(event, done);
  }

  drop(event) {
    if (this.left(event)) this.interrupted();
  }

  turn(event) {
    event.preventDefault();
    const box = this.stage.getBoundingClientRect();
    const factor = Math.exp(-Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 100) * 0.002);
    this.viewport.zoom(factor, event.clientX - box.left, event.clientY - box.top);
  }
}
