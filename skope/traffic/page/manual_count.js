// User interface for counting manually while the footage plays.

import { byId, element, text } from "./dom.js";
import { checkedState, clockAt, csvOf, gehOf, overlapOf, rowsOf, spoken, unobserved, within } from "./manual_count_numbers.js";

const $ = (id) => byId("manual-" + id);
const root = byId("manual"), video = $("video");
const data = JSON.parse($("data").textContent);
const KEYS = "123456789qwertyuiopasdfghjklzxcvbnm";
const KEPT = "skope-manual-count:" + data.key;
const RATES = [0.5, 0.75, 1, 1.5, 2], JUMP_S = 5, SLACK_S = 0.5, FEW = 20;
const sideName = (k) => `${data.sides[k].gate} (${data.sides[k].direction})`;
const keyOf = (k) => KEYS[k] || "";

// -------------------------------------------------------------------------------- state that survives a reload
let state = { done: [], current: null };
let pending = null; // the first of two keys of a movement
let keeps = true;
let kept = null;
try {
  kept = localStorage.getItem(KEPT);
} catch {
  keeps = false;
}
try {
  state = checkedState(data, JSON.parse(kept));
} catch {
  // The stored value is invalid: start with an empty state.
}
const keep = () => {
  try {
    localStorage.setItem(KEPT, JSON.stringify(state));
  } catch {
    keeps = false;
  }
};
addEventListener("beforeunload", (event) => {
  if (!keeps && (state.current || state.done.length)) event.preventDefault();
});

// -------------------------------------------------------------------------------- the video
const offset = () => Number($("offset").value) || 0;
const now = () => video.currentTime + offset();
const loaded = () => video.videoWidth > 0 && Number.isFinite(video.duration);
const say = (...lines) => {
  $("note").replaceChildren(...lines.filter(Boolean).flatMap((line, i) => (i ? [text("br"), line] : [line])));
};
const UNPLAYABLE =
  "This browser cannot play that file. Browsers play H.264, VP9 and AV1. They do not play MPEG-4 part 2 (mp4v, Xvid, DivX, as written by OpenCV and many recorders), MJPEG and most AVI files. " +
  "Make a playable copy with the same times and choose it: ffmpeg -i VIDEO -c:v libx264 -pix_fmt yuv420p -an copy.mp4";
const compared = (file) => {
  const part = data.recordings[$("recording").value || 0];
  const lasts = part.end_s - offset(), lines = [];
  if (Math.abs(video.duration - lasts) > Math.max(2, 0.01 * lasts))
    lines.push(`The file lasts ${spoken(video.duration)}, the measured footage ${spoken(lasts)}. Check that it is the same footage, and the second at which it starts.`);
  if (part.source && stem(file) !== stem(part.source)) lines.push(`The measured footage is ${part.source}, the file is ${file}.`);
  return lines;
};
let fileName = "";
const stem = (name) => name.replace(/\.[^.]*$/, "");
const opened = (file) => {
  URL.revokeObjectURL(video.src);
  fileName = file.name;
  // An unfinished count keeps the start second of its file.
  const same = data.recordings.findIndex((one) => stem(one.source) === stem(file.name));
  if (same >= 0 && !state.current) chosenRecording(same);
  video.hidden = true;
  video.src = URL.createObjectURL(file);
  show();
  say("reading the file ...");
};
const chosenRecording = (k) => {
  $("recording").value = k;
  $("offset").value = data.recordings[k].begin_s;
};
const failed = () => {
  video.hidden = true;
  say(UNPLAYABLE);
  show();
};
video.addEventListener("error", () => video.getAttribute("src") && failed());
video.addEventListener("loadedmetadata", () => {
  if (!loaded()) return failed();
  video.hidden = false;
  $("seek").max = video.duration;
  const goOn = state.current ? state.current.seen : null;
  if (goOn !== null) video.currentTime = Math.max(0, goOn - offset());
  say(...compared(fileName), goOn === null ? "" : `The count resumes at ${spoken(goOn)}.`);
  drawGates();
  show();
});
$("file").addEventListener("change", (event) => event.target.files.length && opened(event.target.files[0]));
$("recording").addEventListener("change", () => {
  chosenRecording($("recording").value);
  if (loaded()) say(...compared(fileName));
});
$("offset").addEventListener("change", () => {
  if (loaded()) say(...compared(fileName));
  show();
});

