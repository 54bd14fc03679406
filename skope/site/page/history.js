// The document as it is, was, and was again: every change makes a new one, so that each step can be gone back.

const KEPT = 200;
const SAME_MS = 800; // changes of the same thing in a row are one step

export class History {
  constructor(document) {
    this.document = document;
    this.past = [];
    this.future = [];
    this.last = { of: null, when: 0 };
  }

  // Changes a copy of the document; `of` names what is changed, so that moving it on does not make further steps.
  change(edit, of = null) {
    const next = structuredClone(this.document);
    edit(next);
    if (JSON.stringify(next) === JSON.stringify(this.document)) return false;
    const now = Date.now();
    const goesOn = of !== null && of === this.last.of && now - this.last.when < SAME_MS;
    if (!goesOn) this.past.push(this.document);
    if (this.past.length > KEPT) this.past.shift();
    this.last = { of, when: now };
    this.future = [];
    this.document = next;
    return true;
  }

  undo() {
    return this.step(this.past, this.future);
  }

  redo() {
    return this.step(this.future, this.past);
  }

  step(from, to) {
    if (!from.length) return false;
    to.push(this.document);
    this.document = from.pop();
    this.last = { of: null, when: 0 };
    return true;
  }
}
