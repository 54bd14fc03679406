// The picture in the stage, the map of errors over it, and a magnifier.

import { Viewport } from "./viewport.js";

const LOUPE = 132;
const LOUPE_SCALE = 3;
const BESIDE = 36; // distance of the magnifier from the finger
export const CLASSES = [0.1, 0.25, 0.5, 1, 2, 5]; // upper ends of the map's classes, metres; the last class has none
// Blue up to a metre, orange above, darker with distance from it: distinguishable with any colour vision.
export const COLORS = ["#08458c", "#3182bd", "#7fb8de", "#cfe3f3", "#fdd9a8", "#fb9a3f", "#c44a00"];

const classOf = (error) => {
  const found = CLASSES.findIndex((end) => error <= end);
  return found < 0 ? CLASSES.length : found;
};

export class SitePicture extends Viewport {
  constructor(stage, canvas, svg, loupe) {
    super(stage, canvas, svg);
    Object.assign(this, { loupe, map: null });
  }

  paintInto(context, scale, x, y) {
    super.paintInto(context, scale, x, y);
    if (!this.map) return;
    context.imageSmoothingEnabled = false;
    context.globalAlpha = 0.5;
    context.drawImage(this.map.canvas, 0, 0, this.map.width, this.map.height);
    context.globalAlpha = 1;
  }

  // The map of errors as a picture with one pixel per cell; null removes it.
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

  // The area under the finger, enlarged, above it or, if there is no room, beside it.
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
