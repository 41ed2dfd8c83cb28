// The range of a recording to hold out. It is dragged over the plots or typed, and opens the training form.

import { Field, Link } from "../../components.js";
import { count, percent } from "../../format.js";
import { html, useEffect, useState } from "../../preact.js";
import { nearest } from "./rows.js";

/** The form. rows: [first, last), or null; axis: "t" or "rows"; rising: whether the axis never decreases; choose(rows). */
export function HoldOut({ preview, dataset, rows, axis, rising, choose }) {
  const known = rangeOf(preview, axis, rows);
  const [typed, setTyped] = useState(null);
  useEffect(() => setTyped(null), [rows, axis]);
  const texts = typed ?? (known ? known.map((each) => String(Number(each.toPrecision(6)))) : ["", ""]);
  const type = (side, text) => setTyped(texts.map((each, index) => (index === side ? text : each)));
  const take = () => {
    const [from, to] = texts.map(Number);
    if (texts.every(Boolean) && from < to) choose(rowsWithin(preview, axis, [from, to]));
  };
  const input = (side) => (attributes) => html`<input ...${attributes} type="number" step="any" disabled=${!rising} value=${texts[side]} onInput=${(event) => type(side, event.target.value)} onChange=${take} />`;
  const unit = axis === "t" ? "s" : "sample";
  return html`<fieldset class="stretches">
    <legend>Hold out</legend>
    <div class="row"><${Field} label=${`From, ${unit}`} input=${input(0)} /><${Field} label=${`To, ${unit}`} input=${input(1)} /></div>
    <p role="status">${rows ? describe(rows, preview.samples) : "No range selected. Enter it here, or set “Drag action” to “Select the range to hold out” and drag over a plot."}</p>
    ${rows && html`<div class="actions">
      <${Link} kind="primary" to=${`#/train?datasets=${dataset.id}&hold_out=${rows.join("-")}`}>Train with this range held out<//>
      <button type="button" onClick=${() => choose(null)}>Clear range</button>
    </div>`}
  </fieldset>`;
}

/** Return the values of an axis at the first and the last row of a range; null without a range. */
export function rangeOf({ columns: [column] }, axis, rows) {
  return rows && [rows[0], rows[1] - 1].map((row) => column[axis][nearest(column.rows, row)]);
}

/** Return the rows [first, last) in a range of an ascending axis; null if there are fewer than two. */
export function rowsWithin({ columns: [column] }, axis, [from, to]) {
  const inside = column.rows.filter((_row, index) => column[axis][index] >= from && column[axis][index] <= to);
  return inside.length > 1 ? [inside[0], inside.at(-1) + 1] : null;
}

function describe([first, last], samples) {
  return `${count(last - first)} of ${count(samples)} samples (${percent((last - first) / samples, 0)}) are held out of the training and used to evaluate the version.`;
}
