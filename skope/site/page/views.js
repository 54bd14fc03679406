// Contents of the stage: a frame of the footage, the road from above, or the plan with its scale.

import { byId, get } from "./dom.js";
import { post } from "./server.js";

const EMPTY = [800, 600]; // size of the stage without a picture, pixels

export class Views {
  // `now` is the page's state; `does` has `document`, `change`, `trouble`, `shown` (another view), `placed` (the plan
  // has its scale).
  constructor(begun, viewport, now, does) {
    Object.assign(this, { begun, viewport, now, does, name: "image", frame: 0, above: null });
    this.image = { picture: null, size: begun.size };
    this.plan = new PlanView((scaled) => this.scaled(scaled), () => this.name === "plan" && this.show("plan"));
    byId("frame").max = Math.max(begun.frames, 1);
    byId("frame").addEventListener("change", () => this.turnTo(Number(byId("frame").value) - 1));
    byId("plan-again").addEventListener("click", () => this.scaleAgain());
    byId("plan-away").addEventListener("click", () => this.forgetPlan());
    for (const button of byId("views").children) button.addEventListener("click", () => this.show(button.dataset.view));
  }

  // The current view: picture, size, and `toWorld` and `fromWorld` if it is metric; null without a view.
  get current() {
    if (this.name === "plan") return this.plan.view(this.does.document().plan);
    return this.name === "above" ? this.above : this.image;
  }

  // Whether positions can be clicked on the plan.
  get planReady() {
    const { plan } = this.does.document();
    return Boolean(plan && this.plan.view(plan));
  }

  // Whether clicks set the scale of the plan.
  get scaling() {
    return this.name === "plan" && !this.current?.fromWorld;
  }

  async show(name) {
    try {
      if (name === "above") this.above = await this.fromAbove();
      if (name === "plan") await this.plan.want(this.does.document().plan);
    } catch (error) {
      return this.does.trouble(error.message);
    }
    const keep = name === this.name;
    if (!keep) this.now.pending = [];
    if (name !== "plan") this.plan.ends = [];
    this.name = name;
    this.now.cursor = null;
    byId("where").textContent = "";
    for (const button of byId("views").children) button.setAttribute("aria-pressed", button.dataset.view === name);
    byId("frames").hidden = name === "plan" || this.begun.frames < 2;
    const { picture, size } = this.current || { picture: null, size: EMPTY };
    this.viewport.show(picture, size, keep);
    this.does.shown();
  }

  async fromAbove() {
    const { low, high, cell_m, size, image } = await post("/above", { document: this.does.document(), frame: this.frame });
    const picture = new Image();
    picture.src = image;
    await picture.decode();
    return {
      picture,
      size,
      toWorld: ([x, y]) => [low[0] + x * cell_m, high[1] - y * cell_m],
      fromWorld: ([x, y]) => [(x - low[0]) / cell_m, (high[1] - y) / cell_m],
    };
  }

  async turnTo(number) {
    this.frame = number;
    byId("frame").value = number + 1;
    byId("frame-number").textContent = `${number + 1} of ${this.begun.frames}`;
    try {
      const bitmap = await createImageBitmap(await (await get("/frames/" + number)).blob());
      if (this.frame !== number) return;
      this.image.picture = bitmap;
      if (this.name === "image") this.viewport.show(bitmap, this.image.size, true);
      else if (this.name === "above") await this.show("above");
    } catch (error) {
      this.does.trouble(error.message);
    }
  }

  async loadPlan(file) {
    try {
      await this.plan.load(file);
    } catch (error) {
      return this.does.trouble(`${file.name}: ${error.status ? error.message : "not an image that a browser shows"}`);
    }
    this.now.picking = null;
    const known = this.does.document().plan;
    // A restored picture keeps its scale; a new picture must be scaled again.
    this.setPlan(known && !known.picture ? { ...known, picture: this.plan.loaded } : null);
    await this.show("plan");
  }

  setPlan(plan) {
    this.does.change((all) => { all.plan = plan; });
  }

  async scaled(plan) {
    this.setPlan(plan);
    this.now.pending = [];
    await this.does.placed();
  }

  scaleAgain() {
    this.plan.loaded = this.does.document().plan.picture;
    this.setPlan(null);
    this.show("plan");
  }

  forgetPlan() {
    this.plan.loaded = null;
    this.setPlan(null);
    this.show("image");
  }
}

// ----------------------------------------------------------------------------------------------------------- plan view

// The view of a map, plan or aerial picture: picture, scale, and position of the world on it.

// Transformation of a plan: `toWorld` and `fromWorld` of positions on it.
function placed({ metres_per_pixel: size, origin: [x0, y0], rotation_deg: turn = 0 }) {
  const [c, s] = [Math.cos((turn * Math.PI) / 180), Math.sin((turn * Math.PI) / 180)];
  return {
    toWorld: ([u, v]) => [x0 + size * (u * c + v * s), y0 + size * (u * s - v * c)],
    fromWorld: ([x, y]) => [((x - x0) * c + (y - y0) * s) / size, ((x - x0) * s - (y - y0) * c) / size],
  };
}

class PlanView {
  // `changed` receives the document's new plan; `came` is called when another picture has loaded.
  constructor(changed, came) {
    Object.assign(this, { changed, came, pictures: new Map(), loaded: null, ends: [] });
    byId("scale-form").addEventListener("submit", (event) => this.use(event));
    byId("scale-again").addEventListener("click", () => byId("scale").close());
    byId("scale").addEventListener("close", () => {
      this.ends = [];
      this.came();
    });
  }

  // The view; null without a picture.
  view(plan) {
    const name = plan ? plan.picture : this.loaded;
    const picture = this.pictures.get(name);
    if (!picture) return null;
    const size = [picture.width, picture.height];
    return plan ? { picture, size, ...placed(plan) } : { picture, size };
  }

  // Requests the picture of a document's plan if it is missing.
  async want(plan) {
    if (!plan || !plan.picture || this.pictures.has(plan.picture)) return;
    this.pictures.set(plan.picture, null);
    const answer = await get("/plans/" + plan.picture);
    this.pictures.set(plan.picture, await createImageBitmap(await answer.blob()));
    this.came();
  }

  // Takes the user's picture; throws an Error with a message if the browser cannot show it.
  async load(file) {
    const { picture: name } = await post("/plan-picture", { data: await base64(file) });
    this.pictures.set(name, await createImageBitmap(file));
    [this.loaded, this.ends] = [name, []];
  }

  // One of the two points that define the plan's scale.
  click(position) {
    this.ends = [...this.ends, position];
    if (this.ends.length === 2) byId("scale").showModal();
  }

  async use(event) {
    event.preventDefault();
    byId("scale-wrong").textContent = "";
    const number = (id) => byId(id).value.trim().replace(",", ".");
    const [at, second] = [["scale-x", "scale-y"], ["scale-x2", "scale-y2"]].map((ids) => ids.map(number));
    try {
      const found = await post("/plan", { ends: this.ends, metres: number("scale-metres"), at, second });
      byId("scale").close();
      this.changed({ picture: this.loaded, ...found });
    } catch (error) {
      byId("scale-wrong").textContent = error.message;
    }
  }
}

function base64(file) {
  return new Promise((resolve, reject) => {
    const reader = new FileReader();
    reader.addEventListener("load", () => resolve(reader.result.slice(reader.result.indexOf(",") + 1)));
    reader.addEventListener("error", () => reject(new Error(`${file.name}: cannot be read`)));
    reader.readAsDataURL(file);
  });
}