const play = () => {
  if (!loaded()) return;
  if (video.paused) video.play().catch(() => {});
  else video.pause();
};
const go = (seconds) => {
  if (!loaded()) return;
  video.currentTime = Math.min(video.duration, Math.max(0, video.currentTime + seconds));
};
const step = (frames) => {
  video.pause();
  go(frames * data.step_s);
};
const rated = (rate) => {
  video.playbackRate = rate;
  for (const one of root.querySelectorAll("[data-rate]")) one.setAttribute("aria-pressed", Number(one.dataset.rate) === rate);
};

// During a count, the user can move past the watched part only by playing or frame by frame, so that nothing is skipped.
const looked = () => {
  if (!state.current || !loaded()) return;
  const at = now();
  if (at > state.current.seen && at <= state.current.seen + Math.max(SLACK_S, 2 * data.step_s) * Math.max(1, video.playbackRate)) {
    state.current.seen = at;
  } else if (at > state.current.seen) {
    video.currentTime = state.current.seen - offset();
    say(`You have watched the footage until ${spoken(state.current.seen)}. A count must not skip any part.`);
  }
};
const ticked = () => {
  looked();
  clocked();
};
for (const kind of ["timeupdate", "seeked"]) video.addEventListener(kind, ticked);
for (const kind of ["play", "pause", "ended"])
  video.addEventListener(kind, () => {
    ticked();
    keep();
    $("play").textContent = video.paused ? "play" : "pause";
  });
const frames = () => {
  ticked();
  if (!video.paused) requestAnimationFrame(frames);
};
video.addEventListener("play", frames);

// -------------------------------------------------------------------------------- gates over the video
const drawGates = () => {
  const svg = $("gates");
  svg.replaceChildren();
  $("picture").style.setProperty("--ratio", video.videoWidth / video.videoHeight || 1.78);
  if (!data.view || !loaded()) return;
  const [width, height] = data.view.size || [video.videoWidth, video.videoHeight];
  // Size of a screen pixel in units of the drawing.
  const unit = width / ($("picture").clientWidth || width);
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.setAttribute("preserveAspectRatio", "none");
  const add = (name, attributes, words = "") => {
    const made = element(name, attributes, words);
    made.style.fontSize = `${15 * unit}px`;
    svg.append(made);
  };
  const middle = ([[x0, y0], [x1, y1]]) => [(x0 + x1) / 2, (y0 + y1) / 2];
  const drawn = data.view.gates.filter((one) => one.arrow);
  for (const one of data.view.gates) {
    add("path", { d: "M" + one.line.map((point) => point.join(" ")).join("L"), class: "manual-line" });
    if (!one.arrow) continue;
    const sides = data.sides.map((side, k) => ({ ...side, k })).filter((side) => side.gate === one.gate);
    const [[x0, y0], [x1, y1]] = one.arrow, [x2, y2] = middle(one.arrow);
    // Place keys beside their gate, closer to it than to any other gate.
    const apart = drawn.filter((other) => other !== one).map((other) => Math.hypot(middle(other.arrow)[0] - x2, middle(other.arrow)[1] - y2));
    const far = Math.min(19 * unit, ...apart.map((distance) => 0.4 * distance)) / (Math.hypot(x1 - x0, y1 - y0) || 1);
    sides.forEach((side, k) => {
      // The key of the first direction is at the head of the arrow.
      const turn = k ? -1 : 1, x = x2 + turn * far * (x1 - x0), y = y2 + turn * far * (y1 - y0);
      add("path", { d: `M${x2} ${y2}L${x} ${y}`, class: "manual-way" });
      add("text", { x, y, "text-anchor": "middle", "dominant-baseline": "middle", class: "manual-key" }, keyOf(side.k) || side.direction);
    });
  }
};

addEventListener("resize", drawGates);

