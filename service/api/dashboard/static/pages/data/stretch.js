// The part of a recording to hold out: dragged over the plots, or typed; the training form is opened with it.

import { h, replace } from "../../dom.js";
import { count, percent } from "../../format.js";
import { field, link } from "../../ui.js";
import { nearest } from "./reading.js";

/**
 * The form. rows: [first, last) to begin with, or null; chosen(stretch, rows): another was chosen, in numbers of the
 * axis and in rows, null: none. Returns {element, take(stretch), against(axis, orderly)}.
 */
export function holdOut(preview, dataset, rows, axis, { chosen }) {
  const column = preview.columns[0];
  const state = { rows };
  const inputs = ["From", "To"].map((label) => h("input", { type: "number", step: "any", "aria-label": `${label}, of what is held out`, onchange: () => typed() }));
  const units = inputs.map(() => h("span", { class: "muted" })), said = h("p", { role: "status" }), actions = h("div", { class: "actions" });
  const clear = h("button", { type: "button", onclick: () => set(null) }, "Hold out nothing");

  const border = (row) => column[axis()][Math.min(nearest(column.rows, row), column.rows.length - 1)];
  const stretch = () => (state.rows === null ? null : [border(state.rows[0]), border(state.rows[1] - 1)]);
  const set = (found) => {
    state.rows = found;
    tell();
    chosen(stretch(), found);
  };
  const take = (dragged) => set(dragged === null ? null : within(column, axis(), dragged));
  const typed = () => {
    const [from, to] = inputs.map((each) => each.valueAsNumber);
    if (from < to) take([from, to]);
  };
  const tell = () => {
    const found = stretch();
    inputs.forEach((input, side) => (input.value = found === null ? "" : String(Number(found[side].toPrecision(6)))));
    if (state.rows === null) {
      replace(said, "Nothing yet. Choose “holds that part out” above and drag, or type.");
      replace(actions);
      return;
    }
    const [first, last] = state.rows;
    replace(said, `${count(last - first)} of ${count(preview.samples)} samples (${percent((last - first) / preview.samples, 0)}) will not be learnt, and the version is judged on them.`);
    replace(actions, link("Train with this held out", `#/train?datasets=${dataset.id}&hold_out=${first}-${last}`, "primary"), clear);
  };
  const element = h(
    "fieldset",
    { class: "stretches" },
    h("legend", {}, "Hold out"),
    h("div", { class: "row" }, field(["From", units[0]], inputs[0]), field(["To", units[1]], inputs[1])),
    said,
    actions,
  );
  return {
    element,
    take,
    against(name, orderly) {
      units.forEach((each) => (each.textContent = name === "t" ? ", s" : ", sample"));
      inputs.forEach((each) => (each.disabled = !orderly));
      tell();
      chosen(orderly ? stretch() : null, state.rows);
    },
  };
}

/** Rows [first, last) of a stretch of an axis that rises; null where it holds none. */
function within(column, axis, [from, to]) {
  const along = column[axis];
  const inside = column.rows.filter((_row, index) => along[index] >= from && along[index] <= to);
  return inside.length > 1 ? [inside[0], inside.at(-1) + 1] : null;
}

/** [first, last) of an address' text such as 300-450; null where it is none. */
export function rowsOf(text) {
  const found = /^(\d+)-(\d+)$/.exec(text ?? "");
  const rows = found && [Number(found[1]), Number(found[2])];
  return rows && rows[0] < rows[1] ? rows : null;
}
