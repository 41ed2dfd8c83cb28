// Plots of a data set's signals, with a common cursor and zoom. Dragging selects the range to hold out.

import { get, path } from "../../api.js";
import { h, replace } from "../../dom.js";
import { count, shortNames } from "../../format.js";
import { LinkedPlots } from "../../linked.js";
import { line, plot } from "../../plots.js";
import { field, loading, select } from "../../ui.js";
import { valuesTable } from "./values.js";
import { holdOut } from "./hold_out.js";

const POINTS = 1000;
const ALL = "all joints";
const QUANTITIES = { q: "Position", dq: "Velocity", ddq: "Acceleration", tau: "Torque" };
const AXES = { t: "time", rows: "sample number" };
const DRAGS = { zoom: "Zoom all plots", hold: "Select the range to hold out" };

/**
 * Draw the signals of a data set into an element.
 * rows: [first, last) to hold out, null for none; choose(rows): called when the selection changes.
 */
export async function signals(element, dataset, { rows, choose, signal }) {
  replace(element, loading("Drawing"));
  const preview = await get(path`/v1/datasets/${dataset.id}/preview`, { points: POINTS }, signal);
  const names = shortNames(dataset.joint_names);
  // the time of each episode may start again: plots over time would overlap
  const rising = preview.columns.every(({ t }) => t.every((value, index) => index === 0 || value >= t[index - 1]));
  const shown = { joint: ALL, axis: rising ? "t" : "rows" };
  const places = Object.fromEntries(Object.keys(QUANTITIES).map((name) => [name, h("div", { class: "strip" })]));
  const plots = new Map();
  const values = valuesTable(preview, names, dataset.report.joint_types, (x) => linked.point(x));
  const held = holdOut(preview, dataset, rows, () => shown.axis, {
    chosen: (stretch, found) => {
      linked.shade(stretch);
      choose(found);
    },
  });
  const linked = new LinkedPlots({ zooms: true, moved: values.show, chosen: held.take });

  const draw = async () => {
    for (const [quantity, place] of Object.entries(places)) {
      const columns = preview.columns.filter((each) => each.quantity === quantity);
      const traces = dataset.joint_names.flatMap((joint, index) => {
        if (shown.joint !== ALL && shown.joint !== joint) return [];
        const column = columns.find((each) => each.joint === joint);
        return column ? [line(...withGaps(column, shown.axis, preview.starts), names[index], index)] : [];
      });
      const derived = dataset.report.derived.includes(quantity) ? ", derived" : "";
      const layout = {
        title: `${QUANTITIES[quantity]} ${quantity}${derived}`,
        y: unit(columns[0]?.unit ?? "", dataset.report.joint_types),
        height: 200,
        showlegend: false, // the table of values is the legend
        hovermode: false,
        dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom",
        margin: { l: 62, r: 10, t: 30, b: 26 }, // the same in all plots, so that times are aligned
        xaxis: { automargin: false, ticksuffix: shown.axis === "t" ? " s" : "" },
        yaxis: { automargin: false, fixedrange: true },
        uirevision: shown.axis, // keeps the zoom when the joint changes
      };
      const label = `${QUANTITIES[quantity]} ${quantity} of ${shown.joint} against ${AXES[shown.axis]}`;
      place.setAttribute("aria-label", label);
      if (plots.has(quantity)) plots.get(quantity).react(traces, layout);
      else {
        plots.set(quantity, await plot(place, traces, layout, { label, signal }));
        if (signal.aborted) return;
        linked.add(place);
      }
    }
    values.setAxis(shown.axis, rising || shown.axis === "rows");
    held.setAxis(shown.axis, rising || shown.axis === "rows");
  };

  const drag = select(Object.entries(DRAGS), "zoom", (what) => linked.drag(what === "hold"));
  replace(
    element,
    h(
      "div",
      { class: "grid thirds" },
      field("Joint", select([ALL, ...dataset.joint_names], ALL, (joint) => { shown.joint = joint; values.only(joint === ALL ? null : dataset.joint_names.indexOf(joint)); draw(); })),
      field("Horizontal axis", select(Object.entries(AXES), shown.axis, (axis) => { shown.axis = axis; draw(); })),
      field("Drag action", drag),
    ),
    h(
      "div",
      { class: "signals" },
      h("div", { class: "beside" }, values.element, held.element),
      h("div", { class: "strips" }, Object.values(places), h("p", { class: "hint" }, h("button", { type: "button", onclick: () => linked.reset() }, "Reset zoom"), " ", drawnSamples(preview), " Lines have a gap between episodes.")),
    ),
  );
  await draw();
}

/** Return times or rows, and values, with a gap before each episode. */
export function withGaps(column, axis, starts) {
  const x = [], y = [];
  let next = 0;
  column.rows.forEach((row, index) => {
    let breaks = false;
    while (next < starts.length && starts[next] <= row) breaks = starts[next++] > 0;
    if (breaks && index > 0) {
      x.push(column[axis][index]);
      y.push(null);
    }
    x.push(column[axis][index]);
    y.push(column.values[index]);
  });
  return [x, y];
}

/** Return the unit of "rad or m" that applies to all joints; both if types differ or are unknown. */
function unit(units, types) {
  const [revolute, prismatic] = units.split(" or ");
  if (types?.every((type) => type === "revolute")) return revolute;
  return types?.every((type) => type === "prismatic") ? prismatic : units;
}

function drawnSamples(preview) {
  const drawn = Math.max(...preview.columns.map((column) => column.rows.length));
  if (drawn >= preview.samples) return `Showing all ${count(preview.samples)} samples.`;
  return `Showing ${count(drawn)} points of ${count(preview.samples)} samples: the minimum and the maximum of each interval.`;
}
