// The view of a map, plan or aerial picture: its pictures, its scale, and where the world is on it.

import { get, post } from "./server.js";

const byId = (id) => document.getElementById(id);

// How a plan of the document lies in the world: `toWorld` and `fromWorld` of positions on it.
export function placed({ metres_per_pixel: size, origin: [x0, y0], rotation_deg: turn = 0 }) {
  const [c, s] = [Math.cos((turn * Math.PI) / 180), Math.sin((turn * Math.PI) / 180)];
  return {
    toWorld: ([u, v]) => [x0 + size * (u * c + v * s), y0 + size * (u * s - v * c)],
    fromWorld: ([x, y]) => [((x - x0) * c + (y - y0) * s) / size, ((x - x0) * s - (y - y0) * c) / size],
  };
}

export class PlanView {
  // `changed` is told what the document's plan is to be from now on, `came` when another picture is there.
  constructor(changed, came) {
    Object.assign(this, { changed, came, pictures: new Map(), loaded: null, ends: [] });
    byId("scale-form").addEventListener("submit", (event) => this.use(event));
    byId("scale-again").addEventListener("click", () => byId("scale").close());
    byId("scale").addEventListener("close", () => {
      this.ends = [];
      this.came();
    });
  }

  // The view, or null where there is no picture.
  view(plan) {
    const name = plan ? plan.picture : this.loaded;
    const picture = this.pictures.get(name);
    if (!picture) return null;
    const size = [picture.width, picture.height];
    return plan ? { picture, size, ...placed(plan) } : { picture, size };
  }

  // Asks for the picture of a document's plan, where it has not come yet.
  async want(plan) {
    if (!plan || !plan.picture || this.pictures.has(plan.picture)) return;
    this.pictures.set(plan.picture, null);
    const answer = await get("/plans/" + plan.picture);
    this.pictures.set(plan.picture, await createImageBitmap(await answer.blob()));
    this.came();
  }

  // Takes a picture of the user's; throws an Error with words where a browser cannot show it.
  async load(file) {
    const { picture: name } = await post("/plan-picture", { data: await base64(file) });
    this.pictures.set(name, await createImageBitmap(file));
    [this.loaded, this.ends] = [name, []];
  }

  // One of the two points by which the plan is scaled.
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
