"use strict";

// Empty cells last, numbers as numbers.
function compare(a, b) {
  const x = a.dataset.value ?? a.textContent.trim(), y = b.dataset.value ?? b.textContent.trim();
  if ((x === "") !== (y === "")) return x === "" ? Infinity : -Infinity;
  const p = Number(x), q = Number(y);
  return Number.isNaN(p) || Number.isNaN(q) ? x.localeCompare(y, undefined, { numeric: true }) : p - q;
}

for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.addEventListener("click", () => {
    const up = head.getAttribute("aria-sort") !== "ascending";
    for (const other of heads) other.setAttribute("aria-sort", "none");
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const rows = [...table.tBodies[0].rows].sort((a, b) => {
      const order = compare(a.cells[column], b.cells[column]);
      return Math.abs(order) === Infinity || up ? order : -order;
    });
    table.tBodies[0].append(...rows);
  }));
}

for (const section of document.querySelectorAll("section")) {
  const choice = section.querySelector("select.measure");
  if (!choice) continue;
  const show = () => {
    for (const plot of section.querySelectorAll(".plot")) plot.hidden = plot.dataset.measure !== choice.value;
  };
  choice.addEventListener("change", show);
  show();
}
