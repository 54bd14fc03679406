// The picture in the stage: how far it is zoomed and moved, and its pixels with the map of errors over them.

const LARGEST = 40; // screen pixels a pixel of the picture
const LOUPE = 132;
const LOUPE_SCALE = 3;
const BESIDE = 36; // so far from the finger, which would hide it
export const CLASSES = [0.1, 0.25, 0.5, 1, 2, 5]; // upper ends of the map's classes, metres; the last class has none
// Blue up to a metre, orange beyond, darker the farther from it: told apart with any colour vision.
export const COLORS = ["#08458c", "#3182bd", "#7fb8de", "#cfe3f3", "#fdd9a8", "#fb9a3f", "#c44a00"];

export const classOf = (error) => {
  const found = CLASSES.findIndex((end) => error <= end);
  return found < 0 ? CLASSES.length : found;
};

export class Viewport {
  constructor(stage, canvas, svg, loupe) {
    Object.assign(this, { stage, canvas, svg, loupe, size: [1, 1], scale: 1, x: 0, y: 0, picture: null, map: null });
    this.shown = () => {};
  }

  // Shows another picture, or none on an empty canvas, of a size; `keep` leaves zoom and place as they are.
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
    this.scale = this.least || 1;
    this.x = (this.size[0] - this.stage.clientWidth / this.scale) / 2;
    this.y = (this.size[1] - this.stage.clientHeight / this.scale) / 2;
    this.paint();
  }

  // Larger by a factor, around a place of the stage; its middle unless one is given.
  zoom(factor, left = this.stage.clientWidth / 2, top = this.stage.clientHeight / 2) {
    const scale = Math.min(Math.max(this.scale * factor, this.least), LARGEST);
    this.x += left / this.scale - left / scale;
    this.y += top / this.scale - top / scale;
    this.scale = scale;
    this.move(0, 0);
  }

  // Moves the picture by pixels of the screen, as far as some of it stays in the stage.
  move(right, down) {
    const [wide, high] = [this.stage.clientWidth / this.scale, this.stage.clientHeight / this.scale];
    const within = (value, shown, whole) => (shown >= whole ? (whole - shown) / 2 : Math.min(Math.max(value, -0.1 * shown), whole - 0.9 * shown));
    this.x = within(this.x - right / this.scale, wide, this.size[0]);
    this.y = within(this.y - down / this.scale, high, this.size[1]);
    this.paint();
  }

  // Position in the picture of a place on the screen.
  at({ clientX, clientY }) {
    const box = this.stage.getBoundingClientRect();
    return [(clientX - box.left) / this.scale + this.x, (clientY - box.top) / this.scale + this.y];
  }

  // Brings a position into the stage where it is not.
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
    context.imageSmoothingEnabled = scale < 3;
    if (this.picture) context.drawImage(this.picture, 0, 0, ...this.size);
    else {
      context.fillStyle = "#d8d8d8";
      context.fillRect(0, 0, ...this.size);
    }
    if (this.map) {
      context.imageSmoothingEnabled = false;
      context.globalAlpha = 0.5;
      context.drawImage(this.map.canvas, 0, 0, this.map.width, this.map.height);
      context.globalAlpha = 1;
    }
  }

  // The map of errors as a picture of a pixel for each cell; null takes it away.
  setMap(errors) {
    this.map = null;
    if (errors) {
      const canvas = document.createElement("canvas");
      [canvas.width, canvas.height] = [errors.columns, errors.rows];
      const context = canvas.getContext("2d");
      errors.values.forEach((error, i) => {
        if (error === null) return;
        context.fillStyle = COLORS[classOf(error)];
        context.fillRect(i % errors.columns, Math.floor(i / errors.columns), 1, 1);
      });
      this.map = { canvas, width: errors.columns * errors.cell, height: errors.rows * errors.cell };
    }
    this.paint();
  }

  // What lies under a finger, larger and above it; where there is no room above, beside it.
  magnify(event) {
    const [x, y] = this.at(event);
    const { clientX, clientY } = event;
    const top = clientY - LOUPE - BESIDE;
    const beside = clientX > innerWidth / 2 ? clientX - LOUPE - BESIDE : clientX + BESIDE;
    this.loupe.hidden = false;
    this.loupe.style.left = (top < 0 ? beside : Math.min(Math.max(clientX - LOUPE / 2, 0), innerWidth - LOUPE)) + "px";
    this.loupe.style.top = Math.max(top, 0) + "px";
    const context = this.loupe.getContext("2d");
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, LOUPE, LOUPE);
    const scale = Math.max(this.scale * LOUPE_SCALE, 1.5);
    this.paintInto(context, scale, x - LOUPE / 2 / scale, y - LOUPE / 2 / scale);
    context.setTransform(1, 0, 0, 1, LOUPE / 2, LOUPE / 2);
    for (const [width, color] of [[4, "#000"], [1.5, "#fff"]]) {
      context.lineWidth = width;
      context.strokeStyle = color;
      context.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        context.moveTo(5 * dx, 5 * dy);
        context.lineTo(22 * dx, 22 * dy);
      }
      context.stroke();
    }
  }

  unmagnify() {
    this.loupe.hidden = true;
  }
}