// -------------------------------------------------------------------------------- counting
const wanted = () => ({
  kind: $("kind").value,
  what: root.querySelector("[name=manual-what]:checked").value,
  sides: [...root.querySelectorAll("#manual-sides input:checked:not(:disabled)")].map((one) => Number(one.value)),
});
const begin = () => {
  if (!loaded()) return say("Choose the video file first.");
  const first = data.spans[0][0], last = data.spans[data.spans.length - 1][1];
  const second = Math.max(Math.floor(now() + 1e-6), Math.ceil(first - 1e-6), Math.ceil(offset() - 1e-6)), asked = wanted();
  if (!asked.sides.length) return say("Choose a gate and direction.");
  if (second >= last || unobserved(data.spans, second, second + 1).seconds > 0.5)
    return say(`Nothing was observed at ${spoken(second)}. The footage was measured from ${spoken(first)} to ${spoken(last)}; begin within that time, outside gaps.`);
  video.pause();
  state.current = { begin: second, seen: second, offset: offset(), presses: [], ...asked };
  video.currentTime = Math.max(0, second - offset());
  pending = null;
  keep();
  say("");
  show();
  $("stage").focus();
};
const press = (k) => {
  const current = state.current;
  if (!current || !current.sides.includes(k)) return;
  if (!loaded()) return say("Choose the video file first.");
  looked();
  const t = Math.round(now() * 1000) / 1000;
  if (t < current.begin) return say(`The count begins at ${spoken(current.begin)}.`);
  if (current.what === "crossings") current.presses.push({ t, side: k });
  else if (pending === null) pending = { t, side: k };
  else {
    current.presses.push({ ...pending, to: k });
    pending = null;
  }
  const button = root.querySelector(`#manual-keys [data-side="${k}"]`);
  button.classList.add("manual-hit");
  setTimeout(() => button.classList.remove("manual-hit"), 150);
  keep();
  listed();
};
const undo = () => {
  if (pending !== null) pending = null;
  else state.current.presses.pop();
  keep();
  listed();
};
const finish = () => {
  const current = state.current, end = Math.floor(Math.min(current.seen, data.spans[data.spans.length - 1][1] + SLACK_S) + 1e-6);
  if (end <= current.begin) return say("The count is too short: count for at least one second.");
  const hole = unobserved(data.spans, current.begin, end);
  if (hole.seconds > 1)
    return say(`The footage has a gap of ${hole.seconds.toFixed(1)} s at ${spoken(hole.first)}: frames are missing, or the camera was moved. A count must not include a gap: discard this count, and finish the next one before the gap.`);
  video.pause();
  const { seen, offset: from, ...whole } = current;
  state.done.push({ ...whole, end });
  state.current = null;
  pending = null;
  keep();
  say("");
  show();
  $("done").scrollIntoView({ block: "nearest" });
};
const drop = () => {
  if (state.current.presses.length && !confirm("Discard this count?")) return;
  state.current = null;
  pending = null;
  keep();
  show();
};

