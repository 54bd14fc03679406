// What is said of the camera: figures, warnings, what is missing, what a button can mend, and what moved with it.

import { MARKED, setPosition } from "./kinds.js";
import { MovedDrawings } from "./moved_drawings.js";
import { figures, text } from "./panel.js";
import { post } from "./server.js";

const byId = (id) => document.getElementById(id);

export class CameraPanel {
  // `does` has `document`, `change`, `trouble`, and `placesOf` (pixels on the road).
  constructor(does) {
    Object.assign(this, { does, drawings: new MovedDrawings(), moved: [] });
    byId("keep-image").addEventListener("click", () => this.keepInImage());
    byId("keep-metres").addEventListener("click", () => this.keepMetres());
    for (const button of byId("mend").children) button.addEventListener("click", () => this.mend(button.dataset.way));
  }

  // Says whether the camera of the newest marks is still being solved: what is shown is the one before then.
  busy(solving) {
    document.querySelector("main").classList.toggle("solving", solving);
    const words = solving ? "Solving the camera…" : "";
    if (byId("solving").textContent !== words) byId("solving").textContent = words;
  }

  show(look) {
    const { message, camera, warnings } = look;
    this.look = look;
    byId("steps").hidden = Boolean(camera) || MARKED.some((kind) => this.does.document()[kind].length);
    byId("message").textContent = message;
    byId("message").hidden = !message || !byId("steps").hidden; // the steps say it too
    for (const button of byId("mend").children) button.hidden = button.dataset.mend !== look.mend;
    byId("warnings").replaceChildren(...warnings.map((words) => text("li", words)));
    byId("figures-details").hidden = !camera;
    if (camera) figures(byId("figures"), byId("figures-summary"), camera);
    this.showMoved();
  }

  // Says that the camera has been calibrated again under gates, zones and lanes that were drawn before.
  showMoved() {
    const { entries, most } = this.drawings.compare(this.does.document(), this.look);
    this.moved = entries;
    byId("moved").hidden = !entries.length;
    const names = entries.map(({ kind, index }) => this.does.document()[kind][index].name);
    const which = names.length > 3 ? `${names.slice(0, 2).join(", ")} and ${names.length - 2} more` : names.join(", ");
    byId("moved-words").textContent = `The camera was calibrated again: ${which} moved by up to ${Math.round(most)} px in the image.`;
  }

  // Draws what has moved again where it was in the image, by the camera as it is now.
  async keepInImage() {
    const entries = this.moved;
    const places = await this.does.placesOf(entries.flatMap(({ corners }) => corners.filter(Boolean)));
    if (!places.length) return;
    this.does.change((all) => {
      for (const { kind, index, corners } of entries) {
        corners.forEach((corner, part) => corner && setPosition(kind, all[kind][index], part, places.shift()));
      }
    });
  }

  keepMetres() {
    this.drawings.agree();
    this.showMoved();
  }

  // Mends places that are all wrong in one way: axes that are swapped or turned, degrees in place of metres.
  async mend(way) {
    const { points } = this.does.document();
    const whole = points.flatMap(({ place }, i) => (place.slice(0, 2).every((one) => typeof one === "number") ? [i] : []));
    const pairs = whole.map((i) => points[i].place.slice(0, 2));
    let found = { places: pairs.map(([x, y]) => (way === "swap" ? [y, x] : [x, -y])) };
    if (way === "latitude" || way === "longitude") {
      try {
        found = await post("/map-places", { pairs, order: way, world: null });
      } catch (error) {
        return this.does.trouble(error.message);
      }
    }
    this.does.change((all) => {
      whole.forEach((index, i) => all.points[index].place.splice(0, 2, ...found.places[i]));
      if (found.world) all.world = found.world;
    });
  }
}
