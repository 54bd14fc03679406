// Behaviour of all reports: choices, layers, filters, sortable tables and tooltips.

import { hideTip, showTip } from "./dom.js";

// Choice of the protocol whose table is shown.
for (const radio of document.querySelectorAll("input[name=protocol]")) {
  radio.addEventListener("change", () => {
    for (const panel of document.querySelectorAll("[data-protocol]")) panel.hidden = panel.dataset.protocol !== radio.value;
  });
}

// Layers of a gallery's images.
for (const box of document.querySelectorAll("input[data-layer]")) {
  const show = () => {
    for (const layer of box.closest(".gallery").querySelectorAll(".stage ." + box.dataset.layer)) layer.classList.toggle("off", !box.checked);
  };
  box.addEventListener("change", show);
  show();
}

// Filters of a gallery: shown images, and vehicles of one type.
for (const gallery of document.querySelectorAll(".gallery")) {
  const filters = [...gallery.querySelectorAll("select[data-filter]")];
  const show = () => {
    const wanted = filters.filter((f) => f.value).map((f) => [f.dataset.filter, f.value]);
    let count = 0;
    for (const figure of gallery.querySelectorAll("figure.photo")) {
      // An image has several vehicle types, and one value of every other property.
      figure.hidden = !wanted.every(([key, value]) => (key === "type" ? figure.dataset.type.split(" ").includes(value) : figure.dataset[key] === value));
      count += !figure.hidden;
    }
    const type = (wanted.find(([key]) => key === "type") || [])[1];
    for (const vehicle of gallery.querySelectorAll("g[data-of]")) vehicle.classList.toggle("off", type !== undefined && vehicle.dataset.of !== type);
    gallery.querySelector("output.count").textContent = count ? count + (count === 1 ? " image" : " images") : "no image is like that";
  };
  for (const filter of filters) filter.addEventListener("change", show);
  if (filters.length) show();
}

// An image across the whole page.
for (const button of document.querySelectorAll("button.larger")) {
  button.addEventListener("click", () => {
    const large = button.closest("figure").classList.toggle("wide");
    button.setAttribute("aria-pressed", large);
    button.textContent = large ? "smaller" : "larger";
  });
}

// Tables sort by a column's numbers or text; a second click reverses the order. Cells without a number are last.
const number = (cell) => (/^\s*[-+]?\d/.test(cell.textContent) ? parseFloat(cell.firstChild.textContent || cell.textContent) : NaN);
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    head.querySelector("button").addEventListener("click", () => {
      const falling = head.getAttribute("aria-sort") === "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", falling ? "descending" : "ascending");
      const body = table.tBodies[0];
      const rows = [...body.rows].map((row) => ({ row, value: number(row.cells[column]), text: row.cells[column].textContent }));
      const numeric = column > 0 && rows.some((r) => !Number.isNaN(r.value));
      rows.sort((a, b) => {
        if (!numeric) return (falling ? -1 : 1) * a.text.localeCompare(b.text, "en", { numeric: true });
        if (Number.isNaN(a.value) || Number.isNaN(b.value)) return Number.isNaN(a.value) - Number.isNaN(b.value);
        return falling ? b.value - a.value : a.value - b.value;
      });
      body.append(...rows.map((r) => r.row));
    });
  });
}

// Tooltips: by pointer, by touch, and by the arrow keys in a chart that has the focus.
let marked = null;
const hide = () => {
  hideTip();
  if (marked) marked.classList.remove("active");
  marked = null;
};
const tell = (target) => {
  hide();
  marked = target;
  target.classList.add("active");
  const at = target.getBoundingClientRect();
  const tip = showTip(target.dataset.tip, at.left, at.bottom + 8);
  const above = at.top - tip.offsetHeight - 8;
  if (above > 4) tip.style.top = above + "px";
};
for (const kind of ["pointerover", "pointerdown"]) {
  document.addEventListener(kind, (event) => {
    const target = event.target.closest && event.target.closest("[data-tip]");
    if (target) tell(target);
    else hide();
  });
}
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") return hide();
  const chart = event.target.closest && event.target.closest("svg.chart");
  const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
  if (!chart || !step) return;
  const marks = [...chart.querySelectorAll("[data-tip]")];
  if (!marks.length) return;
  event.preventDefault();
  const next = marks.indexOf(marked) < 0 ? (step > 0 ? 0 : marks.length - 1) : (marks.indexOf(marked) + step + marks.length) % marks.length;
  tell(marks[next]);
});
document.addEventListener("focusout", hide);
addEventListener("scroll", hide, { passive: true });
