// Calculations on manual counts, independent of the page.

// Unpack times (seconds) and class letters from text: milliseconds since the previous event, and a letter.
const unpacked = (text) => {
  let now = 0;
  return [...text.matchAll(/(-?\d+)([a-z])/g)].map(([, later, letter]) => ({ s: (now += Number(later)) / 1000, letter }));
};

// Number of automatically counted events in a period and of a group of classes.
const machineCount = (text, letters, begin, end) =>
  unpacked(text).filter((one) => one.s >= begin && one.s < end && letters.includes(one.letter)).length;

// GEH statistic of two counts as hourly volumes.
export const gehOf = (hand, counted, seconds) =>
  hand + counted ? Math.sqrt(((3600 / seconds) * 2 * (counted - hand) ** 2) / (counted + hand)) : 0;

// Unobserved part of a period: duration in seconds, and start of the first gap.
export const unobserved = (spans, begin, end) => {
  let seconds = 0, first = null, at = begin;
  for (const [from, to] of [...spans, [Infinity, Infinity]]) {
    const gap = Math.min(from, end) - at;
    if (gap > 0) {
      seconds += gap;
      if (first === null) first = at;
    }
    at = Math.max(at, Math.min(to, end));
  }
  return { seconds, first };
};

// Seconds as h:mm:ss, with the given number of decimals.
export const spoken = (seconds, digits = 0) => {
  const unit = 10 ** digits, whole = Math.floor(Math.max(0, seconds) * unit + 1e-6), rest = Math.floor(whole / unit);
  const two = (n) => String(n).padStart(2, "0");
  const part = digits ? "." + String(whole % unit).padStart(digits, "0") : "";
  return `${Math.floor(rest / 3600)}:${two(Math.floor(rest / 60) % 60)}:${two(rest % 60)}${part}`;
};

// Time of day at a second of the footage. `clocks` has [second of the footage, second of the day] at each clock change.
export const clockAt = (clocks, seconds) => {
  const known = clocks.filter(([from]) => from <= seconds).pop() || clocks[0];
  return known ? spoken((((known[1] + seconds - known[0]) % 86400) + 86400) % 86400) : "";
};

// Key presses of a count within its period.
export const within = (count) => count.presses.filter((one) => one.t >= count.begin && one.t < count.end);

// Rows by gate and direction, or by pair of them: names, manual count, automatic count (null: not available).
export const rowsOf = (data, count) => {
  const own = within(count), letters = new Map(data.kinds).get(count.kind), name = (k) => `${data.sides[k].gate} (${data.sides[k].direction})`;
  const row = (what, hand, text) => ({ what, hand, counted: text === null ? null : machineCount(text, letters, count.begin, count.end) });
  if (count.what === "crossings")
    return count.sides.map((k) => row(name(k), own.filter((one) => one.side === k).length, data.crossings && data.crossings[k]));
  const texts = new Map((data.movements || []).map(([from, to, text]) => [from + " " + to, text]));
  const pairs = new Set(own.map((one) => one.side + " " + one.to));
  for (const [pair, text] of texts) {
    const [from, to] = pair.split(" ").map(Number);
    if (count.sides.includes(from) && count.sides.includes(to) && machineCount(text, letters, count.begin, count.end)) pairs.add(pair);
  }
  return [...pairs].sort((a, b) => a.localeCompare(b, "en", { numeric: true })).map((pair) => {
    const [from, to] = pair.split(" ").map(Number);
    const hand = own.filter((one) => one.side === from && one.to === to).length;
    return row(`${name(from)} to ${name(to)}`, hand, data.movements && (texts.get(pair) || ""));
  });
};

// Gate and direction of two manual counts that overlap in class and time; null if there are none.
export const overlapOf = (data, counts) => {
  const kinds = new Map(data.kinds), plain = counts.filter((one) => one.what === "crossings");
  for (const [i, a] of plain.entries())
    for (const b of plain.slice(0, i)) {
      const side = a.sides.find((k) => b.sides.includes(k));
      const together = a.begin < b.end && b.begin < a.end && [...kinds.get(a.kind)].some((one) => kinds.get(b.kind).includes(one));
      if (together && side !== undefined) return data.sides[side];
    }
  return null;
};

// File for --manual-count, with whole seconds of the footage. As in skope/files/csv_files.py, an apostrophe precedes a text
// that a spreadsheet would run as a formula, and the file begins with a byte order mark.
export const csvOf = (data, counts) => {
  const safe = (value) => (typeof value === "string" && /^'*[=+\-@\t\r\n\uff1d\uff0b\uff0d\uff20]/.test(value) ? `'${value}` : String(value));
  const cell = (text) => (/[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const lines = ["gate,direction,class,begin,end,count"];
  for (const count of counts.filter((one) => one.what === "crossings"))
    for (const k of count.sides) {
      const side = data.sides[k], number = within(count).filter((one) => one.side === k).length;
      lines.push([side.gate, side.direction, count.kind, count.begin, count.end, number].map((one) => cell(safe(one))).join(","));
    }
  return "\ufeff" + lines.join("\n") + "\n";
};

// Stored state if it is valid for this page; otherwise an empty state.
export const checkedState = (data, value) => {
  const second = (s) => Number.isFinite(s) && s >= 0 && s < 1e8, side = (k) => Number.isInteger(k) && k >= 0 && k < data.sides.length;
  const kinds = data.kinds.map(([name]) => name);
  const press = (one) => one && second(one.t) && side(one.side) && (one.to === undefined || side(one.to));
  const count = (one) =>
    one && Number.isInteger(one.begin) && second(one.begin) && kinds.includes(one.kind) && ["crossings", "movements"].includes(one.what) &&
    Array.isArray(one.sides) && one.sides.length && one.sides.every(side) && Array.isArray(one.presses) && one.presses.every(press) &&
    one.presses.every((p) => (one.what === "movements") === (p.to !== undefined));
  const finished = (one) => count(one) && Number.isInteger(one.end) && one.end > one.begin;
  const good = value && Array.isArray(value.done) && value.done.every(finished) && (!value.current || (count(value.current) && second(value.current.seen) && Number.isFinite(value.current.offset)));
  return good ? { done: value.done, current: value.current || null } : { done: [], current: null };
};
