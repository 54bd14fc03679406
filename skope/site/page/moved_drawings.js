// Whether gates, zones and lanes have moved in the image because the camera was calibrated again. Gates that have their ends
// in the image stay there.

import { KINDS, DRAWN, inImage } from "./kinds.js";

const MOVED_PX = 3; // less than this nobody sees

const ROAD = DRAWN.filter((kind) => KINDS[kind].world);

export class MovedDrawings {
  constructor() {
    this.before = new Map(); // by kind and name: metres of the corners, and where the camera showed them
  }

  // Compares with how drawings were seen when they were drawn, or last agreed to; new ones are remembered.
  // Returns { entries, most }: which have moved, and by how many pixels at most.
  compare(document, look) {
    const entries = [];
    let most = 0;
    const seen = new Map();
    for (const { kind, index, corners } of look.shapes.filter((one) => ROAD.includes(one.kind))) {
      const entry = document[kind][index];
      if (!entry || inImage(kind, entry)) continue;
      const places = entry.line || entry.polygon;
      const key = kind + " " + entry.name;
      const then = this.before.get(key);
      const same = then && JSON.stringify(then.places) === JSON.stringify(places);
      seen.set(key, same ? then : { places, corners });
      const away = same ? farthest(then.corners, corners) : 0;
      if (away <= MOVED_PX) continue;
      entries.push({ kind, index, corners: then.corners });
      most = Math.max(most, away);
    }
    if (look.camera) this.before = seen; // without a camera nothing is seen anywhere
    return { entries, most };
  }

  // What is seen now is as it should be.
  agree() {
    this.before = new Map();
  }
}

function farthest(before, after) {
  return Math.max(0, ...before.map((one, i) => (one && after[i] ? Math.hypot(one[0] - after[i][0], one[1] - after[i][1]) : 0)));
}
