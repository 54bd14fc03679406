// What of the document is in the file, saving it, and what happens where another window has saved it meanwhile.

import { get, post } from "./server.js";

const byId = (id) => document.getElementById(id);

export class Saving {
  // `does` has `refresh`, `trouble`, `wrong` (a problem that keeps it from being saved) and `replace` (by another document).
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

  // Goes on with both windows' work, or with the other's.
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