// -------------------------------------------------------------------------------- display
const clocked = () => {
  const clock = clockAt(data.clocks, now());
  $("time").textContent = loaded() ? `${spoken(now(), 1)} of the footage${clock ? `, ${clock}` : ""}` : "";
  if (loaded() && document.activeElement !== $("seek")) $("seek").value = video.currentTime;
  if (state.current) $("span").textContent = `counted from ${spoken(state.current.begin)} to ${spoken(Math.floor(state.current.seen))}`;
  else $("begin").textContent = `Begin counting at ${spoken(loaded() ? Math.max(Math.floor(now() + 1e-6), Math.ceil(data.spans[0][0] - 1e-6)) : 0)}`;
};
const pressName = (one) => (one.to === undefined ? sideName(one.side) : `${sideName(one.side)} to ${sideName(one.to)}`);
const listed = () => {
  const current = state.current, list = $("list");
  const ordered = current.presses.map((one, k) => ({ ...one, k })).sort((a, b) => b.t - a.t || b.k - a.k);
  list.replaceChildren(
    ...ordered.map((one) => {
      const item = text("li", `${spoken(one.t, 1)} ${clockAt(data.clocks, one.t)} ${pressName(one)} `);
      const gone = text("button", "delete", { type: "button", "aria-label": `delete ${pressName(one)} at ${spoken(one.t, 1)}` });
      gone.addEventListener("click", () => {
        current.presses.splice(one.k, 1);
        keep();
        listed();
      });
      item.append(gone);
      return item;
    }),
  );
  $("number").textContent = current.presses.length;
  for (const button of root.querySelectorAll("#manual-keys button")) {
    const k = Number(button.dataset.side);
    const own = current.presses.filter((one) => one.side === k || one.to === k).length;
    button.lastChild.textContent = ` ${own}`;
    button.setAttribute("aria-pressed", pending !== null && pending.side === k);
  }
  $("asked").textContent =
    pending === null
      ? `Press the key or button of the gate for each road user (${kindName(current.kind)})${current.what === "crossings" ? " when its centre crosses" : ": first the gate of origin, then at once the gate of destination"}.`
      : `From ${sideName(pending.side)} to ... ? Press the gate of destination, or undo.`;
};
const kindName = (kind) => ({ all: "all road users", motor: "vehicles and motorcycles" })[kind] || kind;
const countTable = (count, number) => {
  const rows = rowsOf(data, count), held = rows.every((one) => one.counted !== null);
  const table = text("table"), head = text("tr"), body = text("tbody");
  const clock = clockAt(data.clocks, count.begin);
  table.append(text("caption", `Count ${number}: ${kindName(count.kind)}, from ${spoken(count.begin)} to ${spoken(count.end)}${clock ? ` (${clock} to ${clockAt(data.clocks, count.end)})` : ""}`));
  for (const title of [count.what === "crossings" ? "gate" : "movement", "manual", "counted", "error", "GEH"]) head.append(text("th", title, { scope: "col" }));
  const cells = ({ what, hand, counted }) => {
    const row = text("tr"), signed = (value) => (value > 0 ? "+" : "") + value, held = counted !== null;
    const off = text("td", held ? signed(counted - hand) + (hand ? " " : "") : "–");
    if (held && hand) off.append(text("small", `(${signed(Math.round((100 * (counted - hand)) / hand))} %)`));
    const geh = held ? gehOf(hand, counted, count.end - count.begin).toFixed(1) : "–";
    row.append(text("th", what, { scope: "row" }), text("td", hand), text("td", held ? counted : "–"), off, text("td", geh));
    return row;
  };
  body.append(...rows.map(cells));
  table.append(text("thead"), body);
  table.tHead.append(head);
  const scroll = text("div", "", { class: "scroll", tabindex: "0", role: "region", "aria-label": `Count ${number}` });
  scroll.append(table);
  const few = rows.filter((one) => one.hand < FEW).length, late = count.presses.length - within(count).length;
  const wrong = rows.reduce((sum, one) => sum + Math.abs(one.counted - one.hand), 0), all = rows.reduce((sum, one) => sum + one.hand, 0);
  const near = rows.filter((one) => held && gehOf(one.hand, one.counted, count.end - count.begin) < 5).length;
  const lines = [
    held ? `Sum of the errors: ${wrong}, in manual counts of ${all}; GEH under 5 in ${near} of ${rows.length}.` : "",
    held ? "" : "There are too many crossings for this page: use --manual-count to compare the counts.",
    few ? `${few} of ${rows.length} manual counts are below ${FEW}: too few to judge the accuracy.` : "",
    late ? `${late} key presses after ${spoken(count.end)} are excluded: a count ends at a whole second.` : "",
    count.what === "movements" ? "Movements are compared only on this page: --manual-count reads crossings of gates." : "",
  ];
  const gone = text("button", "delete this count", { type: "button" });
  gone.addEventListener("click", () => {
    if (!confirm("Delete this count?")) return;
    state.done.splice(number - 1, 1);
    keep();
    show();
  });
  const said = text("p", lines.filter(Boolean).join(" ") + " ");
  said.append(gone);
  return [scroll, said];
};
let address = null;
const results = () => {
  const out = state.done.flatMap((count, k) => countTable(count, k + 1)), twice = overlapOf(data, state.done);
  if (address) URL.revokeObjectURL(address);
  address = null;
  if (twice) out.push(text("p", `Two counts of ${twice.gate} (${twice.direction}) overlap in time: delete one of them before you download the file.`));
  else if (state.done.some((one) => one.what === "crossings")) {
    address = URL.createObjectURL(new Blob([csvOf(data, state.done)], { type: "text/csv" }));
    const link = text("p", "");
    link.append(
      text("a", "Download manual_count.csv", { href: address, download: "manual_count.csv", id: "manual-download", class: "manual-main" }),
      " and pass it to the same command with the same tracks and a new output folder: ",
      text("code", "--manual-count manual_count.csv --out ANOTHER"),
      ". The new report shows the errors of the counts and updated intervals.",
    );
    out.push(link);
  }
  $("done").replaceChildren(...out);
};
const sideButtons = () => {
  $("keys").replaceChildren(
    ...state.current.sides.map((k) => {
      const button = text("button", "", { type: "button", "data-side": k });
      if (keyOf(k)) button.append(text("kbd", keyOf(k)), " ");
      button.append(text("span", sideName(k)), text("output", ""));
      button.addEventListener("click", () => press(k));
      return button;
    }),
  );
};
const show = () => {
  const counting = Boolean(state.current);
  document.body.classList.toggle("manual-is-counting", counting);
  root.classList.toggle("manual-ready", loaded());
  $("offset").disabled = $("recording").disabled = counting;
  if (counting) {
    sideButtons();
    listed();
    if (!loaded()) say("A count is unfinished: choose the video file again to resume it.");
    // Show the controls for choosing the file again.
    root.classList.toggle("manual-lost", !loaded());
  } else {
    root.classList.remove("manual-lost");
    results();
  }
  if (!keeps) $("note").append(text("br"), "This browser does not store data for this page: download the file before you reload the page.");
  clocked();
};
const sidesShown = () => {
  const moves = root.querySelector("[name=manual-what]:checked").value === "movements";
  for (const box of root.querySelectorAll("#manual-sides input")) box.disabled = moves && !data.sides[box.value].moves;
};

