// Requests to the server, saving, and conflicts with another window that has saved.

import { byId, get } from "./dom.js";

// The server's answer to a value; an Error with its message and further fields if the server rejects it.
export async function post(path, value) {
  const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(value) });
  if (answer.ok) return answer.json();
  const type = answer.headers.get("Content-Type");
  const said = type === "application/json" ? await answer.json() : { text: await answer.text() };
  throw Object.assign(new Error(said.text), { status: answer.status, said });
}

// Requests only the newest value: values during a pending request are skipped. `answered` is
// called with the answer and its value.
export function newest(path, answered, failed) {
  let waiting = null;
  let asking = false;
  return async function ask(value) {
    waiting = value;
    if (asking) return;
    asking = true;
    while (waiting !== null) {
      const asked = waiting;
      waiting = null;
      try {
        const answer = await post(path, asked);
        if (waiting === null) answered(answer, asked);
      } catch (error) {
        if (waiting === null) failed(error);
      }
    }
    asking = false;
  };
}

// -------------------------------------------------------------------------------------------------------------- saving

// State of the saved file, saving, and conflicts with another window.

export class Saving {
  // `does` has `refresh`, `trouble`, `wrong` (a problem that prevents saving) and `replace` (by another document).
  constructor(begun, does) {
    this.does = does;
    this.exists = begun.exists;
    this.is(begun.saved, begun.revision);
  }

  is(document, revision) {
    [this.base, this.revision, this.text] = [document, revision, JSON.stringify(document)];
  }

  has(document) {
    return JSON.stringify(document) === this.text;
  }

  async save(document) {
    try {
      const answer = await post("/save", { document, revision: this.revision });
      this.is(document, answer.revision);
      this.exists = true;
      this.does.trouble("");
      byId("conflict").hidden = true;
      this.does.refresh();
      if (answer.said) byId("state").textContent = answer.said;
    } catch (error) {
      if (error.status === 409) return this.conflict(error.message);
      this.does.wrong(error.said && error.said.problem);
      this.does.trouble(error.message);
    }
  }

  conflict(words) {
    byId("conflict-words").textContent = words;
    byId("conflict").hidden = false;
    byId("conflict").scrollIntoView({ block: "nearest" });
    byId("merge").focus();
  }

  // Continues with the merged work of both windows, or with the other window's.
  async join(mine) {
    try {
      const theirs = mine ? await post("/merge", { base: this.base, mine }) : await (await get("/begin.json")).json();
      this.is(theirs.saved, theirs.revision);
      byId("conflict").hidden = true;
      this.does.replace(theirs.document);
    } catch (error) {
      this.does.trouble(error.message);
    }
  }
}
