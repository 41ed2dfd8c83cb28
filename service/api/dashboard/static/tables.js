// Tables that a reader sorts and filters. What is typed and chosen stays while rows come and go.

import { h, refresh } from "./dom.js";
import { counted } from "./format.js";

/**
 * A table with a box to filter by, and headings that sort.
 * columns: [{label, cell: row => nodes, value: row => number or text to sort by (not sortable without), numeric, first: "descending"}];
 * words: row => text that is searched; key: row => what tells rows apart; what: [singular, plural] of a row;
 * sort: [label, "ascending" or "descending"] at the start, else the order that rows come in.
 * Returns {element, show(rows)}.
 */
export function listing(columns, { caption, words, key, what = ["row", "rows"], sort = null, fewest = 2 }) {
  const state = { rows: [], sort, text: "" };
  const heads = columns.map((column) => heading(column, () => {
    state.sort = following(state.sort, column);
    draw();
  }));
  const body = h("tbody", {}), note = h("p", { class: "hint", role: "status" });
  const box = h("input", { type: "search", placeholder: "Filter", "aria-label": `Filter ${what[1]}`, autocomplete: "off", spellcheck: "false", oninput: () => {
    state.text = box.value;
    draw();
  } });
  const bar = h("div", { class: "filter" }, box, note);
  const draw = () => {
    const shown = sorted(columns, state.sort, matching(state.rows, words, state.text));
    bar.hidden = state.rows.length < fewest;
    note.textContent = state.text.trim() ? `${shown.length} of ${counted(state.rows.length, ...what)}` : counted(state.rows.length, ...what);
    columns.forEach((column, index) => {
      if (!column.value) return;
      const how = state.sort?.[0] === column.label ? state.sort[1] : "none";
      heads[index].setAttribute("aria-sort", how);
    });
    refresh(body, shown.length ? shown.map((row) => tableRow(columns, row, key)) : none(columns, what));
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

/** Sorted one way, then the other, then as it came. */
function following(sort, { label, first = "ascending" }) {
  if (sort?.[0] !== label) return [label, first];
  return sort[1] === first ? [label, first === "ascending" ? "descending" : "ascending"] : null;
}

function sorted(columns, sort, rows) {
  const column = columns.find((each) => each.label === sort?.[0]);
  if (!column) return rows;
  const sign = sort[1] === "descending" ? -1 : 1;
  const worth = rows.map((row) => [row, column.value(row)]);
  const missing = (value) => value === null || value === undefined || Number.isNaN(value);
  return worth.sort(([, a], [, b]) => {
    if (missing(a) || missing(b)) return Number(missing(a)) - Number(missing(b)); // what is not known comes last either way
    return sign * (typeof a === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true }));
  }).map(([row]) => row);
}

function matching(rows, words, text) {
  const wanted = text.toLowerCase().split(/\s+/).filter(Boolean);
  return rows.filter((row) => {
    const there = words(row).toLowerCase();
    return wanted.every((each) => there.includes(each));
  });
}

function tableRow(columns, row, key) {
  return h("tr", { "data-key": key(row) }, columns.map((column) => h("td", column.numeric ? { class: "numeric" } : {}, column.cell(row))));
}

function none(columns, [, plural]) {
  return h("tr", {}, h("td", { colspan: columns.length, class: "muted" }, `No ${plural} match.`));
}