// -------------------------------------------------------------------------------- input
const KEYBOARD = { " ": play, ArrowLeft: () => step(-1), ArrowRight: () => step(1), Backspace: undo };
document.addEventListener("keydown", (event) => {
  if (!state.current || event.ctrlKey || event.altKey || event.metaKey || event.target.closest("input, select, textarea")) return;
  const rate = { "-": -1, "+": 1, "=": 1 }[event.key];
  // Accept digits also on keyboard layouts that need Shift for them.
  const pressed = (/^Digit\d$/.test(event.code) ? event.code.slice(5) : event.key).toLowerCase();
  const side = pressed.length === 1 ? KEYS.indexOf(pressed) : -1;
  let done = true;
  if (event.shiftKey && event.key === "ArrowLeft") go(-JUMP_S);
  else if (event.shiftKey && event.key === "ArrowRight") go(JUMP_S);
  else if (KEYBOARD[event.key]) KEYBOARD[event.key]();
  else if (rate) rated(RATES[Math.min(RATES.length - 1, Math.max(0, RATES.indexOf(video.playbackRate) + rate))]);
  else if (side >= 0) event.repeat || press(side);
  else done = false;
  if (done) event.preventDefault();
});
const clicks = { play, back: () => go(-JUMP_S), ahead: () => go(JUMP_S), before: () => step(-1), after: () => step(1), begin, undo, finish, drop };
for (const [id, run] of Object.entries(clicks)) $(id).addEventListener("click", run);
for (const rate of RATES) {
  const button = text("button", `${rate}x`, { type: "button", "data-rate": rate, "aria-pressed": rate === 1 });
  button.addEventListener("click", () => rated(rate));
  $("rates").append(button);
}
for (const one of root.querySelectorAll("[name=manual-what]")) one.addEventListener("change", sidesShown);
$("seek").addEventListener("input", () => {
  if (loaded()) video.currentTime = Number($("seek").value);
});

data.kinds.forEach(([name]) => $("kind").append(text("option", kindName(name), { value: name })));
data.recordings.forEach((one, k) => $("recording").append(text("option", one.source || `recording ${k + 1}`, { value: k })));
$("recording-label").hidden = data.recordings.length < 2;
data.sides.forEach((side, k) => {
  const label = text("label"), box = text("input", "", { type: "checkbox", value: k });
  box.checked = true;
  label.append(box, ` ${sideName(k)}`);
  $("sides").append(label);
});
chosenRecording(0);
if (state.current) $("offset").value = state.current.offset;
root.hidden = false;
show();
