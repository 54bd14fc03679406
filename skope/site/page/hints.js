// What to do next, in a sentence over the picture.

import { DRAWN, KINDS } from "./kinds.js";

const CAMERA_NEEDED = "Zones and lanes are in metres: calibrate the camera first.";
const CALIBRATED = "Where grid and boxes lie on the road, go on with Gate, Zone and Lane; more points make places more exact.";
const PLAN = {
  gone: "The plan's picture is not there any more: load it again.",
  none: "Load a map, a plan or an aerial picture first.",
  first: "Click the first of two points of the plan whose distance you know.",
  second: "Click the second of two points whose distance you know.",
};
const CHOOSE = "Drag marks to mend them; drag the picture to move it, zoom with the wheel or two fingers.";
const GATE_DRAWN = "Name its directions if you like, draw further gates, or press Save. Arrows 1 and 2 are the two directions.";
const ANOTHER_LINE = "Click both ends of another line that is parallel to it on the road; Esc ends the group.";

// `now` is what the page is at, `views` what is shown, `look` what the server says of `document`.
export function hintFor(document, now, views, look) {
  const { tool, picking, group, pending } = now;
  if (views.scaling && !views.current) return document.plan ? PLAN.gone : PLAN.none;
  if (views.scaling) return views.plan.ends.length ? PLAN.second : PLAN.first;
  const point = picking === null ? undefined : document.points[picking];
  if (point) return `Click the place of point ${point.name || picking + 1} on the plan (Esc: type it instead).`;
  if (tool === "select") return CHOOSE;
  if (KINDS[tool].world && tool !== "gates" && !(look && look.camera) && views.name === "image") return CAMERA_NEEDED;
  if (tool === "parallels" && group !== null && !pending.length) return ANOTHER_LINE;
  if (tool === "gates" && document.gates.length && !pending.length) return GATE_DRAWN;
  if (tool !== "points" || !document.points.length || !look) return KINDS[tool].hint;
  // What is still missing is said where the next click goes; on a phone the list is far below.
  if (look.message) return look.message;
  return look.camera && !DRAWN.some((kind) => document[kind].length) ? CALIBRATED : KINDS.points.hint;
}
