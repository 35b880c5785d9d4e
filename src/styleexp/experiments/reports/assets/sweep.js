"use strict";

const byId = (id) => document.getElementById(id);

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
    for (const body of table.tBodies) {
      const rows = [...body.rows].filter((row) => !row.matches(".group")).sort((a, b) => {
        const order = compare(a.cells[column], b.cells[column]);
        return Math.abs(order) === Infinity || up ? order : -order;
      });
      body.append(...rows); // a group's name stays first
    }
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

// Columns of measurements that are chosen; the others are hidden, not left out.
for (const section of document.querySelectorAll("section")) {
  const choices = [...section.querySelectorAll(".columns input")], table = section.querySelector("table.runs");
  const heads = [...(table?.tHead.rows[0].cells ?? [])].map((head) => head.textContent.trim());
  const show = () => {
    for (const choice of choices) {
      const column = heads.indexOf(choice.value);
      for (const row of table.rows) {
        if (row.cells.length === heads.length) row.cells[column].hidden = !choice.checked;
      }
    }
  };
  for (const choice of choices) choice.addEventListener("change", show);
  show();
}

// Rows with the same value of a column, together in a body of their own, below its name.
for (const section of document.querySelectorAll("section")) {
  const choice = section.querySelector("select.group"), table = section.querySelector("table.runs");
  if (!choice) continue;
  choice.addEventListener("change", () => {
    const rows = [...table.rows].filter((row) => row.dataset.text !== undefined);
    for (const body of [...table.tBodies]) body.remove();
    const bodies = new Map();
    const key = choice.selectedOptions[0].textContent, column = Number(choice.value);
    for (const row of rows) {
      const value = column ? row.cells[column].textContent : "";
      if (!bodies.has(value)) {
        const body = table.createTBody();
        if (column) {
          const name = document.createElement("th");
          name.colSpan = row.cells.length;
          name.scope = "rowgroup";
          name.textContent = `${key}=${value}`;
          body.insertRow().append(name);
          body.rows[0].className = "group";
        }
        bodies.set(value, body);
      }
      bodies.get(value).append(row);
    }
    filter();
  });
}

// Rows and pictures of runs that lack one of the typed words are hidden, and what is empty then.
function filter() {
  const words = byId("filter").value.toLowerCase().split(/\s+/).filter(Boolean);
  const holds = (each) => words.every((word) => each.dataset.text.includes(word));
  let shown = 0, all = 0;
  for (const each of document.querySelectorAll("[data-text]")) {
    each.hidden = !holds(each);
    if (each.localName === "tr") { all += 1; shown += !each.hidden; }
  }
  const empty = (each) => words.length > 0 && !each.querySelector("[data-text]:not([hidden])");
  for (const row of document.querySelectorAll("table.sheet tbody tr")) row.hidden = empty(row);
  for (const body of document.querySelectorAll("table.runs tbody")) body.hidden = empty(body);
  byId("filter-state").textContent = words.length ? `${shown} of ${all} runs` : "";
}
byId("filter").addEventListener("input", filter);
