// Tables that can be sorted and filtered. The filter and the order stay while rows change.

import { h, refresh } from "./dom.js";
import { counted } from "./format.js";

/**
 * Create a table with a filter and sortable columns. Returns {element, show(rows)}.
 * columns: [{label, cell: row => nodes, value: row => sort key (omit it if not sortable), numeric, first: "descending"}];
 * words: row => searched text; key: row => identity of the row; what: [singular, plural] of a row;
 * sort: initial order [label, "ascending" or "descending"], else that of the rows; minRows: number of rows from which the filter is shown.
 */
export function listing(columns, { caption, words, key, what = ["row", "rows"], sort = null, minRows = 2 }) {
  const state = { rows: [], sort, text: "" };
  const heads = columns.map((column) => heading(column, () => {
    state.sort = nextSort(state.sort, column);
    draw();
  }));
  const body = h("tbody", {}), note = h("p", { class: "hint", role: "status" });
  const box = h("input", { type: "search", placeholder: "Filter", "aria-label": `Filter ${what[1]}`, autocomplete: "off", spellcheck: "false", oninput: () => {
    state.text = box.value;
    draw();
  } });
  const bar = h("div", { class: "filter" }, box, note);
  const draw = () => {
    const shown = sortRows(columns, state.sort, filterRows(state.rows, words, state.text));
    bar.hidden = state.rows.length < minRows;
    note.textContent = state.text.trim() ? `${shown.length} of ${counted(state.rows.length, ...what)}` : counted(state.rows.length, ...what);
    columns.forEach((column, index) => {
      if (!column.value) return;
      const how = state.sort?.[0] === column.label ? state.sort[1] : "none";
      heads[index].setAttribute("aria-sort", how);
    });
    refresh(body, shown.length ? shown.map((row) => tableRow(columns, row, key)) : noMatch(columns, what));
  };
  const table = h("table", { "aria-label": caption }, h("thead", {}, h("tr", {}, heads)), body);
  const element = h("div", { class: "listing" }, bar, h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption }, table));
  return {
    element,
    show(rows) {
      state.rows = rows;
      draw();
    },
  };
}

function heading({ label, numeric, value }, sort) {
  const kind = numeric ? "numeric" : null;
  if (!value) return h("th", { scope: "col", class: kind }, label);
  return h("th", { scope: "col", class: kind, "aria-sort": "none" }, h("button", { type: "button", class: "sort", onclick: sort }, label));
}

/** Return the next order of a column: first direction, other direction, unsorted. */
function nextSort(sort, { label, first = "ascending" }) {
  if (sort?.[0] !== label) return [label, first];
  return sort[1] === first ? [label, first === "ascending" ? "descending" : "ascending"] : null;
}

function sortRows(columns, sort, rows) {
  const column = columns.find((each) => each.label === sort?.[0]);
  if (!column) return rows;
  const sign = sort[1] === "descending" ? -1 : 1;
  const keyed = rows.map((row) => [row, column.value(row)]);
  const missing = (value) => value === null || value === undefined || Number.isNaN(value);
  return keyed.sort(([, a], [, b]) => {
    if (missing(a) || missing(b)) return Number(missing(a)) - Number(missing(b)); // unknown values are last in both directions
    return sign * (typeof a === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true }));
  }).map(([row]) => row);
}

function filterRows(rows, words, text) {
  const wanted = text.toLowerCase().split(/\s+/).filter(Boolean);
  return rows.filter((row) => {
    const there = words(row).toLowerCase();
    return wanted.every((each) => there.includes(each));
  });
}

function tableRow(columns, row, key) {
  return h("tr", { "data-key": key(row) }, columns.map((column) => h("td", column.numeric ? { class: "numeric" } : {}, column.cell(row))));
}

function noMatch(columns, [, plural]) {
  return h("tr", {}, h("td", { colspan: columns.length, class: "muted" }, `No ${plural} match.`));
}
