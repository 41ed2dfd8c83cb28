// Form with the range of a recording to hold out. It is dragged over the plots or typed, and opens the training form.

import { h, replace } from "../../dom.js";
import { count, percent } from "../../format.js";
import { field, link } from "../../ui.js";
import { nearest } from "./values.js";

/**
 * Create the form. rows: initial [first, last), or null; chosen(range, rows): called when the range changes, with values
 * of the axis and rows, null for none. Returns {element, take(range), setAxis(axis, rising)}.
 */
export function holdOut(preview, dataset, rows, axis, { chosen }) {
  const column = preview.columns[0];
  const state = { rows };
  const inputs = ["From", "To"].map((label) => h("input", { type: "number", step: "any", "aria-label": `${label}, held-out range`, onchange: () => typed() }));
  const units = inputs.map(() => h("span", { class: "muted" })), status = h("p", { role: "status" }), actions = h("div", { class: "actions" });
  const clear = h("button", { type: "button", onclick: () => set(null) }, "Clear range");

  const border = (row) => column[axis()][Math.min(nearest(column.rows, row), column.rows.length - 1)];
  const range = () => (state.rows === null ? null : [border(state.rows[0]), border(state.rows[1] - 1)]);
  const set = (found) => {
    state.rows = found;
    update();
    chosen(range(), found);
  };
  const take = (dragged) => set(dragged === null ? null : rowsWithin(column, axis(), dragged));
  const typed = () => {
    const [from, to] = inputs.map((each) => each.valueAsNumber);
    if (from < to) take([from, to]);
  };
  const update = () => {
    const found = range();
    inputs.forEach((input, side) => (input.value = found === null ? "" : String(Number(found[side].toPrecision(6)))));
    if (state.rows === null) {
      replace(status, "No range selected. Enter it here, or set “Drag action” to “Select the range to hold out” and drag over a plot.");
      replace(actions);
      return;
    }
    const [first, last] = state.rows;
    replace(status, `${count(last - first)} of ${count(preview.samples)} samples (${percent((last - first) / preview.samples, 0)}) are held out of the training and used to evaluate the version.`);
    replace(actions, link("Train with this range held out", `#/train?datasets=${dataset.id}&hold_out=${first}-${last}`, "primary"), clear);
  };
  const element = h(
    "fieldset",
    { class: "stretches" },
    h("legend", {}, "Hold out"),
    h("div", { class: "row" }, field(["From", units[0]], inputs[0]), field(["To", units[1]], inputs[1])),
    status,
    actions,
  );
  return {
    element,
    take,
    setAxis(name, rising) {
      units.forEach((each) => (each.textContent = name === "t" ? ", s" : ", sample"));
      inputs.forEach((each) => (each.disabled = !rising));
      update();
      chosen(rising ? range() : null, state.rows);
    },
  };
}

/** Return the rows [first, last) in a range of an ascending axis; null if there are fewer than two. */
function rowsWithin(column, axis, [from, to]) {
  const along = column[axis];
  const inside = column.rows.filter((_row, index) => along[index] >= from && along[index] <= to);
  return inside.length > 1 ? [inside[0], inside.at(-1) + 1] : null;
}

/** Parse rows [first, last) from text such as 300-450; null if it is invalid. */
export function rowsOf(text) {
  const found = /^(\d+)-(\d+)$/.exec(text ?? "");
  const rows = found && [Number(found[1]), Number(found[2])];
  return rows && rows[0] < rows[1] ? rows : null;
}
