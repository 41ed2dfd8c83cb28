// Table of the values at the cursor, which is also the legend of the plots. A slider moves the cursor by keyboard.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { count, number } from "../../format.js";

const QUANTITIES = ["q", "dq", "ddq", "tau"];

/**
 * Create the table. pointed(x): called when the slider moves. Returns {element, show(x), setAxis(axis, rising), only(joint)}.
 * x: value of the plots' axis, null for none; rising: whether this axis never decreases; joint: the only visible one,
 * null for all.
 */
export function valuesTable(preview, names, types, pointed) {
  const columns = new Map(preview.columns.map((each) => [`${each.quantity} ${each.joint}`, each]));
  const joints = [...new Set(preview.columns.map((each) => each.joint))];
  const state = { axis: "t", rising: true };
  const cells = joints.map(() => Object.fromEntries(QUANTITIES.map((name) => [name, h("td", { class: "numeric" }, "–")])));
  const rows = joints.map((_joint, index) =>
    h("tr", {}, h("th", { scope: "row" }, h("span", { class: "joint", style: `--own: ${jointVar(index)}` }, names[index])), QUANTITIES.map((name) => cells[index][name])),
  );
  const at = h("output", { class: "at" }, "Values at the cursor");
  const slider = h("input", { type: "range", step: "any", "aria-label": "Cursor", oninput: () => (pointed(slider.valueAsNumber), show(slider.valueAsNumber)) });
  const element = h(
    "div",
    { class: "reading" },
    h("div", { class: "row" }, at),
    slider,
    h(
      "div",
      { class: "scroll", tabindex: "0", role: "region", "aria-label": "Values at the cursor" },
      h(
        "table",
        { "aria-label": "Values at the cursor, in SI units" },
        h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Joint"), QUANTITIES.map((name) => h("th", { scope: "col", class: "numeric" }, name)))),
        h("tbody", {}, rows),
      ),
    ),
    types?.includes("prismatic") ? h("p", { class: "hint" }, "Prismatic joints: m and N.") : null,
  );

  function show(x) {
    const known = x !== null && state.rising;
    at.textContent = known ? describeCursor(x) : "Values at the cursor";
    if (known && document.activeElement !== slider) slider.value = String(x);
    if (known) slider.setAttribute("aria-valuetext", describeCursor(x));
    joints.forEach((joint, index) => {
      for (const name of QUANTITIES) {
        const column = columns.get(`${name} ${joint}`);
        const text = known && column ? number(column.values[nearest(column[state.axis], x)], 3) : "–";
        if (cells[index][name].textContent !== text) cells[index][name].textContent = text;
      }
    });
  }
  const describeCursor = (x) => (state.axis === "t" ? `At ${number(x, 5)} s` : `At sample ${count(x)}`);
  return {
    element,
    show,
    setAxis(axis, rising) {
      Object.assign(state, { axis, rising });
      const all = preview.columns[0][axis];
      [slider.min, slider.max, slider.disabled] = [String(all[0]), String(all.at(-1)), !rising];
      slider.value = slider.min;
      show(rising ? all[0] : null);
    },
    only(joint) {
      rows.forEach((row, index) => (row.hidden = joint !== null && joint !== index));
    },
  };
}

/** Return the index of the number nearest to x in an ascending list. */
export function nearest(rising, x) {
  let [low, high] = [0, rising.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (rising[middle] <= x) low = middle;
    else high = middle;
  }
  return x - rising[low] <= rising[high] - x ? low : high;
}
